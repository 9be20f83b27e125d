"""A painted disc that slides over a painted table, filmed by two cameras: every mask is known."""

import itertools
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence

FRAMES = 9
WIDTH, HEIGHT = 120, 96
RADIUS, TOP = 0.055, 0.03
"""Radius of the disc and height of its face above the table [m]."""
STEP = np.array([0.006, 0.002])
"""Motion of the disc from frame to frame [m]."""
HAND_TOP = 0.07
"""Height of the flat hand [m]."""
ABOVE_HAND = 0.12
"""Height of the disc's face where it is held over the hand [m]."""
FINGERS = 0.008
"""Radius of its fingers [m]."""
_WAVES = np.random.default_rng(3).uniform(-1, 1, (12, 3))


def center(frame: int) -> np.ndarray:
    """Where the disc is [m]."""
    return np.array([-0.03, -0.01]) + frame * STEP


def cameras() -> dict[str, PinholeCamera]:
    """One camera looks down, the other one tilted."""
    found = {}
    for name, turn, place in (("top", 0.0, (0, 0, 0.5)), ("side", 0.5, (0, -0.25, 0.45))):
        down = np.diag([1.0, -1.0, -1.0])
        c, s = np.cos(turn), np.sin(turn)
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ down
        pose[:3, 3] = place
        K = np.array([[140, 0, WIDTH / 2], [0, 140, HEIGHT / 2], [0, 0, 1]])
        found[name] = PinholeCamera(K=K, T_world_camera=pose, width=WIDTH, height=HEIGHT)
    return found


def joints(frame: int) -> np.ndarray:
    """21 keypoints of a flat hand that comes in over the disc [m]."""
    wrist = np.array([0.09 - 0.006 * frame, 0.02])
    points = [wrist]
    for finger in range(5):
        base = np.array([-0.03 - 0.02 * (finger > 0), 0.02 - 0.01 * finger])
        points += [wrist + base - part * np.array([0.012, 0.0]) for part in range(4)]
    return np.column_stack([np.array(points), np.full(21, HAND_TOP)])


def _hand(plane: np.ndarray, frame: int) -> np.ndarray:
    """Tell which places [m] of the hand's plane are the hand."""
    joint = joints(frame)[:, :2]
    sides = ConvexHull(joint[[0, 1, 5, 9, 13, 17]]).equations
    inside = (plane @ sides[:, :2].T + sides[:, 2] < 0).all(axis=-1)
    for finger in range(5):
        chain = joint[[0, *range(1 + 4 * finger, 5 + 4 * finger)]]
        for a, b in itertools.pairwise(chain):
            along = np.clip((plane - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            inside |= np.linalg.norm(plane - a - along[..., None] * (b - a), axis=-1) < FINGERS
    return inside


def _paint(place: np.ndarray, low: tuple[int, ...], high: tuple[int, ...]) -> np.ndarray:
    """Color places [m] by a pattern of waves."""
    value = np.zeros(place.shape[:2])
    for x, y, phase in _WAVES:
        value += np.sin(260 * (x * place[..., 0] + y * place[..., 1]) + 9 * phase)
    share = (0.5 + 0.5 * np.tanh(value / 2))[..., None]
    return np.asarray(low) * (1 - share) + np.asarray(high) * share


@cache  # Many tests write the same recording.
def picture(view: str, frame: int, *, hand: bool, top: float) -> tuple[np.ndarray, ...]:
    """Draw color, depth [mm] and labels of a frame; the disc's face is at the height `top`."""
    camera = cameras()[view]
    row, column = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    pixel = np.stack([column, row], axis=-1)
    eye = camera.T_world_camera[:3, 3]
    ray = camera.unproject(pixel, np.ones(row.shape)) - eye

    def plane(height: float) -> tuple[np.ndarray, np.ndarray]:
        depth = (height - eye[2]) / ray[..., 2]
        return (eye + ray * depth[..., None])[..., :2], depth

    place, depth = plane(0.0)
    color = _paint(place, (176, 168, 150), (206, 198, 182))
    label = np.zeros(row.shape, dtype=np.uint8)
    face, far = plane(top)
    on_disc = np.linalg.norm(face - center(frame), axis=-1) < RADIUS
    color[on_disc] = _paint(face - center(frame), (30, 60, 150), (90, 170, 90))[on_disc]
    depth, label[on_disc] = np.where(on_disc, far, depth), 1
    if hand:
        face, far = plane(HAND_TOP)
        is_hand = _hand(face, frame) & (far < depth)
        color[is_hand], label[is_hand] = (214, 150, 128), 2
        depth = np.where(is_hand, far, depth)
    return color.round().astype(np.uint8), (1000 * depth).round().astype(np.uint16), label


def write_disc(
    folder: Path,
    *,
    hand: bool = False,
    masks: bool = False,
    frames: int = FRAMES,
    top: float = TOP,
) -> tuple[Sequence, dict[str, np.ndarray]]:
    """Write the recording; gives the true labels of each view, too."""
    images: dict[str, np.ndarray] = {}
    arrays: dict[str, np.ndarray] = {}
    labels: dict[str, np.ndarray] = {}
    for name, camera in cameras().items():
        drawn = [picture(name, frame, hand=hand, top=top) for frame in range(frames)]
        labels[name] = np.stack([label for _, _, label in drawn])
        for frame, (color, depth, label) in enumerate(drawn):
            images[f"views/{name}/color/{frame:05d}.png"] = color
            images[f"views/{name}/depth/{frame:05d}.png"] = depth
            if masks:
                images[f"views/{name}/mask/{frame:05d}.png"] = label
        if hand:
            seen = np.stack([camera.project(joints(frame)) for frame in range(frames)])
            one = np.concatenate([seen, np.ones((frames, 21, 1))], axis=-1)
            arrays[f"views/{name}/keypoint.npy"] = one[:, None].astype(np.float32)
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=frames,
        ground_height=0.0,
        hands=("right",) if hand else (),
        views=tuple(ViewMeta(name=name, camera=camera) for name, camera in cameras().items()),
    )
    return write_sequence(folder, meta, arrays, images=images), labels


def disc_click(
    view: str = "top", frame: int = 0, top: float = TOP
) -> tuple[str, int, float, float]:
    """Give a place on the disc, left of its middle, as a click names it."""
    place = np.append(center(frame) - [0.025, 0.0], top)
    x, y = cameras()[view].project(place)
    return view, frame, round(float(x)), round(float(y))
