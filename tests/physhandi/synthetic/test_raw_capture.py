"""What is written as a raw capture is a recorder's: no masks, no poses, depth of the table too."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.raw_capture import camera_at, picture

from physhandi.data.importers.capture import import_capture
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import CancelledError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic import raw_capture
from physhandi.synthetic.raw_capture import (
    write_example_capture,
    write_raw_capture,
)

CAMERAS = {"camera0": camera_at(20, 3, 0.8), "camera1": camera_at(100, 3, 0.8)}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Sequence:
    """A made-up sequence: depth ends beside the ball."""
    folder = tmp_path_factory.mktemp("made") / "ball"
    with SequenceWriter(folder) as writer:
        for name, camera in CAMERAS.items():
            for frame in range(2):
                color, depth = picture(camera, frame)
                mask = (color[..., 0] == 200).astype(np.uint8)
                near = cv2.dilate(mask, np.ones((17, 17), np.uint8)) > 0
                rel = f"views/{name}/{{}}/{frame:05d}.png"
                writer.save_image(rel.format("color"), color)
                writer.save_image(rel.format("mask"), mask)
                writer.save_image(
                    rel.format("depth"), np.round(1000 * depth * near).astype(np.uint16)
                )
        views = tuple(ViewMeta(name=name, camera=camera) for name, camera in CAMERAS.items())
        return writer.finish(
            SequenceMeta(name="ball", frame_rate=30.0, frame_count=2, hands=("right",), views=views)
        )


@pytest.fixture(scope="module")
def folder(sequence, tmp_path_factory) -> Path:
    """The raw capture of it, which nothing changes."""
    return write_raw_capture(sequence, tmp_path_factory.mktemp("captured") / "raw")


def test_a_capture_holds_what_a_recorder_writes_and_nothing_else(folder):
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    of_view = ["color/00000.png", "color/00001.png", "depth/00000.png", "depth/00001.png"]
    of_view += ["intrinsics.json", "timestamps.txt"]
    assert files == [
        "calibration/board.json",
        *(f"calibration/{name}/{place}.png" for name in CAMERAS for place in range(3)),
        *(f"{name}/{file}" for name in CAMERAS for file in of_view),
    ]
    assert set(json.loads((folder / "camera0/intrinsics.json").read_text())) == {
        *("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    }
    assert [path.name for path in folder.parent.iterdir()] == ["raw"]


def test_depth_of_the_table_is_measured_where_the_sequence_keeps_none(folder):
    depth = cv2.imread(str(folder / "camera0/depth/00001.png"), cv2.IMREAD_UNCHANGED) / 1000.0
    true = picture(CAMERAS["camera0"], 1)[1]
    known = depth > 0
    assert 0.9 < known.mean() < 1.0
    error = np.abs(depth - true)[known & (true > 0)]
    assert np.median(error) < 4e-3
    assert error[true[known & (true > 0)] < 1].mean() > 1e-4  # As noisy as a sensor.


def test_the_board_s_pictures_give_the_cameras_back(folder, tmp_path):
    imported = import_capture(folder, tmp_path / "back")  # It tells which board it is.
    assert imported.provenance["calibration"]["by"].startswith("board, ChArUco, 5x4 squares")
    found = [view.camera.T_world_camera for view in imported.views]
    true = [camera.T_world_camera for camera in CAMERAS.values()]
    off = np.linalg.inv(np.linalg.inv(found[0]) @ found[1]) @ np.linalg.inv(true[0]) @ true[1]
    assert np.linalg.norm(off[:3, 3]) < 3e-3
    assert np.rad2deg(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))) < 0.3
    for pose, exact in zip(found, true, strict=True):
        assert np.abs(pose[2] - exact[2]).max() < 3e-3


def test_the_example_names_its_board_and_a_click_on_the_object(sequence, tmp_path, monkeypatch):
    asked = {}

    def made(object_: str, action: str, **options: object) -> Sequence:
        asked.update(options, object=object_, action=action)
        return sequence

    monkeypatch.setattr(raw_capture, "synthesize", made)
    folder = write_example_capture(tmp_path / "try")
    assert asked["changes"] == {"camera_shift": 0.0, "camera_turn": 0.0, "time_skew": 0.0}
    text = (folder / "README.txt").read_text()
    assert "--charuco 5x4,0.09" in text
    click = next(word for word in text.split() if word.startswith("camera0,0,"))
    x, y = map(int, click.split(",")[2:])
    assert sequence.views[0].mask(0)[y, x] == 1
    with pytest.raises(UsageError, match="holds something already"):
        write_example_capture(tmp_path / "try")


class _Stops(Progress):
    def check_cancelled(self) -> None:
        raise CancelledError("stop")


def test_a_cancelled_capture_leaves_nothing(sequence, tmp_path):
    with pytest.raises(CancelledError):
        write_raw_capture(sequence, tmp_path / "raw", progress=_Stops())
    assert list(tmp_path.iterdir()) == []
