import pytest
import torch

from curvireg_torch.data import BOPRow, read_bop_csv, write_bop_csv
from curvireg_torch.errors import InvalidInputError, MissingFileError
from curvireg_torch.geometry import rotation_from_viewpoint


def row(**changes):
    R = rotation_from_viewpoint(*torch.tensor([30.0, 20.0, 10.0], dtype=torch.float64))
    t = torch.tensor([1.0, -2.5, 1e3 / 3], dtype=torch.float64)
    return BOPRow({"scene_id": 1, "im_id": 2, "obj_id": 3, "score": 0.25, "R": R, "t": t, "time": 1.5, **changes})


def test_write_bop_csv_writes_the_documented_text(tmp_path):
    write_bop_csv(tmp_path / "a.csv", [row(R=torch.arange(9.0).reshape(3, 3), t=torch.tensor([0.5, 1, 2]))])
    assert (tmp_path / "a.csv").read_bytes() == (
        b"scene_id,im_id,obj_id,score,R,t,time\n1,2,3,0.25,0.0 1.0 2.0 3.0 4.0 5.0 6.0 7.0 8.0,0.5 1.0 2.0,1.5\n"
    )


def test_read_bop_csv_inverts_write_bop_csv(tmp_path):
    rows = [row(), row(score=-3.0), row(im_id=5, time=-1.0)]
    write_bop_csv(str(tmp_path / "a.csv"), iter(rows))
    back = read_bop_csv(str(tmp_path / "a.csv"))
    assert len(back) == 3
    for written, read in zip(rows, back, strict=True):
        torch.testing.assert_close(read, written, rtol=0, atol=0)
    write_bop_csv(tmp_path / "a.csv", [])
    assert read_bop_csv(tmp_path / "a.csv") == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": torch.eye(4)}, "row 1 R"),
        ({"t": torch.zeros(3, 1)}, "row 1 t"),
        ({"t": torch.tensor([0, 0, float("nan")])}, "finite"),
        ({"score": float("inf")}, "finite"),
        ({"scene_id": -1}, "ids"),
        ({"obj_id": 1.5}, "ids"),
        ({"time": 2.0}, "earlier row"),
        ({"extra": 0}, "keys"),
    ],
)
def test_write_bop_csv_leaves_the_file_if_a_row_is_invalid(tmp_path, change, message):
    (tmp_path / "a.csv").write_text("before")
    with pytest.raises(InvalidInputError, match=message):
        write_bop_csv(tmp_path / "a.csv", [row(), {**row(), **change}])
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
    assert (tmp_path / "a.csv").read_text() == "before"


def test_bop_csv_reports_missing_paths(tmp_path):
    with pytest.raises(MissingFileError, match="create it"):
        write_bop_csv(tmp_path / "nothing" / "a.csv", [])
    with pytest.raises(MissingFileError, match="no such file"):
        read_bop_csv(tmp_path / "a.csv")


HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"
GOOD = "1,2,3,0.5,1 0 0 0 1 0 0 0 1,0 0 1,-1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header"),
        (GOOD, "header"),
        (HEADER + GOOD + "1,2,3,0.5\n", "line 3.*7 columns"),
        (HEADER + GOOD.replace("0.5", "x"), "line 2"),
        (HEADER + GOOD.replace("0 0 1,", "0 1,"), "got 8 and 2"),
        (HEADER + GOOD.replace("0.5", "nan"), "finite"),
        (HEADER + GOOD.replace("1,2", "1.5,2", 1), "line 2"),
        (HEADER + GOOD + GOOD.replace("-1", "4"), "line 3.*earlier row"),
        (HEADER.encode() + b"\xff\xfe\x00", "not a csv"),
    ],
)
def test_read_bop_csv_refuses_invalid_lines(tmp_path, text, message):
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InvalidInputError, match=message):
        read_bop_csv(tmp_path / "a.csv")
