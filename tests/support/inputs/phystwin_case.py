"""A small case in PhysTwin's format for tests, with the traps that real ones have.

World: a board on the table whose z axis points down, so the object has z < 0. Everything is made
from formulas here; the importer's results can be compared with the arrays of `Case`.
"""

import json
import pickle
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FRAMES, WIDTH, HEIGHT = 5, 96, 72
TRAIN = 3
K = np.array([[110.0, 0, 50], [0, 112, 33], [0, 0, 1]])
OBJECT, HAND, OTHER_HAND = "2", "0", "10"
"""Numbers of the masks; as text, 10 would come before 2."""


@dataclass
class Case:
    """What was written, in the case's world."""

    folder: Path
    point: np.ndarray  # (frame, point, 3), also where invisible
    is_visible: np.ndarray
    motion_valid: np.ndarray  # entry t: motion from t to t + 1
    surface: np.ndarray
    interior: np.ndarray
    control: np.ndarray
    pose: np.ndarray  # camera to world
    validation: np.ndarray

    @property
    def node(self) -> np.ndarray:
        return np.concatenate([self.point[0], self.surface, self.interior])


def write_case(
    folder: Path,
    *,
    camera_count: int = 3,
    z_down: bool = True,
    has_prior: bool = True,
    has_images: bool = True,
) -> Case:
    """Write a soft block that two "fingers" lift and shear."""
    folder.mkdir(parents=True)
    up = -1.0 if z_down else 1.0
    case = _make(folder, camera_count, up, has_prior=has_prior)
    hidden = ~case.is_visible
    final: dict[str, Any] = {
        "object_points": np.where(hidden[..., None], 0.0, case.point),
        "object_colors": np.where(hidden[..., None], 0.0, 0.5),
        "object_visibilities": case.is_visible,
        "object_motions_valid": case.motion_valid,
        "controller_points": case.control,
        "surface_points": case.surface,
        "interior_points": case.interior,
        "controller_mask": np.ones(7, int),
    }
    save_pickle(folder / "final_data.pkl", final)
    save_pickle(folder / "calibrate.pkl", list(case.pose))
    split = {"frame_len": FRAMES, "train": [0, TRAIN], "test": [TRAIN, FRAMES]}
    (folder / "split.json").write_text(json.dumps(split))
    if has_images:
        save_pickle(folder / "gt_track_3d.pkl", case.validation)
        metadata = {
            "intrinsics": [(K + np.diag([c, c, 0])).tolist() for c in range(camera_count)],
            "serial_numbers": [f"sn{c}" for c in range(camera_count)],
            "fps": 30,
            "WH": [WIDTH, HEIGHT],
            "frame_num": FRAMES,
        }
        (folder / "metadata.json").write_text(json.dumps(metadata))
        for camera in range(camera_count):
            _write_images(case, camera)
    return case


def save_pickle(path: Path, value: Any) -> None:
    path.write_bytes(pickle.dumps(value))


def edit_pickle(path: Path, **fields: Any) -> None:
    """Replace fields of a pickled dict; None removes one."""
    table = pickle.loads(path.read_bytes()) | fields  # noqa: S301 - this file wrote it
    save_pickle(path, {key: value for key, value in table.items() if value is not None})


def edit_json(path: Path, **fields: Any) -> None:
    """Replace fields of a JSON file; None removes one."""
    table = json.loads(path.read_text()) | fields
    path.write_text(json.dumps({key: value for key, value in table.items() if value is not None}))


