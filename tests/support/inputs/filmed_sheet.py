"""The sheet of `sheet_sequence`, as three cameras with color and masks see it; one is held out."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.rendering.renderer import rasterize
from physhandi.rendering.shapes import Surface
from support.inputs.sheet_sequence import FACES, FRAMES, NODE, write_sheet

WIDTH, HEIGHT = 96, 72
EYES = {"front": (0.1, -0.6, 0.85), "side": (0.7, 0.1, 0.9), "back": (0.1, 0.75, 0.8)}
HELD_OUT = "back"
"""The camera of which only scores may know."""
_TARGET = np.array([0.1, 0.1, 0.22])


def write_filmed_sheet(folder: Path) -> Sequence:
    """Film a sheet that two point controllers lift; its markers are its nodes.

    Args:
        folder: Folder to write; a sheet without pictures is written beside it.
    """
    plain = write_sheet(folder.parent / f"{folder.name}_plain")
    marker = np.load(plain.folder / "marker.npy")
    views = {name: camera_at(np.array(eye)) for name, eye in EYES.items()}
    with SequenceWriter(folder) as writer:
        for path in plain.folder.glob("*.npy"):
            writer.copy(path.name, path)
        for name, camera in views.items():
            place = f"truth/views/{name}" if name == HELD_OUT else f"views/{name}"
            for frame in range(FRAMES):
                raster = rasterize(camera, [Surface(vertex=marker[frame], faces=FACES)])
                color = raster.interpolate(FACES, colors(NODE)).round().astype(np.uint8)
                mask = (raster.shape == 0).astype(np.uint8)
                writer.save_image(f"{place}/color/{frame:05d}.png", color)
                writer.save_image(f"{place}/mask/{frame:05d}.png", mask)
        writer.save_yaml(f"truth/views/{HELD_OUT}/camera.yaml", views[HELD_OUT].to_dict())
        seen = tuple(ViewMeta(name=n, camera=c) for n, c in views.items() if n != HELD_OUT)
        return writer.finish(replace(plain.meta, name=folder.name, views=seen))


def colors(vertex: np.ndarray) -> np.ndarray:
    """A color that changes slowly over the sheet."""
    return (127 + 120 * np.sin(14 * vertex + [0, 1, 2])).clip(0, 255)


def camera_at(eye: np.ndarray) -> PinholeCamera:
    """Look at the sheet from somewhere."""
    ahead = (_TARGET - eye) / np.linalg.norm(_TARGET - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = eye
    K = np.array([[130.0, 0, (WIDTH - 1) / 2], [0, 130.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=WIDTH, height=HEIGHT)
