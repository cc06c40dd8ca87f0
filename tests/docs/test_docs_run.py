"""The commands and Python blocks of each page run in order, in a folder with the files that the
pages name."""

import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import cv2
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch import cli
from curvireg_torch.geometry import rotation_error, transform
from curvireg_torch.geometry.cameras import pose_from_box
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support import double, seeded

from .._support import miniature
from .._support.exif import exif, with_exif
from .._support.pages import DOCS, PAGES, ROOT, split_command, steps
from .._support.peers import write_peers
from ..formats.meshes.step import step_file

# Commands that are not run here, and the reason
SKIPPED = {
    r"git |(\S*/)?pip |apt-get |python datasets/download|python -m zipfile|python scripts/benchmark/meshes": "download",  # noqa: E501
    r"(\S*/)?curvireg inspect": "a minute",  # tests/inspection runs it
    r"(\S*/)?curvireg view": "browser",  # tests/viewer/test_browser_use.py opens it
    r"scripts/test\.sh|python -m (coverage|mutmut)|python scripts/robustness/wrong_inputs\.py": "test suite",  # noqa: E501
    r"python (scripts/results_table|docs/(command_reference|make_pictures))": "writes into the project",  # noqa: E501
    r".*[ /=$][A-Z]+([ ./]|$)": "placeholder",
    r"curvireg register .*--field": "needs trained weights",
    r"curvireg .* /data/": "needs a generated benchmark",
    r"python scripts/(?!paper/)": "long measurement",
}
# Trees with every defect that datasets/verify.py must report
DEFECTIVE = ("data/PASCAL3D+_release1.1", "data/bop/lm", "data/web")
AZIMUTHS = {"photo.jpg": 30.0, "front.jpg": 210.0, "left.jpg": 300.0, "above.jpg": 120.0}
FIRST_PAGES = (ROOT / "README.md", DOCS / "getting-started.md")
SLOW = {
    *("evaluation", "datasets", "several", "coming-from", "boxes", "without-a-box", "unit-and-up"),
    *("layers", "how-sure", "photographs", "several-photographs", "known-pose", "cameras"),
    *("follow", "pose-prior", "many", "results", "architecture"),
}  # the others run some seconds


PHOTO_CAMERA = cr.camera_matrix(1450.0, 1450.0, 960.0, 540.0)


