"""Raw recordings become sequences: paired in time, without distortion, the table at z = 0."""

import json
import os
import pickle
import re
import subprocess
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from support.inputs.raw_capture import (
    BOARD,
    CAMERAS,
    FRAMES,
    RawCapture,
    ball,
    camera_at,
    intrinsics,
    picture,
)

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.board_calibration import AprilGrid, CharucoTarget, find_board
from physhandi.data.importers.capture import CaptureOptions, import_capture, survey_capture
from physhandi.data.importers.recorded_camera import RecordedCamera, read_camera
from physhandi.data.importers.rectification import Rectifier
from physhandi.errors import CancelledError, ImportFailedError, SequenceError, UsageError
from physhandi.progress import Progress


@pytest.fixture
def raw(tmp_path) -> RawCapture:
    return RawCapture(tmp_path / "raw").write()


def relative_error(poses: list[np.ndarray], truth: list[np.ndarray]) -> tuple[float, float]:
    """How far the second camera is from its place beside the first [m, degrees]."""
    off = np.linalg.inv(np.linalg.inv(poses[0]) @ poses[1]) @ np.linalg.inv(truth[0]) @ truth[1]
    turn = np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(off[:3, 3])), float(np.rad2deg(turn))


def test_color_depth_and_poses_arrive_as_recorded(raw, tmp_path):
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert [view.name for view in sequence.views] == ["left", "right"]
    assert (sequence.frame_count, sequence.frame_rate) == (FRAMES, 30.0)
    assert sequence.ground_height == pytest.approx(0.0, abs=1e-3)
    for view in sequence.views:
        color, depth = picture(CAMERAS[view.name], 4)
        assert np.array_equal(view.color(4), color)
        assert np.abs(view.depth(4) - depth).max() < 6e-4
        assert np.allclose(view.camera.T_world_camera, CAMERAS[view.name].T_world_camera)
    notes = " ".join(sequence.provenance["notes"])
    assert "taken for millimetres" in notes
    assert "30 Hz" in notes


def test_frames_are_cut_and_thinned(raw, tmp_path):
    options = CaptureOptions(start=1, stop=6, every=2, frame_rate=60.0)
    sequence = import_capture(raw.folder, tmp_path / "out", options=options)
    assert (sequence.frame_count, sequence.frame_rate) == (3, 30.0)
    assert np.array_equal(sequence.views[0].color(2), picture(CAMERAS["left"], 5)[0])
    with pytest.raises(UsageError, match="frames 0 to 5"):
        import_capture(raw.folder, tmp_path / "b", options=CaptureOptions(stop=7))
    with pytest.raises(UsageError, match="at least 2"):
        import_capture(raw.folder, tmp_path / "b", options=CaptureOptions(start=5))
    for rate in (0.0, -30.0, float("nan"), 1e6):
        options = CaptureOptions(frame_rate=rate)
        with pytest.raises(UsageError, match="give frames per second"):
            import_capture(raw.folder, tmp_path / "b", options=options)
        assert "give frames per second" in survey_capture(raw.folder, options).problems[0]
    assert not (tmp_path / "b").exists()


def test_images_are_sorted_as_numbers_and_missing_ones_are_told(raw, tmp_path):
    for view in CAMERAS:
        for path in sorted((raw.folder / view / "color").iterdir()):
            path.rename(path.with_name(f"img_{int(path.stem) + 7}.png"))
        for path in sorted((raw.folder / view / "depth").iterdir()):
            path.rename(path.with_name(f"{int(path.stem) + 7}.png"))
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert np.array_equal(sequence.views[1].color(5), picture(CAMERAS["right"], 5)[0])  # img_12


def long_capture(folder: Path, frames: int = 24, **options: bool) -> RawCapture:
    return RawCapture(folder, {"only": camera_at(30)}).write(frames, **options)


def test_a_lost_image_repeats_its_neighbour_and_lost_depth_is_empty(tmp_path):
    raw = long_capture(tmp_path / "raw")
    (raw.folder / "other").mkdir()
    (raw.folder / "other/rec.bag").touch()
    (raw.folder / "only/color/00007.png").unlink()
    (raw.folder / "only/depth/00012.png").unlink()
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert sequence.frame_count == 24
    view = sequence.views[0]
    assert np.array_equal(view.color(7), picture(raw.cameras["only"], 6)[0])
    assert not view.depth(12).any()
    notes = sequence.provenance["notes"]
    assert "only/color has no image for frame 7; its neighbour is repeated." in notes
    assert "only/depth has no image for frame 12." in notes
    left_out = "other/rec.bag is not read, because there are images of other cameras."
    assert left_out in notes
    assert left_out in survey_capture(raw.folder).notes


