import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import symmetry_transforms

AXIS, OFFSET = [1.0, 2.0, -2.0], [10.0, -4.0, 3.0]
CONTINUOUS = {"symmetries_continuous": [{"axis": AXIS, "offset": OFFSET}]}
HALF_TURN = [-1, 0, 0, 8, 0, -1, 0, 6, 0, 0, 1, 0, 0, 0, 0, 1]  # about the vertical line through (4, 3)


def test_symmetry_transforms_reads_matrices_row_by_row() -> None:
    assert torch.equal(symmetry_transforms({"diameter": 3.0}), torch.eye(4, dtype=torch.float64)[None])
    transforms = symmetry_transforms({"symmetries_discrete": [HALF_TURN]})
    assert transforms.shape == (2, 4, 4)
    np.testing.assert_array_equal(transforms[1], np.reshape(HALF_TURN, (4, 4)))
    np.testing.assert_allclose(transforms[1] @ torch.tensor([4.0, 3.0, 7.0, 1.0]).double(), [4.0, 3.0, 7.0, 1.0])


def test_symmetry_transforms_agrees_with_scipy_and_fixes_the_axis() -> None:
    transforms = symmetry_transforms(CONTINUOUS, max_step_fraction=0.1).numpy()
    assert len(transforms) == 32  # ceil(pi / 0.1)
    unit = np.array(AXIS) / 3.0
    for i, T in enumerate(transforms):
        np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec(unit * i * 2 * np.pi / 32).as_matrix(), atol=1e-12)
        for along in (-5.0, 0.0, 2.0):
            point = np.array(OFFSET) + along * unit
            np.testing.assert_allclose(T[:3, :3] @ point + T[:3, 3], point, atol=1e-12)


def test_symmetry_transforms_bounds_the_step_of_a_vertex() -> None:
    transforms = symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]})
    vertex = transforms[:, :3, 0] * 50.0  # of a disc of diameter 100
    steps = torch.linalg.vector_norm(vertex - vertex.roll(1, 0), dim=1)
    assert float(steps.max()) <= 1.0
    assert float(steps.min()) > 0.99  # and no finer than needed


def test_symmetry_transforms_applies_discrete_symmetries_first() -> None:
    info = {"symmetries_discrete": [HALF_TURN], **CONTINUOUS}
    both = symmetry_transforms(info, max_step_fraction=0.5)
    rotations = symmetry_transforms(CONTINUOUS, max_step_fraction=0.5).numpy()
    assert len(both) == 2 * len(rotations) == 14
    flip = np.reshape(HALF_TURN, (4, 4))
    products = [R @ s for R in rotations for s in (np.eye(4), flip)]
    np.testing.assert_allclose(both, products, atol=1e-12)
    assert torch.equal(both[0], torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize(
    ("info", "step", "match"),
    [
        ({"symmetries_discrete": [[1.0] * 12]}, 0.1, "expected 16"),
        ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}, 0.1, "length > 0"),
        ({"symmetries_continuous": [{"axis": [0, 1], "offset": [0, 0, 0]}]}, 0.1, "axis: expected 3"),
        *[({}, step, "max_step_fraction") for step in (0.0, 1.5, -0.1)],
    ],
)
def test_symmetry_transforms_refuses_malformed_input(info: dict[str, object], step: float, match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        symmetry_transforms(info, max_step_fraction=step)
