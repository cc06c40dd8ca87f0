import json

import pytest

from curvireg_torch import load_camera


@pytest.fixture
def write(tmp_path):
    """Write a file, of a text or of bytes, and return its path."""

    def written(name, content):
        path = tmp_path / name
        path.write_bytes(content) if isinstance(content, bytes) else path.write_text(content)
        return path

    return written


@pytest.fixture
def read(tmp_path):
    """Write a calibration file, as JSON unless it is a text, and read its camera ``part``."""

    def written(content, name="camera.json", part=""):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return load_camera(f"{path}:{part}" if part else path)

    return written