def test_streams_are_paired_by_time_and_the_error_is_told(tmp_path):
    raw = long_capture(tmp_path / "raw", 12)
    view = raw.folder / "only"
    color_time = 1_700_000_000 + np.arange(12) / 15
    # Depth begins two images later, is 4 ms late, and goes on at the same rate.
    for frame in (0, 1):
        (view / f"depth/{frame:05d}.png").unlink()
    depth_time = color_time[2:] + 0.004
    (view / "color_timestamps.csv").write_text(
        "index,nanoseconds\n" + "\n".join(f"{i},{round(t * 1e9)}" for i, t in enumerate(color_time))
    )
    (view / "depth_timestamps.txt").write_text("\n".join(f"{t:.6f}" for t in depth_time))
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert sequence.frame_count == 10
    assert sequence.frame_rate == pytest.approx(15.0, abs=1e-3)
    color, depth = picture(raw.cameras["only"], 2)
    assert np.array_equal(sequence.views[0].color(0), color)
    assert np.abs(sequence.views[0].depth(0) - depth).max() < 6e-4
    pairing = sequence.provenance["pairing"]
    assert pairing["only/color"]["largest_error"] == pytest.approx(0.0, abs=1e-5)
    assert pairing["only/depth"]["median_error"] == pytest.approx(0.004, abs=1e-5)


def test_names_that_are_times_pair_a_slow_stream_with_a_fast_one(tmp_path):
    raw = long_capture(tmp_path / "raw", 12)
    view = raw.folder / "only"
    for frame in range(12):
        stamp = f"{1305031102 + frame / 30:.6f}.png"
        (view / f"color/{frame:05d}.png").rename(view / "color" / stamp)
        if frame % 2:
            (view / f"depth/{frame:05d}.png").unlink()
        else:
            (view / f"depth/{frame:05d}.png").rename(view / "depth" / stamp)
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert (sequence.frame_count, round(sequence.frame_rate, 2)) == (6, 15.0)
    assert np.array_equal(sequence.views[0].color(3), picture(raw.cameras["only"], 6)[0])


def test_color_and_depth_may_lie_side_by_side(tmp_path):
    raw = long_capture(tmp_path / "raw", 3)
    view = raw.folder / "only"
    for kind in ("color", "depth"):
        for path in (view / kind).iterdir():
            path.rename(view / f"frame-{path.stem}.{kind}.png")
        (view / kind).rmdir()
    sequence = import_capture(raw.folder, tmp_path / "out")
    color, depth = picture(raw.cameras["only"], 2)
    assert np.array_equal(sequence.views[0].color(2), color)
    assert np.abs(sequence.views[0].depth(2) - depth).max() < 6e-4


def test_a_folder_of_the_tum_data_set(tmp_path):
    """Lists of times and files beside rgb/ and depth/, 5000 units a metre, one camera."""
    raw = long_capture(tmp_path / "raw", 4)
    view = raw.folder / "only"
    for kind, name, late in (("color", "rgb", 0.0), ("depth", "depth", 0.011)):
        (view / kind).rename(view / name)
        lines = ["# timestamp filename"]
        for frame in range(4):
            time = f"{1305031102.175304 + frame / 30 + late:.6f}"
            path = view / name / f"{frame:05d}.png"
            if name == "depth":
                image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
                cv2.imwrite(str(path), image * 5)
            path.rename(view / name / f"{time}.png")
            lines.append(f"{time} {name}/{time}.png")
        (view / f"{name}.txt").write_text("\n".join(lines) + "\n")
    options = CaptureOptions(depth_scale=5000.0)
    sequence = import_capture(view, tmp_path / "out", options=options)
    assert (sequence.frame_count, round(sequence.frame_rate, 3)) == (4, 30.0)
    assert np.array_equal(sequence.views[0].color(3), picture(raw.cameras["only"], 3)[0])
    assert np.abs(sequence.views[0].depth(3) - picture(raw.cameras["only"], 3)[1]).max() < 6e-4
    error = sequence.provenance["pairing"]["view0/depth"]["median_error"]
    assert error == pytest.approx(0.011, abs=1e-4)


