"""The sweep over what scripts/choose_appearance.py has measured."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import choose_appearance as script


def shot(ranked, appearance_scores, errors, mesh="car-0"):
    """Raw scores of one photograph of three views, 0, 40 and 80 degrees from the first, registered to ``mesh``."""
    angles = np.radians([0.0, 40.0, 80.0])
    turns = [[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles]
    both = {f"{s} {m}": np.tile(np.float16(appearance_scores), (7, 1)) for s in (8, 16) for m in ("all", "mask")}
    scores = {name: np.float32(ranked) for name in script.PRESETS}
    return {**both, **scores, "error": np.float32(errors), "rotation": np.float32(turns), "form": "exact", "mesh": mesh}


@pytest.fixture
def shots():
    # The ranking is wrong about the first, and the appearance knows; both are right about the second.
    first = shot([1.0, 0.8, 0.1], [0.1, 0.6, 0.1], [170, 5, 100])
    return [first, shot([0.2, 0.3, 1.0], [0.2, 0.1, 0.6], [90, 90, 7], mesh="car-1")]


def test_a_weight_turns_the_choice(shots):
    everything = np.arange(3)
    used = ("both", "all", 1)
    assert script.error_of_best(shots[0], "learned", used, 0.0, everything) == 170
    assert script.error_of_best(shots[0], "learned", used, 1.0, everything) == 5


def test_the_sweep_counts_what_is_gained(shots):
    rows = script.sweep(shots, "learned", "upright")
    assert rows[0] == {"preset": "learned", "n": 2, "variant": "without", "share": 0.5}
    assert len(rows) == 1 + len(script.VARIANTS["upright"]) * len(script.WEIGHTS)
    right = next(row for row in rows[1:] if row["weight"] == 1.0)
    assert (right["share"], right["gain"]) == (1.0, [0.5, 0.0, 1.0])
    alike = script.sweep([{**one, "mesh": "car-0"} for one in shots], "learned", "upright")
    assert next(row for row in alike[1:] if row["weight"] == 1.0)["gain"] == [0.5, 0.5, 0.5], "one CAD: nothing to vary"


def test_only_distinct_views_are_judged(shots):
    rotations = shots[0]["rotation"]
    assert script.distinct(np.array([2, 1, 0]), rotations, 50.0, 5).tolist() == [2, 0]
    assert script.distinct(np.array([2, 1, 0]), rotations, 30.0, 2).tolist() == [2, 1]


def test_photographs_come_back_from_their_files_and_into_the_table(shots, tmp_path):
    item = {"id": 0, "form": "exact", "pose": "upright"}
    raw = {f"{i} {k}": v for i, s in enumerate(shots) for k, v in {**s, "item": np.array(json.dumps(item))}.items()}
    np.savez(tmp_path / "car-0-1.npz", **raw)
    np.savez(tmp_path / "half.part.npz", **raw)
    read = list(script.photographs(tmp_path))
    assert [(float(s["error"][0]), s["mesh"]) for s in read] == [(170, "car-0-1"), (90, "car-0-1")]
    rows = [row for preset in script.PRESETS for row in script.sweep(read, preset, "upright")]
    lines = script.table({"poses": {"upright": rows}}).splitlines()
    assert "| upright | learned | 2 | without | | | | | 0.500 | |" in lines
    assert sum("| upright | learned | 2 | all | both | all | 1 |" in line for line in lines) >= len(script.WEIGHTS)
