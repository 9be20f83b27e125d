"""Cameras placed by the pattern of the table that they share."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.raw_capture import RawCapture, ball, camera_at, picture, rays

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.board_calibration import CharucoTarget
from physhandi.data.importers.capture import CaptureOptions, import_capture, survey_capture
from physhandi.data.importers.table_calibration import (
    TablePattern,
    calibrate_by_pattern,
    lay_patterns,
)
from physhandi.errors import ImportFailedError, UsageError

BY_TABLE = CaptureOptions(by_table=True)
MILLIMETRE = 0.001


def places(count: int, seed: int = 0) -> TablePattern:
    """Places all over a table of 60 x 40 cm, each of which looks like no other."""
    random = np.random.default_rng(seed)
    look = random.random((count, 128)).astype(np.float32) ** 4
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    return TablePattern(random.uniform([-0.3, -0.2], [0.3, 0.2], (count, 2)), look)


def moved(pattern: TablePattern, angle: float, shift: tuple[float, float]) -> TablePattern:
    """The same places in the coordinates of a view that lies otherwise."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return TablePattern((pattern.point - shift) @ turn, pattern.descriptor)


def part(pattern: TablePattern, chosen: slice) -> TablePattern:
    return TablePattern(pattern.point[chosen], pattern.descriptor[chosen])


def joined(*patterns: TablePattern) -> TablePattern:
    return TablePattern(
        np.concatenate([one.point for one in patterns]),
        np.concatenate([one.descriptor for one in patterns]),
    )


def test_a_turn_and_a_shift_are_found_among_wrong_matches() -> None:
    fixed = places(200)
    moving = moved(fixed, 2.0, (0.4, -0.7))
    noise = np.random.default_rng(5)
    point = moving.point + noise.normal(0, 0.001, moving.point.shape)
    point[:120] = noise.uniform(-0.3, 0.3, (120, 2))
    fit = lay_patterns([TablePattern(point, moving.descriptor)], [fixed])
    assert fit is not None
    assert fit.angle == pytest.approx(2.0, abs=0.003)
    assert fit.shift == pytest.approx([0.4, -0.7], abs=0.001)
    assert 78 <= fit.place_count <= 83
    assert fit.rival_count < 10
    assert fit.error == pytest.approx(0.0014, abs=0.0005)
    # Places lie evenly over 0.4 m, which deviate by 0.4 / sqrt(12).
    assert fit.spread == pytest.approx(0.115, abs=0.02)


def test_views_are_joined_along_those_that_share_most() -> None:
    world = places(300)
    first, second = part(world, slice(0, 160)), part(world, slice(60, 300))
    third = part(world, slice(170, 300))  # The first view shares nothing with it.
    seen = [first, moved(second, 0.5, (0.2, 0.1)), moved(third, -1.0, (0.0, 0.3))]
    pose, report = calibrate_by_pattern(["a", "b", "c"], [[one, one] for one in seen])
    for found, angle, shift in zip(pose, (0.0, 0.5, -1.0), (0, (0.2, 0.1), (0, 0.3)), strict=True):
        assert np.arctan2(found[1, 0], found[0, 0]) == pytest.approx(angle, abs=1e-6)
        assert found[:2, 3] == pytest.approx(np.broadcast_to(shift, 2), abs=1e-6)
    assert set(report) == {"a, b", "b, c"}
    assert report["a, b"]["places"] == 200  # A hundred in each of two frames.


def test_pairs_of_places_that_fit_alone_lay_nothing() -> None:
    """Two places are as far apart as in the other view, and no third one fits them."""
    fixed = part(places(4), slice(0, 4))
    point = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.15], [-0.1, 0.3]])
    elsewhere = np.array([[0.0, 0.0], [0.2, 0.0], [-0.4, 0.4], [0.6, -0.5]])
    moving = TablePattern(elsewhere, fixed.descriptor)
    assert lay_patterns([moving], [TablePattern(point, fixed.descriptor)]) is None