def test_a_video_gives_color_and_its_frame_rate(tmp_path):
    raw = long_capture(tmp_path / "raw", 5)
    view, camera = raw.folder / "only", raw.cameras["only"]
    video = cv2.VideoWriter(str(view / "color.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, (96, 72))
    for frame in range(5):
        path = view / f"color/{frame:05d}.png"
        video.write(cv2.imread(str(path)))
        path.unlink()
    video.release()
    (view / "color").rmdir()
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert (sequence.frame_count, sequence.frame_rate) == (5, 25.0)
    found, true = sequence.views[0].color(3).astype(float), picture(camera, 3)[0]
    assert np.abs(found - true).mean() < 8  # MPEG-4 and JPEG lose a little.


def test_float_depth_in_metres_and_its_holes(tmp_path):
    raw = long_capture(tmp_path / "raw", 3)
    view = raw.folder / "only"
    for frame in range(3):
        depth = picture(raw.cameras["only"], frame)[1]
        depth[10:20, 5] = np.nan
        depth[30, 6] = -1.0
        depth[31, 6] = np.inf
        np.save(view / f"depth/{frame:05d}.npy", depth)
        (view / f"depth/{frame:05d}.png").unlink()
    sequence = import_capture(raw.folder, tmp_path / "out")
    found = sequence.views[0].depth(1)
    assert not found[10:20, 5].any()
    assert not found[30:32, 6].any()
    true = picture(raw.cameras["only"], 1)[1]
    assert abs(found[50, 50] - true[50, 50]) < 6e-4
    assert "taken for metres" in " ".join(sequence.provenance["notes"])


@pytest.mark.parametrize(
    ("channel", "kind", "scale"),
    [
        ("Z", np.float32, 1.0),
        ("Y", np.float16, 1.0),
        ("R", np.uint32, 0.001),
        ("ViewLayer.Depth.Z", np.float32, 0.01),
    ],
)
def test_depth_in_openexr_and_its_holes(tmp_path, channel, kind, scale):
    raw = long_capture(tmp_path / "raw", 3)
    true = picture(raw.cameras["only"], 1)[1]
    for path in sorted((raw.folder / "only/depth").iterdir()):
        depth = picture(raw.cameras["only"], int(path.stem))[1] / scale
        if kind != np.uint32:
            depth[10:20, 5], depth[31, 6] = np.nan, np.inf
            depth[:, 40:] = 1e10 if kind == np.float32 else np.inf  # More than half of the picture.
        channels = {channel: (np.round(depth) if kind == np.uint32 else depth).astype(kind)}
        if "." in channel:
            channels["ViewLayer.Combined.R"] = np.zeros_like(channels[channel])
        OpenEXR.File({}, channels).write(str(path.with_suffix(".exr")))
        path.unlink()
    options = CaptureOptions(depth_scale=0.01 if scale == 0.01 else None)
    sequence = import_capture(raw.folder, tmp_path / "out", options=options)
    found = sequence.views[0].depth(1)
    assert np.abs(found[50:, :40] - true[50:, :40]).max() < 1.1e-3  # Halves have 11 bits.
    if kind != np.uint32:
        assert not found[10:20, 5].any()
        assert not found[:, 40:].any()
    assert sequence.provenance["depth_scale"] == {"only": scale}


def test_depth_in_openexr_says_what_to_install(tmp_path, monkeypatch):
    raw = long_capture(tmp_path / "raw", 2)
    for path in sorted((raw.folder / "only/depth").iterdir()):
        depth = picture(raw.cameras["only"], int(path.stem))[1]
        OpenEXR.File({}, {"Z": depth}).write(str(path.with_suffix(".exr")))
        path.unlink()
    monkeypatch.setattr("physhandi.data.untrusted.exr.find_spec", lambda _: None)
    with pytest.raises(UsageError, match=r"00000\.exr needs .* pip install 'physhandi\[capture\]'"):
        import_capture(raw.folder, tmp_path / "out")


@pytest.mark.parametrize("scale", [0.0002, 5000.0])
def test_the_scale_of_depth_is_metres_per_unit_or_units_per_metre(tmp_path, scale):
    raw = long_capture(tmp_path / "raw", 2)
    for path in (raw.folder / "only/depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), depth * 5)
    with pytest.raises(ImportFailedError, match=r"3\.\d+ m away.*0\.0002"):
        import_capture(raw.folder, tmp_path / "out")
    raw.table("only", depth_scale=scale)
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert np.abs(sequence.views[0].depth(0) - picture(raw.cameras["only"], 0)[1]).max() < 6e-4
    raw.table("only", depth_scale=None)
    options = CaptureOptions(depth_scale=scale)
    sequence = import_capture(raw.folder, tmp_path / "given", options=options)
    assert sequence.provenance["depth_scale"] == {"only": pytest.approx(0.0002)}


def test_one_camera_finds_the_table_that_it_looks_down_on(tmp_path):
    raw = long_capture(tmp_path / "raw", 2, poses=False)
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert sequence.ground_height == 0.0
    truth = raw.cameras["only"].T_world_camera
    found = sequence.views[0].camera.T_world_camera
    assert np.abs(found[2] - truth[2]).max() < 2e-3  # Height, and which way is up.
    middle, radius = ball(0)
    view = sequence.views[0]
    row, column = np.nonzero((view.color(0)[..., 0] > 190) & (view.depth(0) > 0))
    point = view.camera.unproject(
        np.stack([column, row], 1).astype(float), view.depth(0)[row, column].astype(float)
    )
    assert point[:, 2].max() == pytest.approx(middle[2] + radius, abs=3e-3)


def test_one_camera_without_depth_or_pose_looks_straight_on(tmp_path):
    raw = long_capture(tmp_path / "raw", 2, poses=False)
    for path in (raw.folder / "only/depth").iterdir():
        path.unlink()
    (raw.folder / "only/depth").rmdir()
    sequence = import_capture(raw.folder / "only", tmp_path / "out")
    assert not sequence.views[0].has_depth
    assert sequence.ground_height is None
    down = sequence.views[0].camera.T_world_camera[:3, 1]
    assert np.allclose(down, [0, 0, -1])
    assert "serves for hands alone" in " ".join(sequence.provenance["notes"])


def test_a_world_that_is_upside_down_or_tilted_is_set_upright(tmp_path):
    for name, turn in {
        "down": np.diag([1.0, -1.0, -1.0, 1.0]),
        "first": np.linalg.inv(CAMERAS["left"].T_world_camera),
    }.items():
        raw = RawCapture(tmp_path / f"raw_{name}").write(2)
        for view, camera in CAMERAS.items():
            raw.table(view, T_world_camera=(turn @ camera.T_world_camera).tolist())
        sequence = import_capture(raw.folder, tmp_path / name)
        assert sequence.ground_height == pytest.approx(0.0, abs=2e-3)
        for view in sequence.views:
            true = CAMERAS[view.name].T_world_camera
            assert np.abs(view.camera.T_world_camera[2] - true[2]).max() < 4e-3
        assert relative_error(
            [view.camera.T_world_camera for view in sequence.views],
            [camera.T_world_camera for camera in CAMERAS.values()],
        ) == pytest.approx((0, 0), abs=1e-5)


def test_a_board_calibrates_the_cameras_and_lies_on_the_ground(tmp_path):
    cameras = {"left": camera_at(30, 4), "right": camera_at(110, 4)}
    raw = RawCapture(tmp_path / "raw", cameras).write(2, poses=False)
    tilted = np.diag([1.0, -1.0, -1.0, 1.0])
    tilted[:3, :3] = cv2.Rodrigues(np.array([0.3, 0.1, 0.5]))[0] @ tilted[:3, :3]
    tilted[:3, 3] = [-0.1, 0.0, 0.05]
    raw.photograph_board(None, tilted)
    sequence = import_capture(raw.folder, tmp_path / "out", options=CaptureOptions(board=BOARD))
    assert sequence.ground_height == 0.0
    poses = [view.camera.T_world_camera for view in sequence.views]
    truth = [camera.T_world_camera for camera in cameras.values()]
    shift, turn = relative_error(poses, truth)
    assert shift < 2e-3
    assert turn < 0.2
    for pose, true in zip(poses, truth, strict=True):
        assert abs(pose[2, 3] - true[2, 3]) < 2e-3  # z is up, and zero on the table.
    report = sequence.provenance["calibration"]
    assert all(0 < error < 0.5 for error in report["reprojection_error_px"].values())
    assert report["agreement"]["table in left"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("numbering", ["OpenCV", "Kalibr"])
def test_a_grid_of_april_tags_calibrates_too(tmp_path, numbering):
    grid = AprilGrid.parse("4x3,0.06,0.018")
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    scale = 1000  # px a metre
    sheet = np.full((round(0.216 * scale) + 40, round(0.294 * scale) + 40), 255, np.uint8)
    for tag in range(12):
        row, column = divmod(tag, 4)
        # Kalibr numbers from the bottom, and prints each tag upside down as OpenCV sees it.
        row = 2 - row if numbering == "Kalibr" else row
        image = cv2.aruco.generateImageMarker(tags, tag, 60)
        image = image[::-1, ::-1] if numbering == "Kalibr" else image
        y, x = 20 + row * 78, 20 + column * 78
        sheet[y : y + 60, x : x + 60] = image
    cameras = {"left": camera_at(30, 4), "right": camera_at(110, 4)}
    raw = RawCapture(tmp_path / "raw", cameras).write(2, poses=False)
    lies = np.diag([1.0, -1.0, -1.0, 1.0])
    lies[:3, 3] = [-0.15, 0.11, 0.0]
    for name, camera in cameras.items():
        to_board = np.array([[1e-3, 0, -0.0195], [0, 1e-3, -0.0195], [0, 0, 1]])
        from_board = (camera.T_camera_world @ lies)[:3][:, [0, 1, 3]]
        finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]])
        fine = cv2.warpPerspective(
            sheet,
            finer @ camera.K @ from_board @ to_board,
            (4 * camera.width, 4 * camera.height),
            borderValue=140,
        )
        small = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        (raw.folder / "calibration" / name).mkdir(parents=True)
        cv2.imwrite(str(raw.folder / "calibration" / name / "0.png"), small)
    sequence = import_capture(raw.folder, tmp_path / "out", options=CaptureOptions(board=grid))
    poses = [view.camera.T_world_camera for view in sequence.views]
    shift, turn = relative_error(poses, [camera.T_world_camera for camera in cameras.values()])
    assert shift < 3e-3
    assert turn < 0.3
    for pose, camera in zip(poses, cameras.values(), strict=True):
        assert abs(pose[2, 3] - camera.T_world_camera[2, 3]) < 3e-3
    report = sequence.provenance["calibration"]
    assert report["corners"] == {"left": 48, "right": 48}


def test_the_printed_board_is_the_one_that_is_looked_for():
    """The drawing in the docs, at 4 pixels a millimetre."""
    drawing = (Path(__file__).parents[3] / "docs/images/charuco_7x5_40mm.svg").read_text()
    assert 'width="297mm" height="210mm" viewBox="0 0 297 210"' in drawing
    sheet = np.full((840, 1188), 255, np.uint8)
    boxes = re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)h-", drawing)
    for x, y, width, height in np.array(boxes, float) * 4:
        sheet[round(y) : round(y + height), round(x) : round(x + width)] = 0
    found = find_board(cv2.cvtColor(sheet, cv2.COLOR_GRAY2BGR), CharucoTarget.parse("7x5,0.04"))
    assert found is not None
    assert len(found.corner) == 24
    ratio = np.ptp(found.pixel, axis=0) / np.ptp(found.corner[:, :2], axis=0)
    assert ratio == pytest.approx(4000, rel=0.002)  # Squares are 40 mm.


