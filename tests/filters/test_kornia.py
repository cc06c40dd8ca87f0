"""Our primitives equal kornia's where both are defined, and kornia's is used where the measurements
say so."""

import json
from pathlib import Path

import kornia
import pytest
import torch

from curvireg_torch.filters.operations import to_grey
from scripts.speed import kornia_primitives as script
from scripts.speed.kornia_primitives import PRIMITIVES, decision, difference_of, table
from scripts.speed.timing import backward, forward

SAME = [primitive for primitive in PRIMITIVES if primitive.same]


@pytest.mark.parametrize("primitive", SAME, ids=lambda primitive: primitive.name)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_primitives_equal_those_of_kornia(primitive: script.Primitive, dtype: torch.dtype) -> None:
    x = torch.rand(2, primitive.channels, 116, 118, generator=torch.Generator().manual_seed(0)).to(
        dtype
    )
    assert difference_of(primitive, x) < 5e-5
    inner = slice(primitive.border, -primitive.border or None)
    assert float(forward(primitive.kornia, x)[..., inner, inner].abs().max()) > 0.01


@pytest.mark.parametrize("primitive", SAME, ids=lambda primitive: primitive.name)
def test_gradients_of_primitives_equal_those_of_kornia(primitive: script.Primitive) -> None:
    if not primitive.differentiable or primitive.border:  # borders are padded differently
        return
    x = torch.rand(
        1,
        primitive.channels,
        40,
        44,
        generator=torch.Generator().manual_seed(0),
        dtype=torch.float64,
    )
    gradients = []
    for function in (primitive.ours, primitive.kornia):
        image = x.clone().requires_grad_()
        backward(function, image)
        gradients.append(image.grad)
    torch.testing.assert_close(*gradients)


def test_grey_levels_are_those_of_kornia_in_graphs_too() -> None:
    x = torch.rand(2, 3, 8, 9)
    assert torch.equal(to_grey(x), kornia.color.rgb_to_grayscale(x))
    assert to_grey(x[:, :1]) is not None
    torch._dynamo.reset()
    graph = torch.compile(to_grey, fullgraph=True, backend="eager")
    torch.testing.assert_close(graph(x), to_grey(x))
    torch.testing.assert_close(torch.func.vmap(to_grey)(x[None]), to_grey(x)[None])


def test_decisions_follow_the_rule() -> None:
    def entry(ratio: float, difference: float = 1e-7, same: bool = True) -> dict[str, object]:
        times = {"ours_ms": 1.0, "kornia_ms": ratio, "ratio": ratio}
        return {"same": same, "difference": difference, "eager": {"forward": times}}

    assert decision([entry(1.0), entry(1.5)]) == "kornia's"
    assert decision([entry(1.0), entry(1.51)]) == "ours"
    assert decision([entry(1.0), entry(1.0, difference=1e-4)]) == "ours"
    assert decision([entry(0.5, same=False)]) == "ours: another function"
    slow_compiled = {**entry(1.0), "compiled": {"forward": {"ratio": 2.0}}}
    assert decision([slow_compiled]) == "ours"


def test_the_page_shows_the_record() -> None:
    record = json.loads(script.OUT.read_text())
    page = script.PAGE.read_text(encoding="utf-8")
    assert all(line in page for line in table(record["entries"]))
    used = {
        name: decision([e for e in record["entries"] if e["primitive"] == name])
        for name in ("grey levels", "Gaussian, sigma 1")
    }
    assert used == {"grey levels": "kornia's", "Gaussian, sigma 1": "ours"}


@pytest.mark.parametrize("name", ["first derivatives", "dilation by a disc"])
def test_measurements_run(name: str) -> None:
    primitive = next(p for p in PRIMITIVES if p.name == name)
    measured = script.measure(primitive, 32, compiled=False, rounds=1, seconds=1e-4)
    assert set(measured["eager"]) == {"forward", "forward and backward"} - (
        {"forward and backward"} if not primitive.differentiable else set()
    )
    assert all(values["ratio"] > 0 for values in measured["eager"].values())


def test_measurements_that_are_not_repeated_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(primitive: script.Primitive, size: int, **_: object) -> dict[str, object]:
        return {"primitive": primitive.name, "size": size, "same": False, "run": next(runs)}

    runs = iter(range(9))
    monkeypatch.setattr(script, "measure", measured)
    out = tmp_path / "record.json"
    words = ["script", "--out", str(out), "--only", "grey levels", "first derivatives"]
    for more in ([], ["--sizes", "256"]):
        monkeypatch.setattr("sys.argv", [*words, *more])
        script.main()
    found = [(e["primitive"], e["size"], e["run"]) for e in json.loads(out.read_text())["entries"]]
    assert found == [
        ("first derivatives", 128, 0),
        ("first derivatives", 256, 4),
        ("grey levels", 128, 2),
        ("grey levels", 256, 5),
    ]
