from pathlib import Path

import pytest
import torch

from curvireg_torch.evaluation.runner import POSE_SOURCES
from curvireg_torch.matching import cache
from curvireg_torch.utils import files
from curvireg_torch.utils.files import code_digest, tensor_digest


def test_tensor_digest_depends_on_name_dtype_shape_and_values() -> None:
    x = torch.arange(4.0)
    others = [{"b": x}, {"a": x.double()}, {"a": x.view(2, 2)}, {"a": x + 1e-6}, {"a": x, "b": x}, {"a": x.bfloat16()}]
    found = {tensor_digest(tensors) for tensors in ({"a": x}, *others)}
    assert len(found) == 1 + len(others)
    strided = torch.stack([x, x], dim=1)[:, 0].requires_grad_()
    assert tensor_digest({"a": strided}) == tensor_digest({"a": x})
    assert len(tensor_digest({"a": torch.tensor(True)}, size=16)) == 32


def test_code_digest_changes_with_any_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_PACKAGE", tmp_path)
    (tmp_path / "room" / "deep").mkdir(parents=True)
    sources = [tmp_path / "room" / "a.py", tmp_path / "room" / "deep" / "b.py", tmp_path / "c.py"]
    seen = set()
    for i, source in enumerate([*sources, *sources]):
        source.write_text(f"x = {i}")
        code_digest.cache_clear()
        if i >= 2:
            seen.add(code_digest("room", "c.py"))
    assert len(seen) == 4
    with pytest.raises(FileNotFoundError):
        code_digest("no_such_room")
    code_digest.cache_clear()


@pytest.mark.parametrize("sources", [cache._SOURCES, POSE_SOURCES])
def test_code_digest_finds_all_sources_of_banks_and_results(sources: tuple[str, ...]) -> None:
    assert len(code_digest(*sources)) == 16
