"""Contours by what exceeds chance: closed cases of a plate and a roof, and a rendered box."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.rendering.contours import MeshContours
from tests._support import double, eye, seeded
from tests.fitting.cube import edges_in
from tests.rendering.test_creases import strip

K = double([[4000.0, 0.0, 99.5], [0.0, 4000.0, 99.5], [0.0, 0.0, 1.0]])
FRONT = transform(eye(3), double([0.0, 0.0, 40.0]))
BOX = torch.tensor([40.0, 40.0, 160.0, 160.0])


def plate():
    return trimesh.creation.box((1.0, 1.0, 0.02))


def roof(*, ridges=1):
    """The plate with ridges towards the camera, which are creases within the outline."""
    x = np.linspace(-0.5, 0.5, 2 * ridges + 1)
    z = np.where(np.arange(len(x)) % 2 == 1, -0.4 / ridges, 0.0)
    return strip(x, z)


def photograph(*, line=0.0, noise=0.0):
    """(3, 200, 200) a bright square where the plate is, its right half darker by ``line``."""
    image = torch.full((3, 200, 200), 0.2)
    image[:, 50:150, 50:150] = 0.8
    image[:, 50:150, 100:150] -= line
    generator = seeded(0)
    return (image + noise * torch.randn(image.shape, generator=generator)).clamp(0.0, 1.0)


def measured(mesh, image, *T):
    """Support and evidence of poses, by default that in front of the camera."""
    return edges_in(image, BOX, MeshContours(mesh), K, torch.stack(T or (FRONT,)))


def test_the_outline_counts_by_its_strength_minus_that_beside_it():
    support, evidence = measured(plate(), photograph())
    # Shifted by 10 px, in px of the crop, in eight directions: two stay on their edge.
    assert float(evidence) == pytest.approx(0.75 * float(support), rel=0.05)
    assert float(support) > 0.7


@pytest.mark.parametrize("line", [0.02, 0.04])
def test_a_weak_crease_that_is_there_raises_the_evidence_and_lowers_the_support(line):
    image = photograph(line=line)
    support_of_outline, outline = measured(plate(), image)
    support_of_both, both = measured(roof(), image)
    assert float(support_of_both) < float(support_of_outline) - 0.05
    assert float(both) > float(outline) + 0.02


def test_creases_that_are_not_there_neither_raise_nor_lower_it():
    image = photograph(noise=0.01)
    _, outline = measured(plate(), image)
    _, more = measured(roof(ridges=3), image)
    assert float(more) == pytest.approx(float(outline), abs=0.05)


def test_few_points_within_count_by_their_number():
    """A crease as strong as the outline, of half as many points."""
    image = photograph(line=0.5)
    _, outline = measured(plate(), image)
    _, both = measured(roof(), image)
    strongest = 0.75 * 0.77  # of an edge, minus chance
    assert 0.4 * strongest < float(both - outline) < 0.6 * strongest


def test_a_pose_beside_the_object_has_about_none():
    beside = transform(eye(3), double([0.25, -0.25, 40.0]))
    turned = FRONT.clone()
    turned[:3, :3] = rotation_from_viewpoint(40.0, 50.0, 30.0).double()
    _, evidence = measured(plate(), photograph(), FRONT, beside, turned)
    assert abs(float(evidence[1])) < 0.15 * float(evidence[0])
    assert abs(float(evidence[2])) < 0.15


def test_points_outside_the_photograph_do_not_count():
    """A plate of which the right half is outside: what is seen has the same evidence."""
    _, whole = measured(plate(), photograph())
    _, seen = measured(plate(), photograph()[:, :, :110])
    assert float(seen) == pytest.approx(float(whole), rel=0.1)
