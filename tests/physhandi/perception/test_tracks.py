import numpy as np

from physhandi.data.camera import PinholeCamera
from physhandi.perception.tracks import lift_pixels, motion_validity

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 10], [0, 100.0, 10], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=21,
    height=21,
)


def test_depth_is_interpolated_between_pixels():
    ramp = 0.5 + 0.001 * np.arange(21)[None, :] * np.ones((21, 1))
    point = lift_pixels(CAMERA, ramp, np.ones((21, 21), bool), np.array([[12.25, 7.5]]))
    np.testing.assert_allclose(point[0], [0.0225 * 0.51225, -0.025 * 0.51225, 0.51225])


def test_positions_at_holes_edges_borders_and_off_the_object_are_not_lifted():
    depth = np.full((21, 21), 0.5)
    depth[5, 5] = 0.0
    depth[:, 12:] = 0.53
    is_object = np.ones((21, 21), bool)
    is_object[18] = False
    pixel = np.array([[5.5, 5.5], [11.5, 2], [3, 17.5], [20.5, 3], [-0.5, 3], [np.nan, 1], [2, 2]])
    known = np.isfinite(lift_pixels(CAMERA, depth, is_object, pixel)).all(axis=1)
    assert known.tolist() == [False] * 6 + [True]


def field(frames: int) -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(8) * 0.0049, np.arange(8) * 0.0049, [0.0]), -1).reshape(
        -1, 3
    )
    return np.stack([grid + np.array([0.02 * frame, 0, 0]) for frame in range(frames)])


def test_a_track_that_moves_unlike_its_neighbours_is_not_trusted():
    point = field(3)
    point[1:, 27] += [0, 0.012, 0]
    valid = motion_validity(point, np.ones(point.shape[:2], bool))
    assert not valid[0].any()
    assert valid[1].sum() == 63
    assert not valid[1, 27]
    assert valid[2].all()  # From then on it moves along again.


def test_an_unseen_end_makes_a_motion_invalid_and_lonely_tracks_cannot_be_judged():
    point, seen = field(2), np.ones((2, 64), bool)
    seen[1, 0] = False
    assert motion_validity(point, seen)[1].sum() == 63
    assert motion_validity(point[:, :4], np.ones((2, 4), bool)).sum() == 0


def test_the_order_of_tracks_does_not_matter():
    random = np.random.default_rng(3)
    point = field(2)
    point[1] += random.normal(0, 0.002, point[1].shape)
    seen = random.random((2, 64)) < 0.9
    order = random.permutation(64)
    valid = motion_validity(point, seen)
    assert 5 < valid.sum() < 60
    np.testing.assert_array_equal(motion_validity(point[:, order], seen[:, order]), valid[:, order])


def test_a_sparse_field_is_judged_over_a_wider_radius():
    point = field(2) * 4
    assert motion_validity(point, np.ones((2, 64), bool))[1].all()
