"""What the documentation's pages tell to type is typed: commands and Python, in order, page by page, with the settings
that everyone gets, in a folder with the files that the pages name."""

import json
import re
import runpy
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch import cli
from curvireg_torch.geometry import rotation_error, transform
from curvireg_torch.geometry.translation import place_view
from curvireg_torch.synthetic import example_mesh, synthesize_photograph

from .._support.exif import exif, with_exif
from .._support.miniature import (
    pascal_object,
    write_bop,
    write_image,
    write_mesh,
    write_pascal3d,
    write_record,
    write_web,
)
from .._support.pages import DOCS, PAGES, ROOT, steps, words_of

NOT_HERE = {
    r"git |pip |apt-get |python datasets/download|python -m zipfile|python scripts/benchmark/meshes": "download",
    r"curvireg view": "browser",  # tests/viewer/test_browser.py opens it
    r"scripts/test\.sh|python -m coverage|python scripts/robustness/(fuzz|soak)\.py|python -m mutmut": "suite",
    r"python scripts/results_table|python scripts/paper/figures\.py detectors$": "writes into the project",
    r".*[ /=$][A-Z]+([ ./]|$)": "placeholder",
    r"curvireg bank .*--adapt|curvireg register .*--field": "3000 photographs",  # tests/cli/test_register.py uses fewer
    r"python scripts/(?!paper/)": "measures for long",
}
"""Commands that are not typed, and why; how many is counted below."""

DEFECTIVE = ("data/PASCAL3D+_release1.1", "data/bop/lm", "data/web")
"""Trees with every defect that a tree may have, of which ``datasets/verify.py`` must tell."""

PHOTOGRAPHS = {"photo.jpg": 30.0, "front.jpg": 210.0, "left.jpg": 300.0, "above.jpg": 120.0}
"""And the azimuths from which they were taken."""


def reason(command: str) -> str | None:
    """Why a command is not typed; None where it is."""
    command = re.sub(r"\s+#.*", "", command)
    return next((why for start, why in NOT_HERE.items() if re.match(start, command)), None)


