"""Importing a two-camera recording: geometry by hand, and every way in which files can be wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.hostile.header_bombs import mp4

from physhandi.data.importers.stereo import import_stereo
from physhandi.errors import ImportFailedError, UsageError

INTRINSICS = """intrinsic:
60.0 0.0 32.0
0.0 61.0 24.0
0.0 0.0 1.0
distortion:
0.1 -0.2 0.001 0.002 0.05
"""
# The board's z axis points away from the cameras: camera 0 is 10 squares in front of its origin.
POSE_0 = """R:
1.0 0.0 0.0
0.0 1.0 0.0
0.0 0.0 1.0
T:
0.0
0.0
10.0
"""
# Camera 1 is turned by a quarter about the vertical and stands at (10, 0, 0).
POSE_1 = """R:
0.0 0.0 1.0
0.0 1.0 0.0
-1.0 0.0 0.0
T:
0.0
0.0
10.0

#below is rotation and translation to go from cam0 to cam1.
R:
nothing that is read
"""


def _video(path: Path, frame_count: int = 3, rate: float = 30.0) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (64, 48))
    for frame in range(frame_count):
        writer.write(np.full((48, 64, 3), 40 * frame, np.uint8))
    writer.release()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    source = tmp_path / "recording"
    source.mkdir()
    for camera, pose in enumerate((POSE_0, POSE_1)):
        _video(source / f"cam{camera}_test.mp4")
        (source / f"c{camera}.dat").write_text(INTRINSICS)
        (source / f"rot_trans_c{camera}.dat").write_text(pose)
    return source


def test_cameras_stand_above_the_board(recording: Path, tmp_path: Path) -> None:
    sequence = import_stereo(recording, tmp_path / "hand", hands=("left",))
    assert (sequence.frame_count, sequence.frame_rate) == (3, 30.0)
    assert (sequence.metric, sequence.length_unit) == (False, "board square")
    assert sequence.hands == ("left",)
    first, second = (view.camera for view in sequence.views)
    np.testing.assert_allclose(first.T_world_camera[:3, 3], [0, 0, 10], atol=1e-12)
    np.testing.assert_allclose(second.T_world_camera[:3, 3], [10, 0, 0], atol=1e-12)
    np.testing.assert_allclose(first.camera_depth(np.array([0.0, 0, 2])), 8)
    np.testing.assert_allclose(first.K, [[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    np.testing.assert_allclose(first.distortion, [0.1, -0.2, 0.001, 0.002, 0.05])
    copied = sequence.folder / "views/view1/color.mp4"
    assert copied.read_bytes() == (recording / "cam1_test.mp4").read_bytes()
    assert sequence.views[0].color(2).mean() == pytest.approx(80, abs=4)


def test_who_recorded_it_is_kept_only_if_told(recording: Path, tmp_path: Path) -> None:
    plain = import_stereo(recording, tmp_path / "plain").provenance
    assert plain == {"importer": "stereo", "folder": "recording"}
    both = import_stereo(
        recording, tmp_path / "both", hands=("left", "right"), origin="our lab", licence="CC0-1.0"
    )
    assert both.hands == ("left", "right")
    assert both.provenance == plain | {"origin": "our lab", "licence": "CC0-1.0"}
    for hands in ((), ("left", "left")):
        with pytest.raises(UsageError, match="Name each hand"):
            import_stereo(recording, tmp_path / "none", hands=hands)


def test_a_board_seen_from_its_z_side_is_not_turned(recording: Path, tmp_path: Path) -> None:
    for camera in (0, 1):
        flipped = POSE_0.replace("0.0 1.0 0.0\n0.0 0.0 1.0", "0.0 -1.0 0.0\n0.0 0.0 -1.0")
        (recording / f"rot_trans_c{camera}.dat").write_text(flipped)
    camera = import_stereo(recording, tmp_path / "hand").views[0].camera
    np.testing.assert_allclose(camera.T_world_camera[:3, 3], [0, 0, 10], atol=1e-12)
    np.testing.assert_allclose(np.diag(camera.T_world_camera), [1, -1, -1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("c0.dat", "intrinsic:", "intrinsics", r"c0\.dat, line 1 is 'intrinsics'"),
        ("c1.dat", "0.0 61.0 24.0", "0.0 61.0", r"c1\.dat, line 3 is '0\.0 61\.0'.*3 finite"),
        ("c1.dat", "61.0", "x", r"c1\.dat, line 3 is .*expected 3 numbers"),
        ("c0.dat", "60.0", "nan", r"c0\.dat, line 2 .*finite"),
        ("c0.dat", "60.0", "-60.0", r"c0\.dat, lines 2-4: the intrinsic matrix"),
        ("c0.dat", "0.1 -0.2 0.001 0.002 0.05\n", "", r"c0\.dat, line 6 is missing; .*5 numbers"),
        ("rot_trans_c0.dat", "1.0 0.0 0.0", "1.5 0.0 0.0", r"rot_trans_c0\.dat, lines 2-4: R is"),
        ("rot_trans_c1.dat", "0.0 1.0 0.0", "0.0 -1.0 0.0", r"rot_trans_c1\.dat, lines 2-4"),
        ("rot_trans_c1.dat", "10.0", "ten", r"rot_trans_c1\.dat, line 8 is 'ten'"),
    ],
)
def test_a_malformed_file_is_named_with_its_line(
    recording: Path, tmp_path: Path, file: str, before: str, after: str, message: str
) -> None:
    text = (recording / file).read_text()
    assert before in text
    (recording / file).write_text(text.replace(before, after, 1))
    with pytest.raises(ImportFailedError, match=message):
        import_stereo(recording, tmp_path / "hand")
    assert not (tmp_path / "hand").exists()


@pytest.mark.parametrize("file", ["c0.dat", "rot_trans_c1.dat"])
def test_a_missing_file_is_named(recording: Path, tmp_path: Path, file: str) -> None:
    (recording / file).unlink()
    with pytest.raises(ImportFailedError, match=f"{file} is missing"):
        import_stereo(recording, tmp_path / "hand")


def test_videos_must_be_there_once_decode_and_agree(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ImportFailedError, match="is not a folder"):
        import_stereo(tmp_path / "nowhere", tmp_path / "hand")
    _video(recording / "cam1_test.mp4", frame_count=5)
    with pytest.raises(ImportFailedError, match=r"has 5 frames at 30 Hz, but cam0_test\.mp4 has 3"):
        import_stereo(recording, tmp_path / "hand")
    whole = (recording / "cam1_test.mp4").read_bytes()
    (recording / "cam1_test.mp4").write_bytes(mp4(whole, 60_000, 60_000))
    with pytest.raises(ImportFailedError, match=r"cam1_test\.mp4: announces 60000x60000 px"):
        import_stereo(recording, tmp_path / "hand")
    (recording / "cam1_test.mp4").write_bytes(b"no video")
    with pytest.raises(ImportFailedError, match=r"cam1_test\.mp4 cannot be decoded"):
        import_stereo(recording, tmp_path / "hand")
    (recording / "cam1_test.mp4").unlink()
    with pytest.raises(ImportFailedError, match=r"cam1\*\.mp4, found none"):
        import_stereo(recording, tmp_path / "hand")
    _video(recording / "cam0_again.mp4")
    with pytest.raises(ImportFailedError, match=r"found cam0_again\.mp4, cam0_test\.mp4"):
        import_stereo(recording, tmp_path / "hand")
