import json

import pytest

from curvireg_torch import load_camera


@pytest.fixture
def read(tmp_path):
    """Write a calibration file, as JSON unless it is a text, and read its camera ``part``."""

    def written(content, name="camera.json", part=""):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return load_camera(f"{path}:{part}" if part else path)

    return written
