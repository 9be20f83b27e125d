"""Scores of an import against figures that were computed by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.metrics.capture import (
    along_the_table,
    camera_scores,
    mask_scores,
    track_scores,
    tracks_alive,
)
from physhandi.metrics.truth_metrics import TrueSurface


def mask(*labels: int) -> np.ndarray:
    return np.array([labels], dtype=np.uint8)


def pose(place: tuple[float, float, float], turn: float = 0.0) -> np.ndarray:
    """A camera that looks straight down, turned about its line of sight [degrees]."""
    found = np.diag([1.0, -1.0, -1.0, 1.0])
    found[:3, :3] = found[:3, :3] @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
    found[:3, 3] = place
    return found


def test_overlaps_are_those_of_each_image_on_average():
    found = [mask(1, 1, 1, 0, 2, 0), mask(0, 0, 0, 0, 0, 0)]
    true = [mask(1, 1, 0, 0, 2, 3), mask(0, 0, 0, 0, 2, 0)]
    # Object: 2 of 3, and an image without one that does not count; hands: 1 of 2, then 0 of 1.
    assert mask_scores(found, true) == {"object": pytest.approx(2 / 3), "hand": 0.25}
    nowhere = mask_scores([mask(0)], [mask(0)])
    assert np.isnan([nowhere["object"], nowhere["hand"]]).all()


def test_living_tracks_are_counted_in_the_worst_frame_of_each_view_and_of_all():
    one = np.array([[1, 1, 1], [1, 0, 0]], dtype=bool)
    other = np.array([[0, 0], [1, 1]], dtype=bool)
    assert tracks_alive([one, other]) == {"least_by_view": [1, 0], "least": 3}


def test_a_displaced_camera_is_off_by_what_it_was_displaced():
    true = [pose((0.0, 0.0, 0.8)), pose((0.5, 0.0, 0.8))]
    found = [true[0], pose((0.503, 0.0, 0.804))]
    scores = camera_scores(found, true)
    assert scores == pytest.approx({"shift": 0.005, "turn": 0.0, "tilt": 0.0}, abs=1e-12)
    turned = camera_scores([true[0], pose((0.5, 0.0, 0.8), 0.25)], true)
    assert turned["turn"] == pytest.approx(0.25)
    # A camera alone is right from where it stands, and its world may be tilted all the same.
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    alone = camera_scores([tilt @ true[0]], true[:1])
    assert alone == pytest.approx({"shift": 0.0, "turn": 0.0, "tilt": 2.0})


def test_a_world_that_lies_elsewhere_on_the_table_is_moved_back_and_is_no_error():
    true = [pose((0.0, 0.1, 0.8)), pose((0.5, 0.0, 0.7), 30.0)]
    move = np.eye(4)
    move[:3, :3] = Rotation.from_euler("z", 70.0, degrees=True).as_matrix()
    move[:3, 3] = [0.3, -0.2, 0.1]
    found = [np.linalg.inv(move) @ one for one in true]
    np.testing.assert_allclose(along_the_table(found, true, 0.1), move, atol=1e-12)
    assert max(camera_scores(found, true).values()) < 1e-6


def test_a_track_has_to_stay_on_the_surface_point_that_it_began_on():
    # A triangle that is lifted by 1 cm a frame and stretched to twice its width in frame 2.
    rise = np.array([0.0, 0.0, 0.01])
    corner = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    point = np.stack([corner, corner + rise, corner * [2, 1, 1] + 2 * rise])
    surface = TrueSurface(
        point=point,
        face=np.array([[0, 1, 2]]),
        sample_face=np.zeros(1, dtype=np.int64),
        sample_weight=np.array([[1.0, 0, 0]]),
    )
    track = np.full((3, 3, 3), np.nan)
    # Measured 1 mm above the surface: it began below that; then 3 mm beside where it should be.
    track[:, 0] = [[0.02, 0.02, 0.001], [0.02, 0.02, 0.01], [0.043, 0.02, 0.02]]
    # Begins in frame 1 and is left behind by the table's 2 cm in x.
    track[1:, 1] = [[0.02, 0.03, 0.01], [0.02, 0.03, 0.02]]
    scores = track_scores(track, surface)
    assert scores == {
        "median": pytest.approx(0.003),
        "mean": pytest.approx((0.0 + 0.003 + 0.020) / 3),
        "lost": pytest.approx(1 / 3),
        "points": 3,
    }
    assert track_scores(track[:, 2:], surface)["points"] == 0
