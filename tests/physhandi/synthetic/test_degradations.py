"""Levels of errors: what each one does, that 0 does nothing, and what is refused."""

from dataclasses import asdict, fields

import numpy as np
import pytest

from physhandi.errors import UsageError
from physhandi.synthetic.film.cameras import (
    FARTHEST_CAMERA,
    FOCAL_LENGTH,
    NEAREST_CAMERA,
    SIZE,
    make_viewpoints,
    window_around,
)
from physhandi.synthetic.film.degradations import (
    PRESETS,
    Degradations,
    changed,
    depth_sensor,
    find_preset,
    hand_shift,
    miscalibrated,
)

BOX = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.15, 0.15) for z in (0.0, 0.2)])


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_the_default_depth_camera_has_the_published_noise_of_a_d455():
    sensor = depth_sensor(PRESETS["default"])
    for distance, published in ((0.6, 0.7e-3), (0.8, 1.2e-3), (1.0, 1.9e-3)):
        assert sensor.noise(distance) == pytest.approx(published, abs=0.05e-3)
        read = sensor.measure_points(np.full(40_000, distance), rng())
        read = read[np.isfinite(read)]
        assert np.std(read) == pytest.approx(published, rel=0.05)
        # Disparity comes in steps of 1/32 px, hence depth in steps of z²/(32·f·B).
        step = np.diff(np.unique(np.round(read, 7))).min()
        assert step == pytest.approx(distance**2 / (32 * 447 * 0.095), rel=0.02)


def test_clean_depth_is_exact():
    distance = np.linspace(0.4, 1.2, 500)
    read = depth_sensor(PRESETS["clean"]).measure_points(distance, rng(), offset=1.0)
    np.testing.assert_allclose(read, distance, rtol=1e-12)


def test_the_papers_perturbations_are_a_millimetre_a_pixel_and_a_centimetre():
    level = find_preset("paper")
    assert {name: value for name, value in asdict(level).items() if value} == {
        "depth_error": 0.001,
        "track_noise": 1.0,
        "hand_error": 0.010,
    }
    for distance in (0.5, 1.0):
        read = depth_sensor(level).measure_points(np.full(20_000, distance), rng())
        assert np.std(read) == pytest.approx(1e-3, rel=0.03)
    shift = hand_shift(90, 30.0, level, rng())
    assert np.linalg.norm(shift, axis=1).mean() == pytest.approx(0.010, rel=1e-9)
    # Over a frame it changes little, over a second a lot.
    assert np.linalg.norm(np.diff(shift, axis=0), axis=1).mean() < 0.002
    assert np.linalg.norm(shift[30:] - shift[:-30], axis=1).mean() > 0.006


def test_hard_is_nowhere_better_than_default_nor_default_than_clean():
    for field in fields(Degradations):
        clean, default, hard = (
            getattr(PRESETS[name], field.name) for name in ("clean", "default", "hard")
        )
        assert clean == 0
        assert default <= hard


def test_a_wrong_calibration_is_off_by_the_levels():
    views = make_viewpoints(BOX, 3, Degradations(), 0)
    level = Degradations(camera_shift=0.002, camera_turn=0.2)
    for view in views:
        assert np.array_equal(view.camera.T_world_camera, view.calibrated.T_world_camera)
        told = miscalibrated(view.camera, level, rng()).T_world_camera
        true = view.camera.T_world_camera
        assert np.linalg.norm(told[:3, 3] - true[:3, 3]) == pytest.approx(0.002)
        cosine = (np.trace(told[:3, :3] @ true[:3, :3].T) - 1) / 2
        assert np.rad2deg(np.arccos(cosine)) == pytest.approx(0.2, rel=1e-4)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_cameras_stand_around_and_see_everything(count):
    views = make_viewpoints(BOX, count, PRESETS["hard"], 5)
    assert [view.name for view in views] == [f"camera{number}" for number in range(count)]
    center = (BOX.min(axis=0) + BOX.max(axis=0)) / 2
    azimuth = []
    for view in views:
        camera = view.camera
        assert (camera.width, camera.height) == SIZE == (848, 480)
        assert camera.K[0, 0] == camera.K[1, 1] == FOCAL_LENGTH == 447
        away = camera.T_world_camera[:3, 3] - center
        assert NEAREST_CAMERA <= np.linalg.norm(away) <= FARTHEST_CAMERA
        assert 30 <= np.rad2deg(np.arcsin(away[2] / np.linalg.norm(away))) <= 55
        pixel = camera.project(BOX)
        assert (pixel >= 0).all()
        assert (pixel <= np.array(SIZE) - 1).all()
        azimuth.append(np.arctan2(away[1], away[0]))
    gap = np.diff(np.sort(np.rad2deg(azimuth)))
    assert (gap >= 360 / count - 30.1).all()
    assert views[0].delay == 0
    for view in views[1:]:
        assert 0.010 <= abs(view.delay) <= 0.020


def test_a_seed_decides_where_cameras_stand_and_the_level_does_not():
    one, same, other = (
        make_viewpoints(BOX, 2, level, seed)[1].camera.T_world_camera
        for level, seed in ((PRESETS["hard"], 1), (PRESETS["clean"], 1), (PRESETS["hard"], 2))
    )
    assert np.array_equal(one, same)
    assert not np.allclose(one, other)


def test_a_window_sees_what_the_camera_sees_there():
    camera = make_viewpoints(BOX, 1, Degradations(), 0)[0].camera
    window = window_around(camera, BOX, 10)
    shift = np.array([window.columns.start, window.rows.start])
    np.testing.assert_allclose(window.camera.project(BOX) + shift, camera.project(BOX))
    size = (window.columns.stop - window.columns.start, window.rows.stop - window.rows.start)
    assert (window.camera.width, window.camera.height) == size
    pixel = window.camera.project(BOX)
    assert 9.9 < pixel.min() < 11.1
    behind = window_around(camera, BOX + 10 * (camera.T_world_camera[:3, 3] - BOX), 10)
    assert behind.camera.width == 848


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_nose": 0.1}, "Did you mean 'depth_noise'"),
        ({"fog": 0.1}, "Choose one of: depth_noise, depth_error"),
        ({"holes": 1.5}, "holes is 1.5; expected a level from 0 to 0.9"),
        ({"mask_error": -1.0}, "mask_error is -1"),
        ({"track_noise": float("nan")}, "track_noise is nan"),
    ],
)
def test_levels_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        changed(PRESETS["clean"], changes)


def test_a_change_leaves_the_other_levels_alone():
    level = changed(PRESETS["default"], {"holes": 0.0})
    assert level.holes == 0
    assert level.depth_noise == 0.08
    with pytest.raises(UsageError, match="no preset named 'foggy'"):
        find_preset("foggy")
