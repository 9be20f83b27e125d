"""The real recording that ships with the project, and the run that was made of it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.bundled_recording import FRAMES, SIZE, shrink, smaller
from support.inputs.recordings import recording as published

from physhandi.data.camera import PinholeCamera
from physhandi.data.layout import SequenceFiles
from physhandi.data.sequence import Sequence
from physhandi.run import Run

SHIPPED = Path(__file__).parents[3] / "sequences"
FOLDERS = SHIPPED / "stereo_hand", SHIPPED / "runs" / "stereo_hand_default"


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return Sequence.load(FOLDERS[0])


def test_a_smaller_camera_sees_points_where_its_smaller_image_shows_them() -> None:
    K = np.array([[900.0, 0.0, 350.0], [0.0, 910.0, 361.5], [0.0, 0.0, 1.0]])
    lens = np.array([0.1, -0.2, 0.01, -0.02, 0.05])
    camera = PinholeCamera(K=K, T_world_camera=np.eye(4), width=720, height=720, distortion=lens)
    point = np.array([[0.3, -0.2, 1.0], [-0.1, 0.25, 1.2]])
    # Edges of pixels, not their middles, are scaled with the image.
    expected = (camera.project(point) + 0.5) * SIZE / 720 - 0.5
    np.testing.assert_allclose(smaller(camera).project(point), expected, atol=1e-9)


def test_the_shipped_frames_are_those_of_the_download(sequence) -> None:
    sequence.validate()
    video = cv2.VideoCapture(str(published("stereo_hand") / "cam1_test.mp4"))
    whole = [video.read()[1] for _ in range(FRAMES[2] + 2)]
    video.release()

    def distances(frame: int) -> list[float]:
        """Mean difference between the first shipped frame and this one and its neighbors."""
        shipped = sequence.views[1].color(frame).astype(float)
        around = [shrink(whole[FRAMES[frame] + step][..., ::-1]) for step in (-1, 0, 1)]
        return [float(np.abs(shipped - image).mean()) for image in around]

    for frame in (1, 2):
        before, same, after = distances(frame)
        assert same < 4.0
        assert same < 0.95 * min(before, after)
    assert (FOLDERS[0] / "LICENSE").read_bytes() == (
        published("stereo_hand") / "LICENSE"
    ).read_bytes()


def test_its_licence_is_told_and_both_folders_are_small(sequence) -> None:
    assert "handpose3d" in sequence.provenance["origin"]
    assert sequence.provenance["licence"] == "MIT, see LICENSE"
    assert "MIT" in (FOLDERS[0] / "LICENSE").read_text()
    listed = (SHIPPED / "README.md").read_text()
    assert "stereo_hand/LICENSE" in listed
    files = [path for folder in FOLDERS for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 2_000_000


def test_the_hand_of_the_run_lies_over_both_videos(sequence) -> None:
    run = Run.open(FOLDERS[1])
    run.verify()
    assert [Path(folder).resolve() for folder in run.sequences] == [FOLDERS[0]]
    files = SequenceFiles("stereo_hand")
    joint = run.array(files.hand_keypoint("right")).astype(float)
    seen = run.array(files.keypoint)[:, :, 0]
    assert len(sequence.views) == len(seen) == 2
    for view, keypoint in zip(sequence.views, seen, strict=True):
        away = np.linalg.norm(view.camera.project(joint) - keypoint[..., :2], axis=-1)
        assert np.nanmedian(away) < 2.0