def test_the_board_of_the_first_frames_calibrates_too_and_tells_a_wrong_depth_scale(tmp_path):
    camera = camera_at(30, 4)
    raw = RawCapture(tmp_path / "raw", {"only": camera}).write(2, poses=False)
    raw.photograph_board()
    (raw.folder / "calibration/only/00000.png").replace(raw.folder / "only/color/00000.png")
    (raw.folder / "calibration/only").rmdir()
    (raw.folder / "calibration").rmdir()
    options = CaptureOptions(board=BOARD)
    sequence = import_capture(raw.folder, tmp_path / "out", options=options)
    assert abs(sequence.views[0].camera.T_world_camera[2, 3] - camera.T_world_camera[2, 3]) < 3e-3
    with pytest.raises(
        ImportFailedError, match=r"2 times as far.*--depth-scale 0\.001\b.* 2 times as l"
    ):
        import_capture(
            raw.folder,
            tmp_path / "wrong",
            options=CaptureOptions(board=BOARD, depth_scale=0.002),
        )
    for path in (raw.folder / "only/depth").glob("*.png"):  # Metres would be a scale of 2.
        halves = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 2000
        np.save(path.with_suffix(".npy"), halves)
        path.unlink()
    with pytest.raises(ImportFailedError, match=r"0\.5 times as far.*\(multiply its images by 2\b"):
        import_capture(raw.folder, tmp_path / "wrong", options=options)


