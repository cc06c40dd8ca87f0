"""Coarse-to-fine search around a view, of the preset "paper"."""

from typing import Any

import torch
from torch import Tensor

from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.registration.poses import Poses
from curvireg_torch.registration.search import search
from tests._support.scenes import CAMERA, scene, truck_registrar


def rotation(x: float, y: float, z: float) -> Tensor:
    """(3, 3) of an axis-angle vector in degrees."""
    return rotation_from_axis_angle(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))


class RotationDescriber:
    """Describes a view by its rotation: the similarity of two is (1 + 2 cos of the angle between them) / 3."""

    def descriptors(self, rotations: Tensor, _: Tensor) -> Tensor:
        return rotations.flatten(1)


def searched(truth: Tensor, start: Tensor) -> Tensor:
    """(3, 3) rotation that a search for ``truth`` finds."""
    none = torch.zeros(1, dtype=torch.float64)
    index = torch.zeros(1, dtype=torch.long)
    poses = Poses(index, index, none, start[None], none, none, none, none, none, none, none, none)
    describer: Any = RotationDescriber()
    return search(describer, truth.flatten()[None], poses)[0]


def test_search_converges_to_the_truth_and_stays_near_the_start():
    truth, start = rotation(3.0, -6.0, 4.0), rotation(0, 0, 0)
    assert float(rotation_error(searched(truth, start), truth)) < 1.5
    for away in (16.0, 40.0, 170.0):
        assert 10.0 < float(rotation_error(searched(rotation(0.0, away, 0.0), start), start)) <= 15.0


def test_registrar_searches_if_it_is_told_to():
    """Views are 15 degrees apart: without contours, the search alone gets nearer."""
    errors: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(4):
        image, box, T = scene(seed)
        for search_first in (True, False):
            result = truck_registrar(search=search_first, contours=False)([image], box[None], CAMERA)[0]
            errors[search_first].append(float(rotation_error(result.rotation, T[:3, :3])))
    assert sorted(errors[True])[1] < sorted(errors[False])[1]
