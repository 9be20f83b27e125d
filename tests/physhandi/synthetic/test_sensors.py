from dataclasses import replace

import numpy as np
import pytest

from physhandi.synthetic.film.sensors import (
    DepthSensor,
    detect_keypoints,
    shift_outlines,
    smooth_noise,
    track,
)


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.mark.parametrize(("depth", "expected"), [(0.6, 0.68e-3), (1.0, 1.88e-3)])
def test_depth_noise_grows_with_the_square_of_the_distance(depth, expected):
    sensor = DepthSensor(hole_rate=0.0)
    assert sensor.noise(depth) == pytest.approx(expected, rel=0.01)
    flat = np.full((200, 200), depth)
    measured = sensor.measure(flat, np.ones_like(flat), rng()) / 1000.0
    assert np.std(measured - depth) == pytest.approx(expected, rel=0.2)
    assert abs(np.mean(measured) - depth) < 0.1 * expected + 1e-4


def test_speckle_grazing_and_nothing_leave_holes():
    flat = np.full((100, 100), 0.6)
    flat[:, :10] = 0.0
    cosine = np.ones_like(flat)
    cosine[50:] = 0.1
    measured = DepthSensor().measure(flat, cosine, rng())
    assert (measured[:, :10] == 0).all()
    assert (measured[:50, 12:] == 0).mean() == pytest.approx(0.02, abs=0.01)
    assert (measured[50:, 12:] == 0).mean() == pytest.approx(0.51, abs=0.04)


def test_edges_mix_depths_and_hide_background_on_their_left():
    depth = np.full((60, 320), 0.7)
    depth[:, 160:200] = 0.5
    measured = DepthSensor(hole_rate=0.0).measure(depth, np.ones_like(depth), rng()) / 1000.0
    disparity_jump = 447 * 0.095 * (1 / 0.5 - 1 / 0.7) * 320 / 848
    blind = int(disparity_jump)
    assert (measured[:, 160 - blind : 160] == 0).mean() > 0.95
    assert (measured[:, 120:150] > 0).all()
    beside = measured[:, 198:202]
    mixed = (beside > 0.52) & (beside < 0.68)
    assert 0.05 < mixed.mean() < 0.4
    assert ((measured[:, 202:] > 0.69) & (measured[:, 202:] < 0.71)).all()


def test_an_offset_moves_the_whole_image():
    flat = np.full((80, 80), 0.5)
    sensor = DepthSensor(hole_rate=0.0, disparity_noise=0.0)
    high = sensor.measure(flat, np.ones_like(flat), rng(), offset=1.0)
    low = sensor.measure(flat, np.ones_like(flat), rng(), offset=-1.0)
    assert (high.astype(int) - low.astype(int) == 2).all()


def test_smooth_noise_has_unit_variance_and_is_alike_next_door():
    noise = smooth_noise((300, 300), 1.2, rng())
    assert noise.std() == pytest.approx(1.0, rel=0.05)
    assert np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1] > 0.7


def test_mask_errors_stay_near_the_outline():
    label = np.zeros((80, 80), dtype=np.uint8)
    label[20:60, 20:60] = 1
    found = shift_outlines(label, rng())
    wrong = found != label
    assert 20 < wrong.sum() < 200
    assert not wrong[22:58, 22:58].any()
    assert not wrong[:18].any()


def test_tracks_err_by_half_a_pixel_and_rest_while_unseen():
    pixel = np.tile(np.linspace(0, 50, 40)[:, None, None], (1, 300, 2))
    seen = np.ones((40, 300), dtype=bool)
    seen[20:] = False
    reported, visible = track(pixel, seen, rng())
    error = (reported - pixel)[visible]
    assert error.std() == pytest.approx(0.5, rel=0.1)
    assert visible[0].all()
    assert visible[1:20].mean() == pytest.approx(1 - 0.03, abs=0.015)
    assert not visible[20:].any()
    np.testing.assert_array_equal(reported[39], reported[20])


def test_hidden_keypoints_are_less_exact_and_less_sure():
    pixel = np.full((400, 21, 2), 50.0)
    hidden = np.zeros((400, 21), dtype=bool)
    hidden[:, 10:20] = True
    pixel[:, 20] = [500.0, 5.0]
    keypoint = detect_keypoints(pixel, hidden, (100, 100), rng())
    assert np.isnan(keypoint[:, 20]).all()
    assert np.isnan(keypoint[:, :20, 2]).mean() == pytest.approx(0.01, abs=0.004)
    assert np.nanstd(keypoint[:, :10, :2] - 50) == pytest.approx(1.5, rel=0.05)
    assert np.nanstd(keypoint[:, 10:20, :2] - 50) == pytest.approx(3.0, rel=0.05)
    assert np.nanmax(keypoint[:, 10:20, 2]) < np.nanmin(keypoint[:, :10, 2])