@pytest.mark.parametrize(
    ("focal", "words"),
    [(110.0, ["times as far", "were two exchanged"]), (95.0, ["contradict", "two intrinsics"])],
)
def test_the_board_tells_exchanged_intrinsics(tmp_path, focal, words):
    lenses = {"left": camera_at(30, scale=4), "right": camera_at(110, scale=4)}
    other = np.array(lenses["right"].K)
    other[[0, 1], [0, 1]] = 4 * focal
    size = lenses["right"].width, lenses["right"].height
    lenses["right"] = PinholeCamera(other, lenses["right"].T_world_camera, *size)
    raw = RawCapture(tmp_path / "raw", lenses).write(2, poses=False)
    raw.photograph_board()
    raw.table("left", **intrinsics(lenses["right"]))
    raw.table("right", **intrinsics(lenses["left"]))
    with pytest.raises(ImportFailedError) as refusal:
        import_capture(raw.folder, tmp_path / "out", options=CaptureOptions(board=BOARD))
    assert [word for word in words if word not in str(refusal.value)] == []


@pytest.mark.parametrize("form", ["by name", "list", "of each", "calibrate", "one file"])
def test_poses_may_stand_in_files_of_their_own(tmp_path, form):
    raw = RawCapture(tmp_path / "raw").write(2, poses=False)
    pose = {name: camera.T_world_camera.tolist() for name, camera in CAMERAS.items()}
    if form == "by name":
        (raw.folder / "extrinsics.json").write_text(json.dumps(pose))
    elif form == "list":
        (raw.folder / "poses.json").write_text(json.dumps(list(pose.values())))
    elif form == "of each":
        for name, camera in CAMERAS.items():
            np.savetxt(raw.folder / name / "pose.txt", camera.T_world_camera)
    elif form == "calibrate":
        (raw.folder / "calibrate.pkl").write_bytes(pickle.dumps([*map(np.array, pose.values())]))
    else:
        table = {
            name: {**intrinsics(camera), "world_to_camera": camera.T_camera_world.tolist()}
            for name, camera in CAMERAS.items()
        }
        for name in CAMERAS:
            (raw.folder / name / "intrinsics.json").unlink()
        (raw.folder / "cameras.yaml").write_text(json.dumps({"cameras": table}))
    sequence = import_capture(raw.folder, tmp_path / "out")
    for view in sequence.views:
        true = CAMERAS[view.name].T_world_camera
        assert np.allclose(view.camera.T_world_camera, true, atol=1e-6)
        assert np.allclose(view.camera.K, CAMERAS[view.name].K)


def test_poses_of_other_cameras_are_told_by_their_names(tmp_path):
    raw = RawCapture(tmp_path / "raw", {"left": CAMERAS["left"]}).write(2, poses=False)
    pose = CAMERAS["left"].T_world_camera.tolist()
    (raw.folder / "extrinsics.json").write_text(json.dumps({"front": pose, "side": pose}))
    with pytest.raises(ImportFailedError, match=r"extrinsics\.json: .* Its fields are front, side"):
        import_capture(raw.folder, tmp_path / "out")