def pose(azimuth: float) -> torch.Tensor:
    """(4, 4) of the truck in m: its box is about 410 220 890 700."""
    points, box = torch.from_numpy(example_mesh().vertices.copy()), torch.tensor([410.0, 220.0, 890.0, 700.0])
    view = cr.rotation_from_viewpoint(torch.tensor(azimuth, dtype=torch.float64), 30.0, 0.0)
    return transform(*place_view(points, view, box, cr.camera_matrix(1450.0, 1450.0, 960.0, 540.0)))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages name: a part in mm, photographs of it, and datasets."""
    folder = tmp_path_factory.mktemp("newcomer")
    mesh, size = example_mesh(), (1080, 1920)
    small = torch.diag(torch.tensor([0.25, 0.25, 1.0], dtype=torch.float64))
    K = small @ cr.camera_matrix(1450.0, 1450.0, 960.0, 540.0, dtype=torch.float64)
    for seed, (name, azimuth) in enumerate(PHOTOGRAPHS.items()):
        generator = torch.Generator().manual_seed(seed)
        picture, _ = synthesize_photograph(mesh, pose(azimuth), K, (size[0] // 4, size[1] // 4), generator)
        pixels = (255 * picture.permute(1, 2, 0)).round().byte().numpy()[..., ::-1]
        cv2.imwrite(str(folder / name), cv2.resize(pixels, size[::-1]))
        with_exif(folder / name, exif(1, 28))
    kettle = folder / "data" / "mine" / "kettle"
    kettle.mkdir(parents=True)
    for name in ("1.jpg", "2.jpg"):
        shutil.copy(folder / "photo.jpg", kettle / name)
    (text,) = re.findall(r"```\n(image,.*?)```", (DOCS / "guides" / "own-data.md").read_text("utf-8"), flags=re.DOTALL)
    kettle.joinpath("views.csv").write_text(text)
    mesh.export(kettle / "mesh.stl")
    mesh.apply_scale(1000.0).export(folder / "part.stl")
    mesh.apply_scale([1.0, 1.0, 2.0]).export(folder / "tall.stl")
    folder.joinpath("photos.csv").write_text("photo,x0,y0,x1,y1\nphoto.jpg,410,220,890,700\nleft.jpg,380,240,900,690\n")
    write_image(folder / "photo.png", (128, 128))
    cv2.imwrite(str(folder / "depth.png"), cv2.imread(str(folder / "photo.png"), cv2.IMREAD_GRAYSCALE))
    write_pascal3d(folder / "data" / "PASCAL3D+_release1.1")
    write_bop(folder / "data" / "bop" / "lm")
    write_web(folder / "data" / "web")
    net = folder / "data" / "ObjectNet3D"
    for split in ("train", "val"):
        write_record(net / "Annotations" / f"{split}.mat", [pascal_object("ashtray")])
        write_image(net / "Images" / f"{split}.JPEG")
        net.joinpath("Image_sets").mkdir(exist_ok=True)
        net.joinpath("Image_sets", f"{split}.txt").write_text(f"{split}\n")
    write_mesh(net / "CAD" / "off" / "ashtray" / "01.off")
    return folder


@pytest.fixture
def here(files: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.chdir(files)
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
    torch.set_num_threads(threads)


def typed(words: list[str], monkeypatch: pytest.MonkeyPatch) -> int | str:
    """The exit code of a command, or what it says instead; run in this process."""
    program = Path(words[0]).name
    if "--jobs" in words:  # tests/evaluation/test_processes.py starts several
        words[words.index("--jobs") + 1] = "1"
    if program == "demo.sh":
        last = (ROOT / words[0]).read_text("utf-8").splitlines()[-1]
        program, *words = words_of(last.replace('"$venv/bin/curvireg"', "curvireg").replace('"$@"', ""))
        words = [program, *words]
    if program == "curvireg":
        monkeypatch.setattr(sys, "argv", words)
        return cli.main()
    if program == "torchrun":
        module = words.index("-m") + 1
        assert words[module] == "curvireg_torch.evaluation"
        monkeypatch.setattr(sys, "argv", words[module:])
        run, name = runpy.run_module, words[module]
    else:
        assert program == "python", words
        monkeypatch.setattr(sys, "argv", words[1:])
        run, name = runpy.run_path, str(ROOT / words[1])  # type: ignore[assignment]
    try:
        run(name, run_name="__main__")
    except SystemExit as stop:
        return stop.code or 0
    return 0


LONG = {DOCS / "evaluation.md", DOCS / "guides" / "several.md"}
"""Half a minute and more on one core: run with the slow tests."""


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=[pytest.mark.slow] if p in LONG else []) for p in PAGES if steps(p)],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_a_page_works_as_it_stands(
    page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, Any] = {"__name__": "page"}
    for kind, text in steps(page):
        if kind == "python":
            exec(compile(text, page.name, "exec"), names)
        elif reason(text) is None:
            words = words_of(text)
            expected = int("datasets/verify.py" in words and not set(words).isdisjoint(DEFECTIVE))
            assert typed(words, monkeypatch) == expected, (text, capsys.readouterr().err)
            if "register" in words and "photo.jpg" in words and not any(word.startswith("--up=") for word in words):
                result = json.loads(Path("out/part/result.json").read_text("utf-8"))
                R = torch.tensor(result["rotation"], dtype=torch.float64)
                # Without a camera the rotation is that of one that looks straight at the object.
                assert float(rotation_error(R, pose(30.0)[:3, :3])) < (20 if result["translation"] is None else 5)
    for name in re.findall(r"`((?:out|results)/[\w/.]+\.\w+)`", page.read_text(encoding="utf-8")):
        assert Path(name).is_file(), f"{name} is promised and was not written"


def test_what_is_not_typed_is_counted() -> None:
    commands = [text for page in PAGES for kind, text in steps(page) if kind == "command"]
    counts = Counter(map(reason, commands))
    assert counts.pop(None) >= 35
    assert counts == {
        "download": 10,
        "measures for long": 11,
        "placeholder": 7,
        "suite": 5,
        "writes into the project": 4,
        "3000 photographs": 2,
        "browser": 1,
    }
