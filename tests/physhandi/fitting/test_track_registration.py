"""Where tracks that begin late were in frame 0, and which ones slide."""

from dataclasses import replace

import numpy as np
import pytest

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.observed.track_registration import SLIDE, with_late_tracks

FRAMES = 8
SPACING = 0.01
COLUMN, ROW = np.meshgrid(np.arange(14), np.arange(10), indexing="ij")
NODE = np.stack([COLUMN, ROW, 0 * ROW], axis=-1).reshape(-1, 3) * SPACING
SURFACE = np.stack(np.meshgrid(np.arange(44), np.arange(31), 0), axis=-1).reshape(-1, 3) * 0.003
EARLY = np.random.default_rng(0).uniform([0, 0, 0], [0.13, 0.09, 0], (60, 3))
LATE = np.array([[0.03, 0.041, 0], [0.077, 0.052, 0], [0.11, 0.03, 0], [0.02, 0.07, 0]])
BEGIN = [3, 2, 5, 4]
SLIDING = 7
"""A track that shifts over the sheet by 5 mm a frame."""


def bent(place: np.ndarray, frame: int) -> np.ndarray:
    """Roll a sheet up about y by degrees, without stretching it, and carry it away [m]."""
    curve = 1e-9 + 1.2 * frame
    x, y, _ = place.T
    rolled = np.stack([np.sin(curve * x) / curve, y, (1 - np.cos(curve * x)) / curve], axis=-1)
    turn = 0.06 * frame
    rotation = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    return rolled @ np.array(rotation).T + frame * np.array([0.004, -0.002, 0.006])


def observed(*, cloud: bool = True) -> ObjectObservation:
    slid = [
        frame * np.array([0.005, 0, 0]) * (np.arange(60) == SLIDING)[:, None]
        for frame in range(FRAMES)
    ]
    point = np.stack([bent(EARLY + slid[frame], frame) for frame in range(FRAMES)])
    late = np.stack([bent(LATE, frame) for frame in range(FRAMES)])
    beside = np.full((FRAMES, 1, 3), np.nan)
    beside[3:] = [0.3, 0.3, 0.3]
    for track, begin in enumerate(BEGIN):
        late[:begin, track] = np.nan
    half = np.arange(60) < 45  # Others are hidden at the end, as by a hand.
    point[5:, ~half] = np.nan
    is_visible = np.isfinite(point).all(axis=2)
    return ObjectObservation(
        point=point.astype(np.float32),
        is_visible=is_visible,
        is_motion_valid=np.zeros_like(is_visible),
        cloud=tuple(bent(SURFACE, f).astype(np.float32) for f in range(FRAMES)) if cloud else (),
        late=np.concatenate([late, beside], axis=1).astype(np.float32),
    )


@pytest.mark.parametrize("cloud", [True, False])
def test_late_tracks_are_bound_to_their_places_on_the_object(*, cloud: bool) -> None:
    found = with_late_tracks(observed(cloud=cloud), NODE, FRAMES)
    assert found.track_count == 65
    assert found.late is None
    np.testing.assert_allclose(found.point[0, 60:64], LATE, atol=0.002)
    np.testing.assert_array_equal(found.point[0, :60], EARLY.astype(np.float32))
    assert found.is_visible[0].tolist() == [True] * 64 + [False]
    assert np.isnan(found.point[0, 64]).all()
    for track, begin in enumerate(BEGIN, start=60):
        assert found.is_visible[1:begin, track].sum() == 0
        assert found.is_visible[begin:, track].all()
        np.testing.assert_array_equal(
            found.point[begin:, track], observed().late[begin:, track - 60]
        )
        assert not found.is_motion_valid[: begin + 1, track].any()
        assert found.is_motion_valid[begin + 1 :, track].all()


def test_a_track_that_slides_is_hidden_once_it_is_away() -> None:
    found = with_late_tracks(observed(), NODE, FRAMES)
    away = 0.005 * np.arange(FRAMES)
    is_seen = found.is_visible[:, SLIDING]
    assert is_seen[away < SLIDE - 0.005].all()
    assert not is_seen[away > SLIDE + 0.005].any()
    assert not found.is_motion_valid[~is_seen, SLIDING].any()
    assert np.isnan(found.point[~is_seen, SLIDING]).all()
    others = np.arange(45) != SLIDING
    assert found.is_visible[:, :45][:, others].all()


@pytest.mark.parametrize("noise", [0.001, 0.003], ids=["a sensor's", "three times that"])
def test_noise_hides_no_track_that_follows(noise: float) -> None:
    random = np.random.default_rng(1)
    seen = observed()
    for array in (seen.point, seen.late):
        array[:] = array + random.normal(0.0, noise, array.shape).astype(np.float32)
    found = with_late_tracks(seen, NODE, FRAMES)
    follows = np.arange(64) != SLIDING
    expected = np.isfinite(np.concatenate([seen.point, seen.late], axis=1)).all(axis=2)
    np.testing.assert_array_equal(
        found.is_visible[1:, :64][:, follows], expected[1:, :64][:, follows]
    )
    assert found.is_visible[:2, SLIDING].all()
    assert not found.is_visible[6:, SLIDING].any()
    np.testing.assert_allclose(found.point[0, 60:64], LATE, atol=6 * noise)


def test_frames_that_are_not_fitted_say_nothing_of_those_before() -> None:
    known = observed()
    changed = replace(known, late=known.late.copy(), point=known.point.copy())
    changed.late[5:] += 0.5
    changed.point[5:] -= 0.5
    one, other = (with_late_tracks(seen, NODE, 5) for seen in (known, changed))
    np.testing.assert_array_equal(one.point[:5], other.point[:5])
    np.testing.assert_array_equal(one.is_visible[:5], other.is_visible[:5])
    assert not one.is_visible[0, 62]  # It begins in frame 5.
    again = with_late_tracks(known, NODE, 5)
    np.testing.assert_array_equal(again.point, one.point)


def test_identified_points_and_earlier_runs_stay_as_they_are() -> None:
    seen = observed()
    for known in (
        replace(seen, late=None),
        replace(seen, node_of_track=np.arange(60, dtype=np.int32)),
    ):
        assert with_late_tracks(known, NODE, FRAMES) is known


def test_nothing_seen_at_first_places_nothing_by_guess() -> None:
    seen = observed(cloud=False)
    seen.point[:] = np.nan
    seen.is_visible[:] = False
    seen.late[:3] = np.nan
    found = with_late_tracks(replace(seen, late=seen.late + np.float32(1.0)), NODE, FRAMES)
    assert not found.is_visible[0].any()