def pixel_of(case: Case, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Project the tracked points: pixel x and y, and depth [m]."""
    world_to_camera = np.linalg.inv(case.pose[camera])
    local = case.point @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    homogeneous = local @ (K + np.diag([camera, camera, 0])).T
    return homogeneous[..., :2] / homogeneous[..., 2:], local[..., 2]


def _make(folder: Path, camera_count: int, up: float, *, has_prior: bool) -> Case:
    rng = np.random.default_rng(5)
    axis = np.arange(4) * 0.012
    grid = np.stack(np.meshgrid(axis, axis, axis[:3], indexing="ij"), -1).reshape(-1, 3)
    # No two distances alike: neighbours at the same distance have no order of their own.
    grid = grid + rng.normal(0, 0.0011, grid.shape) + [0.03, 0.02, 0.006]
    kind = rng.permutation(np.repeat([0, 1, 2], [26, 12, 10]))
    time = np.arange(FRAMES)[:, None, None]
    move = time * [0.002, 0.003, 0.004] * (0.5 + 20 * grid[None, :, :1])
    path = (grid + move) * [1, 1, up]
    point = path[:, kind == 0]
    top = grid[:, 2].argsort()[-2:]
    control = path[:, top] + np.array([0.001, 0.002, 0.006 * up])
    is_visible = rng.random((FRAMES, 26)) < 0.8
    is_visible[0] = True
    motion_valid = np.zeros((FRAMES, 26), bool)
    motion_valid[:-1] = is_visible[1:] & is_visible[:-1]
    motion_valid[1, 4] = False
    motion_valid[2, ::5] = False
    validation = path[:, ::9].copy()
    validation[1, 2] = np.nan
    none = np.zeros((0, 3))
    return Case(
        folder=folder,
        point=point,
        is_visible=is_visible,
        motion_valid=motion_valid,
        surface=path[0, kind == 1] if has_prior else none,
        interior=path[0, kind == 2] if has_prior else none,
        control=control,
        pose=np.stack([_look_at_object(c, up) for c in range(camera_count)]),
        validation=validation,
    )


def _look_at_object(camera: int, up: float) -> np.ndarray:
    """Stand above the table and look at the object (x right, y down, z forward)."""
    turn = 2.1 * camera + 0.3
    eye = np.array([0.3 * np.cos(turn), 0.3 * np.sin(turn), 0.35 * up])
    forward = np.array([0.05, 0.04, 0.02 * up]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, up])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def color_of(camera: int, frame: int) -> np.ndarray:
    """RGB, another in each corner of the image."""
    image = np.full((HEIGHT, WIDTH, 3), 10 * camera + 3 * frame, np.uint8)
    image[:9, :20] = [200, 100, frame]
    return image


def masks_of(frame: int) -> dict[str, np.ndarray]:
    """Masks that overlap, as SAM's may."""
    masks = {number: np.zeros((HEIGHT, WIDTH), bool) for number in (OBJECT, HAND, OTHER_HAND)}
    masks[OBJECT][20:50, 20 + frame : 60 + frame] = True
    masks[HAND][40:60, 30:45] = True
    masks[OTHER_HAND][10:30, 50:70] = True
    return masks


def depth_of(case: Case, camera: int, frame: int) -> np.ndarray:
    """Depth image [mm]: a background, and the visible points."""
    pixel, depth = pixel_of(case, camera)
    image = np.full((HEIGHT, WIDTH), 900 + frame, np.uint16)
    image[:4] = 0
    for number in depth[frame].argsort()[::-1]:
        x, y = np.rint(pixel[frame, number]).astype(int)
        image[y, x] = round(1000 * depth[frame, number])
    return image


def write_video(folder: Path, camera: int, frame_count: int = FRAMES) -> Path:
    """Put a video in the place of a camera's color images; frame f is grey of 40 f."""
    shutil.rmtree(folder / f"color/{camera}")
    path = folder / f"color/{camera}.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (WIDTH, HEIGHT))
    for frame in range(frame_count):
        writer.write(np.full((HEIGHT, WIDTH, 3), 40 * frame, np.uint8))
    writer.release()
    return path


def _write_images(case: Case, camera: int) -> None:
    folder = case.folder
    for rel in ("color", "depth", *(f"mask/{camera}/{n}" for n in (OBJECT, HAND, OTHER_HAND))):
        part = folder / rel if rel.startswith("mask") else folder / rel / str(camera)
        part.mkdir(parents=True)
    labels = {OBJECT: "sloth", HAND: "hand", OTHER_HAND: "hand"}
    (folder / f"mask/mask_info_{camera}.json").write_text(json.dumps(labels))
    for frame in range(FRAMES):
        cv2.imwrite(str(folder / f"color/{camera}/{frame}.png"), color_of(camera, frame)[..., ::-1])
        np.save(folder / f"depth/{camera}/{frame}.npy", depth_of(case, camera, frame))
        for number, mask in masks_of(frame).items():
            cv2.imwrite(str(folder / f"mask/{camera}/{number}/{frame}.png"), mask * np.uint8(255))
    (folder / "cotracker").mkdir(exist_ok=True)
    tracks = pixel_of(case, camera)[0][..., ::-1].astype(np.float32)
    np.savez(folder / f"cotracker/{camera}.npz", tracks=tracks, visibility=case.is_visible)
