import json

import pytest

from curvireg_torch import load_camera


@pytest.fixture
def write(tmp_path):
    """Write a file, of bytes, of a text, or of JSON, and return its path."""

    def written(name, content):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return written


@pytest.fixture
def read(write):
    """Write a calibration file, and read its camera ``part``."""

    def written(content, name="camera.json", part=""):
        path = write(name, content)
        return load_camera(f"{path}:{part}" if part else path)

    return written
