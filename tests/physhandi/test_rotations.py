"""Best rotations, many at once, against what moments are made of and SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.rotations import best_rotations, unit


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e-12])
@pytest.mark.parametrize(
    "extent",
    [(1, 1, 1), (1, 0.6, 0.2), (1, 0.6, 0), (1, 1, -0.4), (1, 0.02, 0.01), (1, 0.3, -0.2999)],
    ids=["ball", "body", "sheet", "mirrored", "nearly a line", "in doubt"],
)
def test_rotations_are_those_that_moments_are_made_of(
    extent: tuple[float, float, float], size: float
) -> None:
    first, second = (
        Rotation.random(40, rng=np.random.default_rng(seed)).as_matrix() for seed in (1, 2)
    )
    moment = size * (first * extent) @ np.swapaxes(second, 1, 2)
    turned = best_rotations(moment)
    np.testing.assert_allclose(turned, first @ np.swapaxes(second, 1, 2), atol=1e-9)


def test_many_rotations_at_once_are_those_found_one_by_one() -> None:
    rng = np.random.default_rng(5)
    source, target = rng.normal(size=(2, 6, 7, 3))
    source[2], target[2] = np.arange(7)[:, None] * [1.0, 0, 0], np.arange(7)[:, None] * [0, 0, 2.0]
    covariance = np.einsum("fpi,fpj->fij", target, source)
    found = best_rotations(covariance)
    for number in (0, 1, 3, 4, 5):
        expected, _ = Rotation.align_vectors(target[number], source[number])
        assert found[number] == pytest.approx(expected.as_matrix())
    assert found[2] @ [1, 0, 0] == pytest.approx([0, 0, 1])


def test_points_that_leave_a_line_turn_about_it_little_by_little() -> None:
    # A line along x with a second extent, at rest along y and now along z: a quarter of a turn.
    def turned(second: float) -> np.ndarray:
        moment = np.zeros((3, 3))
        moment[0, 0], moment[2, 1] = 1.0, second
        return best_rotations(moment, thin=0.01)

    angle = [
        np.degrees(Rotation.from_matrix(turned(s)).magnitude()) for s in (0, 0.004, 0.006, 0.02)
    ]
    assert angle[0] == 0.0
    # Between them its second extent counts as what it is, and as much as lacks to 0.01 as unturned.
    assert angle[1] == pytest.approx(np.degrees(np.arctan2(0.004, 0.012)), rel=0.01)
    assert angle[1] < angle[2] < angle[3]
    assert angle[3] == pytest.approx(90.0)


def test_a_vector_without_a_length_stays_zero_among_unit_vectors() -> None:
    assert unit(np.array([[3.0, 0, 4], [0, 0, 0], [0, -2, 0]])) == pytest.approx(
        np.array([[0.6, 0, 0.8], [0, 0, 0], [0, -1, 0]])
    )