def test_an_even_error_does_not_grow_with_the_distance():
    for depth in (0.5, 1.0):
        sensor = DepthSensor(
            hole_rate=0.0, disparity_noise=0.0, disparity_step=0.0, even_noise=0.003
        )
        flat = np.full((200, 200), depth)
        measured = sensor.measure(flat, np.ones_like(flat), rng()) / 1000.0
        assert np.std(measured) == pytest.approx(0.003, rel=0.03)
        # Neighbours err apart from each other.
        error = measured - depth
        assert abs(np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]) < 0.02


def test_a_cut_out_of_a_wide_image_has_shadows_as_wide_as_in_the_whole():
    depth = np.full((20, 300), 0.9)
    depth[:, 150:] = 0.5
    exact = DepthSensor(hole_rate=0.0, disparity_noise=0.0, disparity_step=0.0, flying_rate=0.0)
    expected = int(447 * 0.095 * (1 / 0.5 - 1 / 0.9))
    assert expected == 37
    for shadow, width in ((1.0, expected), (0.5, expected // 2), (0.0, 0)):
        sensor = replace(exact, shadow=shadow)
        measured = sensor.measure(depth, np.ones_like(depth), rng(), scale=1.0)
        assert (measured == 0).sum(axis=1).tolist() == [width] * 20
        assert (measured[:, 150 - width : 150] == 0).all()


def test_mixed_pixels_reach_as_far_from_an_edge_as_told():
    depth = np.full((400, 100), 0.8)
    depth[:, 50:] = 0.6
    for reach, columns in ((1, [49, 50]), (2, [48, 49, 50, 51])):
        sensor = DepthSensor(hole_rate=0.0, shadow=0.0, disparity_noise=0.0, edge_reach=reach)
        measured = sensor.measure(depth, np.ones_like(depth), rng()) / 1000.0
        mixed = (measured > 0.605) & (measured < 0.795)
        assert np.flatnonzero(mixed.any(axis=0)).tolist() == columns
        assert mixed[:, columns].mean() == pytest.approx(0.4 * 0.95, abs=0.04)


def test_outlines_move_by_up_to_two_pixels_if_told_so():
    label = np.zeros((600, 600), dtype=np.uint8)
    label[50:550, 50:550] = 3
    found = shift_outlines(label, rng(), error=1.0, largest=2.0)
    wrong = found != label
    assert set(np.unique(found)) == {0, 3}
    assert not wrong[52:548, 52:548].any()
    assert not wrong[:48].any()
    assert 0 < wrong[48].mean() < 0.2 < wrong[49:51].mean()
    assert not (shift_outlines(label, rng(), error=0.0, largest=0.0) != label).any()


def test_a_wandering_track_is_lost_for_good():
    pixel = np.full((121, 2000, 2), 40.0)
    seen = np.ones(pixel.shape[:2], dtype=bool)
    reported, _ = track(pixel, seen, rng(), error=0.0, wander=0.5, dropout_rate=0.0)
    assert (reported[0] == 40.0).all()
    # As of a random walk, the variance grows with time: 0.5 px after 30 frames, 1 px after 120.
    assert np.std(reported[30]) == pytest.approx(0.5, rel=0.05)
    assert np.std(reported[120]) == pytest.approx(1.0, rel=0.05)


def test_perfect_detectors_find_every_keypoint_where_it_is():
    pixel = np.full((5, 21, 2), 30.0)
    hidden = np.ones((5, 21), dtype=bool)
    keypoint = detect_keypoints(pixel, hidden, (100, 100), rng(), error=0.0, loss_rate=0.0)
    assert (keypoint[..., :2] == 30.0).all()
    assert (keypoint[..., 2] < 0.61).all()
    worse = detect_keypoints(
        np.full((3000, 21, 2), 500.0),
        np.ones((3000, 21), bool),
        (1000, 1000),
        rng(),
        hidden_factor=4.0,
    )
    assert np.nanstd(worse[..., :2]) == pytest.approx(6.0, rel=0.05)
