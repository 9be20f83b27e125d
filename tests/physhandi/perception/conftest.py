from pathlib import Path

import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter

RISE = 0.01
"""Height that the plate gains from frame to frame [m]."""


def camera_above(x: float) -> PinholeCamera:
    """A camera 0.6 m above the ground that looks straight down; image x is world x."""
    pose = np.array([[1, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 0.6], [0, 0, 0, 1]], dtype=float)
    K = np.array([[150, 0, 60], [0, 150, 50], [0, 0, 1]], dtype=float)
    return PinholeCamera(K=K, T_world_camera=pose, width=121, height=101)


def plate_images(camera: PinholeCamera, height: float, hand: bool) -> tuple[np.ndarray, np.ndarray]:
    """A plate of 200 x 120 mm at a height; a hand covers the middle of its +x side, 3 cm above."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixel = np.stack([columns, rows], axis=-1).astype(float)
    point = camera.unproject(pixel, np.full(columns.shape, 0.6 - height))
    mask = ((abs(point[..., 0]) < 0.1) & (abs(point[..., 1]) < 0.06)).astype(np.uint8)
    depth = np.where(mask > 0, 600 - 1000 * height, 600.0)
    if hand:
        point = camera.unproject(pixel, np.full(columns.shape, 0.6 - height - 0.03))
        covered = (point[..., 0] > 0.05) & (abs(point[..., 1]) < 0.03)
        mask[covered], depth[covered] = 2, 570 - 1000 * height
    return np.round(depth).astype(np.uint16), mask


def write_plate(
    folder: Path, *, frames: int = 3, hand: bool = False, tracks: bool = True
) -> Sequence:
    cameras = {"a": camera_above(-0.02), "b": camera_above(0.02)}
    spots = np.stack(np.meshgrid(np.arange(-8, 9) * 0.01, np.arange(-4, 5) * 0.01), -1).reshape(
        -1, 2
    )
    with SequenceWriter(folder) as writer:
        for name, camera in cameras.items():
            pixel = np.zeros((frames, len(spots), 2), dtype=np.float32)
            for frame in range(frames):
                depth, mask = plate_images(camera, RISE * frame, hand)
                writer.save_image(f"views/{name}/depth/{frame:05d}.png", depth)
                writer.save_image(f"views/{name}/mask/{frame:05d}.png", mask)
                height = np.full((len(spots), 1), RISE * frame)
                pixel[frame] = camera.project(np.concatenate([spots, height], axis=1))
            if tracks:
                writer.save_array(f"views/{name}/track.npy", pixel)
                visible = np.ones(pixel.shape[:2], dtype=bool)
                writer.save_array(f"views/{name}/track_visible.npy", visible)
        return writer.finish(
            SequenceMeta(
                name="plate",
                frame_rate=30.0,
                frame_count=frames,
                ground_height=0.0,
                hands=("right",) if hand else (),
                views=tuple(ViewMeta(name=n, camera=c) for n, c in cameras.items()),
            )
        )


@pytest.fixture(scope="session")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write_plate(tmp_path_factory.mktemp("plain") / "plate")


@pytest.fixture(scope="session")
def held_plate(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write_plate(tmp_path_factory.mktemp("held") / "plate", hand=True, tracks=False)