def pose(azimuth):
    """(4, 4) pose of the truck in m, whose box is about 410 220 890 700."""
    points = torch.from_numpy(example_mesh().vertices.copy())
    box = torch.tensor([410.0, 220.0, 890.0, 700.0])
    view = cr.rotation_from_viewpoint(double(azimuth), 30.0, 0.0)
    return transform(*pose_from_box(points, view, box, PHOTO_CAMERA))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a part in mm, photographs of it, and datasets."""
    folder = tmp_path_factory.mktemp("newcomer")
    mesh = example_mesh()
    size = (1080, 1920)
    quarter = torch.diag(double([0.25, 0.25, 1.0]))
    K = quarter @ PHOTO_CAMERA.double()
    for seed, (name, azimuth) in enumerate(AZIMUTHS.items()):
        generator = seeded(seed)
        picture, _ = synthesize_photograph(
            mesh, pose(azimuth), K, (size[0] // 4, size[1] // 4), generator
        )
        pixels = (255 * picture.permute(1, 2, 0)).round().byte().numpy()[..., ::-1]
        cv2.imwrite(str(folder / name), cv2.resize(pixels, size[::-1]))
        with_exif(folder / name, exif(1, 28))
    kettle = folder / "data" / "mine" / "kettle"
    kettle.mkdir(parents=True)
    (folder / "shots").mkdir()
    for name in ("1.jpg", "2.jpg"):
        shutil.copy(folder / "photo.jpg", kettle / name)
        shutil.copy(folder / "photo.jpg", folder / "shots" / name)
    (table,) = re.findall(
        r"```\n(image,.*?)```", (DOCS / "datasets.md").read_text("utf-8"), flags=re.DOTALL
    )
    kettle.joinpath("views.csv").write_text(table)
    mesh.export(kettle / "mesh.stl")
    write_peers(folder, folder / "photo.jpg", mesh, pose(AZIMUTHS["photo.jpg"]), PHOTO_CAMERA)
    mesh.apply_scale(1000.0).export(folder / "part.stl")
    folder.joinpath("part.step").write_text(step_file(mesh.extents.tolist(), "mm"))
    mesh.apply_scale([1.0, 1.0, 2.0]).export(folder / "tall.stl")
    folder.joinpath("photos.csv").write_text(
        "photo,x0,y0,x1,y1\nphoto.jpg,410,220,890,700\nleft.jpg,380,240,900,690\n"
    )
    miniature.write_image(folder / "photo.png", (128, 128))
    cv2.imwrite(
        str(folder / "depth.png"), cv2.imread(str(folder / "photo.png"), cv2.IMREAD_GRAYSCALE)
    )
    miniature.write_pascal3d(folder / DEFECTIVE[0])
    miniature.write_bop(folder / DEFECTIVE[1])
    miniature.write_web(folder / DEFECTIVE[2])
    net = folder / "data" / "ObjectNet3D"
    for split in ("train", "val"):
        miniature.write_record(
            net / "Annotations" / f"{split}.mat", [miniature.pascal_object("ashtray")]
        )
        miniature.write_image(net / "Images" / f"{split}.JPEG")
        net.joinpath("Image_sets").mkdir(exist_ok=True)
        net.joinpath("Image_sets", f"{split}.txt").write_text(f"{split}\n")
    miniature.write_mesh(net / "CAD" / "off" / "ashtray" / "01.off")
    return folder


@pytest.fixture
def in_folder(files, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.chdir(files)
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
    torch.set_num_threads(threads)


def run_command(words, monkeypatch):
    """Run a command in this process; its exit code or message."""
    program = Path(words[0]).name
    if "--jobs" in words:  # tests/jobs/test_processes.py starts several
        words[words.index("--jobs") + 1] = "1"
    if "--scheduler" in words:  # tests/utils/test_executors.py starts a cluster
        place = words.index("--scheduler")
        words = words[:place] + words[place + 2 :]
    if program == "demo.sh":
        last = (ROOT / words[0]).read_text("utf-8").splitlines()[-1]
        words = split_command(last.replace('"$venv/bin/curvireg"', "curvireg").replace('"$@"', ""))
    if program == "python":
        monkeypatch.setattr(sys, "argv", words[1:])
        try:
            runpy.run_path(str(ROOT / words[1]), run_name="__main__")
        except SystemExit as stop:
            return stop.code or 0
        return 0
    assert words[0].endswith(("curvireg", "curvireg_torch")), words
    monkeypatch.setattr(sys, "argv", words)
    return cli.main()


def run_steps(page, monkeypatch, capsys):
    """Run the steps of a page but the skipped ones: of each the words, none of Python, the exit
    code or message, and what it prints."""
    names = {"__name__": "page"}
    for kind, text in steps(page):
        capsys.readouterr()
        if kind == "python":
            exec(compile(text, page.name, "exec"), names)
            yield [], 0, capsys.readouterr()
        elif not any(re.match(start, re.sub(r"\s+#.*", "", text)) for start in SKIPPED):
            words = split_command(text)
            code = run_command(words, monkeypatch)
            yield words, code, capsys.readouterr()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_of_a_page_have_the_options_and_blocks_of_python_are_python(page):
    for kind, text in steps(page):
        if kind == "python":
            compile(text, page.name, "exec")
        elif re.match(r"(\S*/)?curvireg (?!.*([ /=$][A-Z]+([ ./]|$)|[|<>&]|--version))", text):
            cli.parse(split_command(text)[1:])


@pytest.mark.usefixtures("in_folder")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, marks=[pytest.mark.slow] if p.stem in SLOW else [])
        for p in PAGES
        if steps(p) and p not in FIRST_PAGES
    ],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_page_runs(page, monkeypatch, capsys):
    for words, code, printed in run_steps(page, monkeypatch, capsys):
        expected = int("datasets/verify.py" in words and not set(words).isdisjoint(DEFECTIVE))
        assert code == expected, (words, printed.err)
        if {"register", "photo.jpg"} <= set(words) and "--up=" not in " ".join(words):
            result = json.loads(Path("out/part/result.json").read_text("utf-8"))
            R = double(result["rotation"])
            # without a camera R is allocentric
            allowed = 20 if result["translation"] is None else 5
            assert rotation_error(R, pose(30.0)[:3, :3]) < allowed
    check_promised(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", FIRST_PAGES, ids=lambda page: page.stem)
def test_the_first_pages_run_on_the_files_of_the_demo_alone(
    page, tmp_path, tmp_path_factory, monkeypatch, capsys
):
    """Typed as they stand, in a folder that holds nothing else."""
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.chdir(tmp_path)
    registered = 0
    for words, code, printed in run_steps(page, monkeypatch, capsys):
        assert code == 0, (words, printed.err)
        registered += "register" in words
        if not words:
            check_printed(page, printed.out)
    demo, found = (
        json.loads(path.read_text()) for path in sorted(Path("out").glob("*/result.json"))
    )
    R, truth = (
        torch.tensor(rotation) for rotation in (found["rotation"], demo["truth"]["rotation"])
    )
    assert (registered, float(rotation_error(R, truth)) < 5.0) == (1, True)
    check_promised(page)


def check_promised(page):
    """The files that a page names are there."""
    for name in re.findall(r"`((?:out|results)/[\w/.]+\.\w+)`", page.read_text(encoding="utf-8")):
        assert Path(name).is_file(), f"the page promises {name}"


def check_printed(page, printed):
    """The page shows what its block prints, but for the last digits."""
    shown = re.search(r"```text\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    if shown is None:
        return
    texts = [re.sub(r"-?\d+(?:\.\d+)?", "#", text) for text in (shown[1], printed)]
    assert texts[0] == texts[1]
    numbers = [[float(n) for n in re.findall(r"-?\d+(?:\.\d+)?", t)] for t in (shown[1], printed)]
    assert numbers[1] == pytest.approx(numbers[0], abs=0.06, rel=0.02)
