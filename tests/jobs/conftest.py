from tests._support.small_preset import _small, banks  # noqa: F401