def test_a_moved_camera_is_named(raw, tmp_path):
    pose = CAMERAS["right"].T_world_camera.copy()
    pose[2, 3] += 0.04
    raw.table("right", T_world_camera=pose.tolist())
    with pytest.raises(ImportFailedError, match="'right' and 'left' contradict each other"):
        import_capture(raw.folder, tmp_path / "out")


def test_a_recording_of_phystwins_recorder(tmp_path):
    source = tmp_path / "raw"
    steps = {}
    for number, camera in enumerate(CAMERAS.values()):
        (source / f"color/{number}").mkdir(parents=True)
        (source / f"depth/{number}").mkdir(parents=True)
        # Each camera counts its steps from elsewhere; the clocks are common.
        first = 40 + 13 * number
        steps[str(number)] = {}
        for frame in range(4):
            color, depth = picture(camera, frame)
            cv2.imwrite(str(source / f"color/{number}/{first + frame}.png"), color[..., ::-1])
            np.save(
                source / f"depth/{number}/{first + frame}.npy",
                np.round(1000 * depth).astype(np.uint16),
            )
            steps[str(number)][str(first + frame)] = 1.7e9 + frame / 30 + 0.002 * number
    K = [camera.K.tolist() for camera in CAMERAS.values()]
    (source / "metadata.json").write_text(
        json.dumps({"intrinsics": K, "WH": [96, 72], "fps": 30, "recording": steps})
    )
    # PhysTwin's board has z into the table.
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [flip @ camera.T_world_camera for camera in CAMERAS.values()]
    (source / "calibrate.pkl").write_bytes(pickle.dumps(poses))
    sequence = import_capture(source, tmp_path / "out")
    assert sequence.frame_count == 4
    assert sequence.ground_height == pytest.approx(0.0, abs=1e-3)
    for view, camera in zip(sequence.views, CAMERAS.values(), strict=True):
        assert np.allclose(view.camera.T_world_camera, camera.T_world_camera, atol=1e-6)
        assert np.array_equal(view.color(3), picture(camera, 3)[0])
    errors = [error["largest_error"] for error in sequence.provenance["pairing"].values()]
    assert errors == pytest.approx([0, 0, 0.002, 0.002], abs=1e-4)


class _Stops(Progress):
    def __init__(self) -> None:
        self.count = 0

    def report(self, *arguments: object, **named: object) -> None:
        self.count += 1

    def check_cancelled(self) -> None:
        if self.count == 3:
            raise CancelledError("stop")


class _Counts(Progress):
    """Notes what is reported."""

    def __init__(self) -> None:
        self.told: list[tuple[int, str]] = []

    def report(self, stage, iteration, total, loss=None, message=""):
        assert (stage, total) == ("import", 2 * FRAMES)
        self.told.append((iteration, message))


def hidden(folder: Path) -> list[Path]:
    """What is left of a stopped import; nothing else may be there."""
    left = [path for path in folder.iterdir() if path.name != "raw"]
    assert all(path.name.startswith(".out.") and path.suffix == ".tmp" for path in left)
    return left


def content(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_an_import_that_was_stopped_goes_on_where_it_was(raw, tmp_path):
    nothing = np.zeros((CAMERAS["right"].height, CAMERAS["right"].width), np.uint16)
    cv2.imwrite(str(raw.folder / "right/depth/00000.png"), nothing)  # Of which a note is left.
    with pytest.raises(CancelledError):
        import_capture(raw.folder, tmp_path / "out", _Stops())
    (begun,) = hidden(tmp_path)
    written = (begun / "views/left/color/00000.png").stat().st_mtime_ns
    seen = _Counts()
    sequence = import_capture(raw.folder, tmp_path / "out", seen)
    assert seen.told[:2] == [(2, "goes on"), (3, "left")]
    assert seen.told[-1] == (2 * FRAMES, "right")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "raw"]
    whole = content(import_capture(raw.folder, tmp_path / "raw/whole").folder)
    parts = content(sequence.folder)
    whole["sequence.yaml"] = whole["sequence.yaml"].replace(b"name: whole", b"name: out")
    assert parts == whole
    kept = sequence.folder / "views/left/color/00000.png"
    assert kept.stat().st_mtime_ns == written
    assert "View 'right': depth of frame 0 holds no distance." in sequence.provenance["notes"]


