"""Raw recordings of a made-up scene: a ball on a table, seen by cameras that look down on it."""

import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.board_calibration import CharucoTarget
from physhandi.data.view import View
from physhandi.hand.names import HandSide
from physhandi.synthetic.raw_capture import photograph_board

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
FRAMES = 6
BOARD = CharucoTarget(7, 5, 0.04)


def camera_at(azimuth: float, scale: int = 1, distance: float = 0.7) -> PinholeCamera:
    """A camera around the table that looks at its middle, 40 degrees down."""
    angle, down = np.deg2rad(azimuth), np.deg2rad(40)
    eye = distance * np.array(
        [np.cos(angle) * np.cos(down), np.sin(angle) * np.cos(down), np.sin(down)]
    )
    z = (np.array([0.0, 0.0, 0.03]) - eye) / np.linalg.norm(np.array([0.0, 0.0, 0.03]) - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    K = np.array(
        [
            [FOCAL * scale, 0, (WIDTH * scale - 1) / 2],
            [0, FOCAL * scale, (HEIGHT * scale - 1) / 2],
            [0, 0, 1.0],
        ]
    )
    return PinholeCamera(K, pose, WIDTH * scale, HEIGHT * scale)


CAMERAS = {"left": camera_at(30), "right": camera_at(110)}


def ball(frame: int) -> tuple[ndarray, float]:
    """Middle and radius of the ball [m]: it rolls 1 cm a frame."""
    return np.array([-0.03 + 0.01 * frame, 0.02, 0.06]), 0.06


def rays(camera: PinholeCamera) -> tuple[ndarray, ndarray]:
    """Where the camera is, and which way each pixel looks at depth 1 (row column 3)."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixel = np.stack([x, y], axis=-1).astype(float)
    eye = camera.T_world_camera[:3, 3]
    return eye, camera.unproject(pixel, np.ones(pixel.shape[:2])) - eye


def find_no_hand(view: View, hands: tuple[HandSide, ...], *_: object) -> np.ndarray:
    """Tell of a view what the networks of `detect_view` tell, which take a second for that."""
    return np.full((view.frame_count, len(hands), 21, 3), np.nan, dtype=np.float32)


def picture(camera: PinholeCamera, frame: int) -> tuple[ndarray, ndarray]:
    """Color (RGB) and depth [m] of a frame, exactly."""
    # One test asks for a frame several times, and many tests for the same.
    color, depth = _picture(json.dumps(camera.to_dict()), frame)
    return color.copy(), depth.copy()


@cache
def _picture(calibration: str, frame: int) -> tuple[ndarray, ndarray]:
    camera = PinholeCamera.from_dict(json.loads(calibration))
    eye, way = rays(camera)
    table = np.where(way[..., 2] < -1e-6, -eye[2] / np.minimum(way[..., 2], -1e-6), np.inf)
    middle, radius = ball(frame)
    a = (way**2).sum(-1)
    b = way @ (eye - middle)
    root = b**2 - a * (((eye - middle) ** 2).sum() - radius**2)
    near = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    depth = np.minimum(table, near)
    place = eye + way * np.where(np.isfinite(depth), depth, 0)[..., None]
    checks = (np.floor(place[..., 0] / 0.05) + np.floor(place[..., 1] / 0.05)) % 2
    color = np.stack([120 + 60 * checks, 110 + 60 * checks, 100 + 60 * checks], axis=-1)
    color[near < table] = [200, 60, 50]
    return color.astype(np.uint8), np.where(depth < 3.0, depth, 0.0).astype(np.float32)


def intrinsics(camera: PinholeCamera) -> dict[str, float]:
    return {
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "width": camera.width,
        "height": camera.height,
    }


def board_picture(camera: PinholeCamera, lies: ndarray | None = None) -> ndarray:
    """A photograph of the board (BGR); `lies` maps the board's coordinates to the world."""
    if lies is None:  # OpenCV's board has z into the table.
        lies = np.diag([1.0, -1.0, -1.0, 1.0])
        lies[:3, 3] = [-0.14, 0.10, 0.0]
    return photograph_board(camera, BOARD, lies, family="5X5")


@dataclass
class RawCapture:
    """A folder that a recorder may have written."""

    folder: Path
    cameras: dict[str, PinholeCamera] = field(default_factory=lambda: dict(CAMERAS))

    def write(
        self, frames: int = FRAMES, *, poses: bool = True, times: bool = False
    ) -> "RawCapture":
        for name, camera in self.cameras.items():
            view = self.folder / name
            (view / "color").mkdir(parents=True)
            (view / "depth").mkdir()
            for frame in range(frames):
                color, depth = picture(camera, frame)
                cv2.imwrite(str(view / f"color/{frame:05d}.png"), color[..., ::-1])
                cv2.imwrite(
                    str(view / f"depth/{frame:05d}.png"), np.round(1000 * depth).astype(np.uint16)
                )
            table = intrinsics(camera)
            if poses:
                table["T_world_camera"] = camera.T_world_camera.tolist()
            (view / "intrinsics.json").write_text(json.dumps(table))
            if times:
                text = "\n".join(f"{100 + frame / 30:.6f}" for frame in range(frames))
                (view / "timestamps.txt").write_text(text)
        return self

    def table(self, view: str, **changes: object) -> None:
        path = self.folder / view / "intrinsics.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    def photograph_board(self, *places: ndarray | None) -> None:
        """Add calibration pictures of the board in one place, or in several."""
        for name, camera in self.cameras.items():
            folder = self.folder / "calibration" / name
            folder.mkdir(parents=True)
            for number, lies in enumerate(places or (None,)):
                cv2.imwrite(str(folder / f"{number:05d}.png"), board_picture(camera, lies))
