"""Nothing is lost or mixed up: photographs of one name, and files that exist."""

import shutil

import pytest

from curvireg_torch.cli import main
from curvireg_torch.formats.exports.ros import FILES
from curvireg_torch.jobs.outputs import MARKER, output_folder
from tests._support import scene, slow_after, write_video
from tests._support.lists import CAMERA, box_of, check_pose, table, written
from tests._support.tables import text_table

SOURCES = [
    ("left/shot.png", "right/shot.png"),
    ("left/cam.avi", "right/cam.avi"),
    ("a.avi", "a.mkv"),
    ("x/shots/cam.avi", "y/shots/cam.avi"),
]


@pytest.mark.parametrize(("first", "second"), slow_after(2, SOURCES))
def test_sources_of_one_name_keep_their_own_results(folder, register, tmp_path, first, second):
    sources = [tmp_path / first, tmp_path / second]
    for seed, source in enumerate(sources):
        if source.suffix == ".png":
            source.parent.mkdir()
            shutil.copy(folder / "photos" / f"{seed}.png", source)
        else:
            write_video(source, [scene(seed)[0]])
    words = [folder / "truck.safetensors", "--box", *box_of(0)]
    assert register(*sources, *words) == 0
    rows = table(tmp_path / "out")
    frame = "" if first.endswith("png") else ":000000"
    assert [row["photo"] for row in rows] == [f"{source}{frame}" for source in sources]
    assert rows[0]["r11"] != rows[1]["r11"]
    check_pose(rows[0], scene(0)[2], 15.0, 1.0)
    assert register(*sources[::-1], *words) == 0
    assert [row["r11"] for row in table(tmp_path / "out")] == [row["r11"] for row in rows[::-1]]


def test_register_overwrites_no_input(folder, register_one, register, refused, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--camera", *CAMERA]
    assert register_one("--no-refine", *words) == 0
    capsys.readouterr()
    row = [folder / "photos" / "0.png", *box_of(0)]
    listed = written(out / "results.csv", "photo,x0,y0,x1,y1", row)
    before = {path: path.read_bytes() for path in out.iterdir()}
    result = out / "result.json"
    refused(register_one(*words, "--start", result, box=()), "result.json: an input of this")
    refused(register_one(*words, "--start", f"{result}:0", box=()), "result.json")
    refused(register_one(*words, photo=out / "overlay.png"), "overlay.png: an input of this")
    refused(register_one(*words, mesh=out / "pose.glb"), "pose.glb: an input of this command")
    refused(register("--list", listed, folder / "truck.ply"), "results.csv: an input of this")
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_second_list_does_not_remove_the_rows_of_the_first(folder, register, refused, tmp_path):
    out = tmp_path / "out"
    rows = [[f"photos/{seed}.png", *box_of(seed)] for seed in (0, 1)]
    header = "photo,x0,y0,x1,y1"
    first, second = (written(folder / f"{k}.csv", header, row) for k, row in enumerate(rows))
    with output_folder(out, "register several", source=[str(first.resolve())]):
        (out / "index.html").write_text("rows")
    bank = folder / "truck.safetensors"
    lost = "0.csv, which would be lost"
    refused(register("--list", second, bank), "out/index.html: holds results of", lost)
    refused(register(*(folder / row[0] for row in rows), bank), lost)
    assert (out / "index.html").read_text() == "rows"


def test_demo_plot_and_bank_overwrite_no_file_of_others(folder, refused, tmp_path):
    for name in ("mesh.ply", "photo.png", "plot.png", "plot.svg", "bank.safetensors"):
        (tmp_path / name).write_text("of others")
    photo = tmp_path / "shot.png"
    shutil.copy(folder / "photos" / "0.png", photo)

    def run(command, *words, out):
        return main([*command.split(), *map(str, words), "--out", str(tmp_path / out), "--quiet"])

    files = [photo, folder / "truck.safetensors", "--box", *box_of(0)]
    refused(run("demo", out=""), "mesh.ply: not written by this command")
    for name in ("plot.png", "plot.svg"):
        refused(run("plot overlay", *files, out=name), f"{name}: exists")
    for _ in range(2):
        assert run("plot viewpoints", *files, "--mesh-is", "similar", out="mine.png") == 0
    refused(run("plot overlay", *files[:2], out="shot.png"), "shot.png: an input")
    refused(run("bank", folder / "truck.ply", out="bank.safetensors"), "bank.safetensors: exists")
    assert {path.read_text() for path in tmp_path.glob("[bp]*") if path.name != "mine.png"} == {
        "of others"
    }


FAILURES = """\
text.jpg truck.safetensors
missing.png truck.safetensors
flat.png truck.safetensors
photos/1.png missing.ply
photos/1.png truck.safetensors --camera missing.yaml"""


@pytest.mark.parametrize("words", FAILURES.splitlines())
def test_a_photograph_that_fails_leaves_no_result_of_another(register_one, tmp_path, words):
    """A robot would read the old pose."""
    out = tmp_path / "out"
    with output_folder(out, "register"):
        for name in ("result.json", "overlay.png", "pose.glb", *FILES):
            (out / name).write_text("of another photograph")
    photo, mesh, *options = words.split()
    given = [*(options or ["--camera", *CAMERA]), "--no-refine", "--format", "ros"]
    assert register_one(*given, photo=photo, mesh=mesh) == 2
    assert {path.name for path in out.iterdir()} == {MARKER}


MISTAKES = text_table("""
register         |              | photos/0.png truck.safetensors              | --pipeline --start
register         |              | photos/0.png truck.safetensors              | --boxes --camera
register         |              | photos/0.png truck.safetensors              | --field
register several | results.csv  | photos/0.png photos/1.png truck.safetensors | --pipeline --boxes
follow           | results.csv  | photos truck.safetensors                    | --pipeline --start
follow           | results.csv  | photos truck.safetensors                    | --boxes --field
inspect          | inspect.json | truck.ply                                   | --pipeline
demo             | result.json  |                                             | --pipeline
""")
"""Commands, a result that stays, files, and options that name a file which does not exist."""


@pytest.mark.parametrize(
    ("command", "name", "files", "option"),
    [(*case, option) for *case, some in MISTAKES for option in some.split()],
)
def test_a_mistake_in_an_option_makes_and_empties_no_folder(
    folder, refused, tmp_path, monkeypatch, command, name, files, option
):
    monkeypatch.chdir(folder)
    camera = ["--camera", *CAMERA] if option in ("--start", "--boxes") else []
    out = tmp_path / "out"
    words = [command.split()[0], *files.split(), *camera, option, "none.json", "--quiet"]
    refused(main([*words, "--out", str(out)]), "none.json")
    assert not out.exists()
    if name:  # of one photograph, the pose of another one goes, see above
        with output_folder(out, command):
            (out / name).write_text("an earlier result")
        refused(main([*words, "--out", str(out)]), "none.json")
        assert (out / name).read_text() == "an earlier result"