@pytest.mark.parametrize("change", ["option", "image", "torn file", "torn note", "other process"])
def test_what_a_stopped_import_left_is_only_trusted_if_nothing_changed(raw, tmp_path, change):
    with pytest.raises(CancelledError):
        import_capture(raw.folder, tmp_path / "out", _Stops())
    (begun,) = hidden(tmp_path)
    options = CaptureOptions(hands=("left",) if change == "option" else ("right",))
    kept = 0
    if change == "image":
        os.utime(raw.folder / "left/color/00005.png", (1, 1))
    elif change == "torn file":
        (begun / "views/left/depth/00000.png").write_bytes(b"half")
    elif change == "torn note":
        note = (begun / ".checkpoints").read_text()
        (begun / ".checkpoints").write_text(note + note[: len(note) // 2])
        kept = 2
    elif change == "other process":  # It was killed, not stopped.
        dead = subprocess.Popen(["true"])
        dead.wait()
        begun.rename(begun.with_name(begun.name.replace("-0-", f"-{dead.pid}-")))
        kept = 2
    seen = _Counts()
    sequence = import_capture(raw.folder, tmp_path / "out", seen, options=options)
    assert len([1 for _, message in seen.told if message == "goes on"]) == kept // 2
    assert seen.told[-1][0] == 2 * FRAMES
    for frame in range(FRAMES):
        color, depth = picture(CAMERAS["left"], frame)
        assert np.array_equal(sequence.views[0].color(frame), color)
        assert np.abs(sequence.views[0].depth(frame) - depth).max() < 6e-4
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_sequence_that_is_there_is_taken_only_if_its_calibration_is_the_same(tmp_path):
    raw = RawCapture(tmp_path / "raw").write(2, times=True)
    raw.table("left", distortion=[1e-4, 0, 0, 0])
    made = import_capture(raw.folder, tmp_path / "out")
    table = (raw.folder / "left/intrinsics.json").read_text()

    def is_refused() -> None:
        with pytest.raises(SequenceError, match="exists already"):
            import_capture(raw.folder, made.folder, keeps_same=True)
        (raw.folder / "left/intrinsics.json").write_text(table)
        taken = import_capture(raw.folder, made.folder, keeps_same=True)
        assert taken.provenance == made.provenance

    raw.table("left", T_world_camera=camera_at(30.05).T_world_camera.tolist())
    is_refused()
    raw.table("left", distortion_model="fisheye")
    is_refused()
    for view in raw.cameras:
        (raw.folder / view / "timestamps.txt").write_text("100.0\n100.04\n")
    with pytest.raises(SequenceError, match="exists already"):
        import_capture(raw.folder, made.folder, keeps_same=True)


def test_a_sequence_that_is_there_is_taken_only_if_the_board_was_the_same(tmp_path):
    raw = RawCapture(tmp_path / "raw", {"left": camera_at(30, scale=4)}).write(2, poses=False)
    raw.photograph_board()
    board = raw.folder / "calibration/board.json"
    photograph = raw.folder / "calibration/left/00000.png"
    board.write_text('{"charuco": "7x5,0.04"}')
    os.utime(photograph, (2, 2))
    import_capture(raw.folder, tmp_path / "out")
    board.write_text('{"charuco": "7x5,0.0401"}')
    with pytest.raises(SequenceError, match="exists already"):
        import_capture(raw.folder, tmp_path / "out", keeps_same=True)
    board.write_text('{"charuco": "7x5,0.04"}')
    import_capture(raw.folder, tmp_path / "out", keeps_same=True)
    os.utime(photograph, (1, 1))
    with pytest.raises(SequenceError, match="exists already"):
        import_capture(raw.folder, tmp_path / "out", keeps_same=True)


def test_a_failed_import_leaves_nothing(raw, tmp_path):
    (raw.folder / "left/color/00004.png").write_bytes(b"no picture")
    with pytest.raises(ImportFailedError, match=r"00004\.png"):
        import_capture(raw.folder, tmp_path / "out")
    assert hidden(tmp_path) == []


def test_a_survey_tells_what_a_recording_holds(tmp_path):
    raw = RawCapture(tmp_path / "raw").write(times=True)
    found = survey_capture(raw.folder)
    assert (found.frame_count, found.problems) == (FRAMES, ())
    assert found.frame_rate == pytest.approx(30.0, abs=1e-3)
    assert found.calibration == "the poses that the recording states"
    left = found.views[0]
    assert (left.name, left.depth_scale, left.has_pose) == ("left", 0.001, True)
    assert left.color == f"{FRAMES} images, 96 x 72 px, with times"
    assert left.focal_length == pytest.approx(90.0)
    assert "taken for millimetres" in " ".join(found.notes)


def test_a_survey_tells_what_is_missing_and_what_to_do(tmp_path):
    raw = RawCapture(tmp_path / "raw").write(poses=False)
    raw.photograph_board()
    found = survey_capture(raw.folder, CaptureOptions(depth_scale=1.0))
    assert found.calibration == ""
    assert "Give --depth-scale" in found.problems[0]
    assert "calibration/ is there: say which board it shows" in found.problems[1]
    (raw.folder / "calibration/board.json").write_text('{"charuco": "7x5,0.04"}')
    found = survey_capture(raw.folder)
    assert found.problems == ()
    assert found.calibration == "the board in its pictures (ChArUco, 7x5 squares of 0.04 m)"
    (raw.folder / "right/intrinsics.json").unlink()
    (problem,) = survey_capture(raw.folder).problems
    assert "has no intrinsics" in problem
    (bag := tmp_path / "a.bag").touch()
    assert survey_capture(bag).bags == ("a.bag",)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{}", "names no board"),
        ('{"charuco": 7}', "names no board"),
        ('{"charuco": "7 squares"}', "squares across and down"),
        ('{"charuco": "7x5,0.04", "april_grid": "6x6,0.03,0.01"}', "two boards"),
    ],
)
def test_a_board_that_the_recording_names_badly_is_refused(tmp_path, text, reason):
    raw = RawCapture(tmp_path / "raw").write(frames=2, poses=False)
    raw.photograph_board()
    (raw.folder / "calibration/board.json").write_text(text)
    with pytest.raises(ImportFailedError, match=rf"board\.json.*{reason}"):
        import_capture(raw.folder, tmp_path / "out")


