import numpy as np
import pytest

from physhandi.perception.centre_line import centre_lines


def helix(count: int) -> np.ndarray:
    turn = np.linspace(0, 3 * np.pi, count)
    return np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), 0.02 * turn], axis=1)


def test_a_centre_line_is_as_long_as_the_thing_whatever_the_noise():
    random = np.random.default_rng(0)
    axis = helix(2000)
    true = float(np.linalg.norm(np.diff(axis, axis=0), axis=1).sum())
    for noise in (0.0, 0.001, 0.003):
        around = random.normal(size=axis.shape)
        around *= 0.004 / np.linalg.norm(around, axis=1, keepdims=True)
        (line,) = centre_lines(axis + around + noise * random.normal(size=axis.shape), 0.01)
        assert line.length == pytest.approx(true, rel=0.02)
        place = line.at(np.linspace(0.0, line.length, 50))
        nearest = np.linalg.norm(place[:, None] - axis, axis=-1).min(axis=1)
        assert nearest.max() < 0.004
        np.testing.assert_allclose(line.arc_of(place), np.linspace(0, line.length, 50), atol=1e-6)


def test_a_few_points_behind_an_end_move_it_by_their_share():
    random = np.random.default_rng(2)
    along = np.linspace(0.0, 0.4, 1600)
    across = random.normal(size=(1600, 2))
    across *= 0.004 / np.linalg.norm(across, axis=1, keepdims=True)
    rod = np.column_stack([along, across])
    # A row of pixels of the table behind the end: eight points, 2 mm of the rod has as many.
    behind = np.column_stack([np.full(8, 0.408), np.linspace(-0.003, 0.003, 8), np.full(8, -0.004)])
    lengths = []
    for cloud in (rod, np.concatenate([rod, behind]), rod[along < 0.39]):
        (line,) = centre_lines(cloud, 0.008)
        lengths.append(line.length)
    assert lengths[0] == pytest.approx(0.4, abs=1e-3)
    assert lengths[0] + 1e-3 < lengths[1] < lengths[0] + 3e-3
    assert lengths[0] - lengths[2] == pytest.approx(0.01, abs=1e-3)


def star(arms: int) -> np.ndarray:
    away = np.linspace(0.0, 0.1, 200)[:, None]
    turns = 2 * np.pi * np.arange(arms) / arms
    return np.concatenate([away * [np.cos(t), np.sin(t), 0.0] for t in turns])


@pytest.mark.parametrize(
    "cloud",
    [
        star(3),
        star(4),
        helix(4000)[:2666] * [1, 1, 0],
        np.random.default_rng(1).uniform(0, 0.1, (800, 3)) * [1, 1, 0],
        np.random.default_rng(1).uniform(0, 0.01, (50, 3)),
        np.zeros((0, 3)),
    ],
    ids=["three arms", "crossed", "closed", "sheet", "lump", "nothing"],
)
def test_what_is_no_line_gets_none(cloud):
    assert centre_lines(cloud, 0.008) == ()