def test_what_cannot_be_trusted_is_refused() -> None:
    world = places(120)
    other = moved(world, 0.5, (0.2, 0.1))

    def refused(first: list[TablePattern], second: list[TablePattern]) -> str:
        with pytest.raises(ImportFailedError) as error:
            calibrate_by_pattern(["a", "b"], [first, second])
        assert "--charuco" in str(error.value)
        return str(error.value)

    few = part(other, slice(0, 30))
    assert "'a' and 'b' share 30 places of it (60 are needed)" in refused([world] * 2, [few] * 2)
    # Enough in one frame do not make up for the other one.
    assert "share 30 places" in refused([world] * 2, [other, few])
    nothing = TablePattern(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    assert "share 0 places" in refused([world] * 2, [nothing, other])
    strip = TablePattern(world.point * [1.0, 0.1], world.descriptor)
    assert "in a strip 11 mm wide" in refused([strip] * 2, [moved(strip, 0.5, (0, 0))] * 2)
    # The same things lie a second time 10 cm farther on; the second view sees some of each.
    again = part(places(200), slice(120, 200))
    both = joined(other, moved(again, 0.5, (0.2, 0.2)))
    assert "fit in two ways" in refused([joined(world, again)] * 2, [both] * 2)
    shoved = moved(world, 0.5, (0.21, 0.1))
    assert "was a camera moved" in refused([world] * 2, [other, shoved])


def test_pairs_that_contradict_each_other_are_refused() -> None:
    world = places(300)
    ab, ac, bc = (part(world, slice(100 * n, 100 * n + 100)) for n in range(3))
    first, second = joined(ab, ac), joined(ab, bc)
    third = joined(ac, moved(bc, 0.0, (0.02, 0.0)))
    with pytest.raises(ImportFailedError, match=r"says two things about views .* 20 mm"):
        calibrate_by_pattern(["a", "b", "c"], [[one, one] for one in (first, second, third)])


def printed(seed: int) -> np.ndarray:
    """A table covered with print: one pixel is a millimetre."""
    random = np.random.default_rng(seed)
    sheet = np.full((1400, 1400), 220, np.uint8)
    for x, y, width, height, gray in zip(
        *random.integers(0, 1400, (2, 2500)),
        random.integers(6, 60, 2500),
        random.integers(4, 14, 2500),
        random.integers(20, 160, 2500),
        strict=True,
    ):
        sheet[y : y + height, x : x + width] = gray
    return cv2.GaussianBlur(sheet, (0, 0), 1.5)


def photograph(camera: PinholeCamera, sheet: np.ndarray, frame: int) -> np.ndarray:
    """What a camera sees of that table and of a ball that rolls on it."""
    color, depth = picture(camera, frame)
    eye, way = rays(camera)
    place = eye + way * depth[..., None]
    x, y = np.moveaxis(place[..., :2] / MILLIMETRE + 700, -1, 0).astype(np.float32)
    shown = cv2.remap(sheet, x, y, cv2.INTER_LINEAR)
    middle, radius = ball(frame)
    is_ball = np.linalg.norm(place - middle, axis=-1) < radius + 0.001
    return np.where(is_ball[..., None], color, shown[..., None])


def test_cameras_find_each_other_by_a_printed_table(tmp_path: Path) -> None:
    cameras = {"left": camera_at(30, scale=2), "right": camera_at(85, scale=2)}
    raw = RawCapture(tmp_path / "raw", cameras).write(2, poses=False)
    with pytest.raises(ImportFailedError, match="give --by-table if"):
        import_capture(raw.folder, tmp_path / "none")
    for name in cameras:  # Poses that the recording states do not count.
        raw.table(name, T_world_camera=np.eye(4).tolist())
    # The table of this recording is checkered, which fits in many ways or none.
    with pytest.raises(ImportFailedError, match="let all cameras see more of a table with a"):
        import_capture(raw.folder, tmp_path / "none", options=BY_TABLE)
    sheet = printed(0)
    for name, camera in cameras.items():
        for frame in range(2):
            image = photograph(camera, sheet, frame)
            cv2.imwrite(str(raw.folder / name / f"color/{frame:05d}.png"), image[..., ::-1])
    both = CaptureOptions(by_table=True, board=CharucoTarget(7, 5, 0.04))
    with pytest.raises(UsageError, match="needs no board"):
        import_capture(raw.folder, tmp_path / "none", options=both)
    assert survey_capture(raw.folder, BY_TABLE).calibration == "the pattern of the table"
    sequence = import_capture(raw.folder, tmp_path / "out", options=BY_TABLE)
    left, right = (view.camera.T_world_camera for view in sequence.views)
    true_left, true_right = (camera.T_world_camera for camera in cameras.values())
    error = np.linalg.inv(np.linalg.inv(left) @ right) @ np.linalg.inv(true_left) @ true_right
    assert np.linalg.norm(error[:3, 3]) < 0.0015
    assert np.rad2deg(np.arccos(min(1.0, (np.trace(error[:3, :3]) - 1) / 2))) < 0.3
    assert sequence.ground_height == 0.0
    assert left[2, 3] == pytest.approx(true_left[2, 3], abs=0.002)
    told = sequence.provenance["calibration"]
    assert told["by"] == "the pattern of the table"
    assert told["shared_pattern"]["left, right"]["places"] > 100
    for path in (raw.folder / "right/depth").iterdir():
        path.unlink()
    (raw.folder / "right/depth").rmdir()
    with pytest.raises(ImportFailedError, match="'right' has no depth"):
        import_capture(raw.folder, tmp_path / "blind", options=BY_TABLE)