def spelled(**fields: object) -> RecordedCamera:
    return read_camera(Path("intrinsics.json"), fields)


@pytest.mark.parametrize(
    "camera",
    [
        spelled(fx=90, fy=91, cx=47, cy=35, width=96, height=72),
        spelled(fx=90, fy=91, ppx=47, ppy=35, w=96, h=72),
        spelled(K=[[90, 0, 47], [0, 91, 35], [0, 0, 1]], resolution=[96, 72]),
        spelled(
            camera_matrix={"rows": 3, "cols": 3, "data": [90, 0, 47, 0, 91, 35, 0, 0, 1]},
            image_width=96,
            image_height=72,
        ),
        spelled(intrinsic_matrix=[90, 0, 0, 0, 91, 0, 47, 35, 1], width=96, height=72),
        spelled(intrinsics=[90, 91, 47, 35], resolution=[96, 72]),
        spelled(focal_length=[90, 91], principal_point=[47, 35], width=96, height=72),
        spelled(
            color={"fx": 90, "fy": 91, "cx": 47, "cy": 35, "width": 96, "height": 72},
            depth={"scale": 0.001},
        ),
    ],
)
def test_intrinsics_have_many_spellings(camera):
    assert np.allclose(camera.K, [[90, 0, 47], [0, 91, 35], [0, 0, 1]])
    assert camera.size == (96, 72)


@pytest.mark.parametrize("model", ["brown_conrady", "fisheye", "inverse_brown_conrady"])
def test_distortion_is_taken_out_of_color_and_depth(model):
    """A straight row of posts stands in a straight row again."""
    K = np.array([[200.0, 0, 159.5], [0, 200, 119.5], [0, 0, 1]])
    coefficient = np.array([0.12, -0.04, 0.0, 0.0] if model == "fisheye" else [-0.2, 0.05, 0, 0, 0])
    true = np.stack([np.linspace(60, 260, 9), np.full(9, 40.0)], axis=1)
    ray = np.concatenate([(true - K[:2, 2]) / 200, np.ones((9, 1))], axis=1)
    if model == "fisheye":
        seen = cv2.fisheye.distortPoints(ray[:, None, :2], K, coefficient)[:, 0]
    elif model == "brown_conrady":
        seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, coefficient)[0][:, 0]
    else:
        back = cv2.undistortPoints(true.reshape(-1, 1, 2), K, coefficient).reshape(-1, 2)
        seen = back * 200 + K[:2, 2]
    assert np.abs(seen - true).max() > 3
    image = np.zeros((240, 320), np.float32)
    for x, y in seen:
        cv2.circle(image, (round(float(x) * 16), round(float(y) * 16)), 3 * 16, 1.5, -1, shift=4)
    camera = RecordedCamera(path=Path("x"), K=K, distortion=coefficient, model=model)
    rectifier = Rectifier(camera, (320, 240))
    for straight in (
        rectifier.depth(image),
        rectifier.color(np.repeat(image[..., None] * 100, 3, axis=2).astype(np.uint8))[..., 0],
    ):
        count, _, _, center = cv2.connectedComponentsWithStats((straight > 0).astype(np.uint8))
        assert count == 10
        assert np.abs(center[1:][np.argsort(center[1:, 0])] - true).max() < 0.6


def test_depth_of_another_camera_is_moved_to_the_pixels_of_color(tmp_path):
    """Depth is smaller, of another lens and 4 cm beside color; edges fall where color has them."""
    color_camera = camera_at(30, 2)
    T_color_depth = np.eye(4)
    T_color_depth[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]
    T_color_depth[:3, 3] = [0.04, 0.0, 0.005]
    depth_camera = PinholeCamera(
        np.array([[80.0, 0, 50], [0, 80, 36], [0, 0, 1]]),
        color_camera.T_world_camera @ T_color_depth,
        100,
        74,
    )
    raw = RawCapture(tmp_path / "raw", {"only": color_camera}).write(2)
    for frame in range(2):
        depth = picture(depth_camera, frame)[1]
        path = raw.folder / f"only/depth/{frame:05d}.png"
        cv2.imwrite(str(path), np.round(1000 * depth).astype(np.uint16))
    raw.table("only", depth=intrinsics(depth_camera), depth_to_color=T_color_depth.tolist())
    sequence = import_capture(raw.folder, tmp_path / "out")
    found, true = sequence.views[0].depth(1), picture(color_camera, 1)[1]
    known = found > 0
    assert known[10:-10, 10:-20].mean() > 0.9
    assert np.median(np.abs(found - true)[known]) < 4e-3
    is_ball = picture(color_camera, 1)[0][..., 0] == 200
    assert np.median((found - true)[known & is_ball]) == pytest.approx(0.0, abs=3e-3)
