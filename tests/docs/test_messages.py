"""The page of messages is made from the source."""

import importlib.util

from .._support.pages import DOCS, ROOT


def test_messages_are_listed_with_what_to_do():
    spec = importlib.util.spec_from_file_location("messages", DOCS / "messages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    photographs, meshes = module.page(ROOT / "curvireg_torch").split("## Meshes")
    assert "| frame … cannot be read | save the video again |" in photographs  # an f-string
    assert "| every face is degenerate (area 0) | repair the mesh |" in meshes
    assert "give --camera FX FY CX CY, --camera FILE (a calibration)" in meshes, "a constant of another module"
