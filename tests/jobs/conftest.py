from tests._support.small_preset import _small, banks, out  # noqa: F401
