"""A made-up hand that is known exactly, filmed by made-up cameras."""

from pathlib import Path

import numpy as np

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import HandKind, HandSide

SIZE = 240


def looking_at_hand(azimuth: float, distance: float = 0.6) -> PinholeCamera:
    """A camera that looks at (0, 0, 0.2) from an azimuth, slightly from above."""
    target = np.array([0, 0, 0.2])
    position = target + distance * np.array([np.cos(azimuth), np.sin(azimuth), 0.5])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    K = np.array([[420.0, 0, SIZE / 2], [0, 420, SIZE / 2], [0, 0, 1]])
    distortion = np.array([0.05, -0.02, 0.001, -0.001, 0.0])
    return PinholeCamera(K=K, T_world_camera=pose, width=SIZE, height=SIZE, distortion=distortion)


def flat_and_bent(side: HandSide) -> HandMotion:
    """A hand that is flat in frame 0, and turned and bent a little everywhere in frame 1."""
    mirror = np.array([1.0, 1.0, 1.0] if side == "right" else [1.0, -1.0, -1.0])
    rng = np.random.default_rng(4)
    bent = np.zeros((2, 15, 3))
    bent[1] = 0.1 * rng.normal(size=(15, 3)) - [0.3, 0.0, 0.0]
    return HandMotion(
        side=side,
        shape=np.zeros(10),
        articulation=bent * mirror,
        wrist_rotation=np.array([[0.0, 0.0, 0.0], [0.2, -0.4, 0.1]]) * mirror,
        wrist_translation=np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]) * [mirror[1], 1.0, 1.0],
    )


def grasping(
    side: HandSide = "right", frames: int = 16, scale: float = 1.0, model: HandKind = "open"
) -> HandMotion:
    """A hand with a shape of its own that closes while it turns and moves."""
    time = np.linspace(0, 1, frames)
    articulation = np.zeros((frames, 15, 3))
    articulation[:, 3:, 0] = -0.2 - 0.8 * time[:, None] * np.linspace(0.6, 1, 12)
    articulation[:, 0:3, 0] = -0.1 - 0.3 * time[:, None]
    rotation = np.zeros((frames, 3))
    rotation[:, 0], rotation[:, 2] = -1.3, 2.9 + 0.6 * time
    translation = np.stack([0.05 * time, -0.04 + 0.02 * time, 0.2 + 0.03 * time**2], axis=1)
    return HandMotion(
        side=side,
        shape=np.array([0.8, 0.5, -0.5, 0.3, -0.4, 0.6, 0.2, -0.6, 0.0, 0.4]),
        articulation=articulation,
        wrist_rotation=rotation,
        wrist_translation=translation,
        scale=scale,
        model=model,
    )


def seen_keypoints(
    motions: list[HandMotion], cameras: list[PinholeCamera], noise: float = 0.0
) -> np.ndarray:
    """What a detector with normal noise [px] reports of the hands, in "view frame hand 21 3"."""
    random = np.random.default_rng(0)
    joint = [m.keypoints(load_hand_model(m.side, m.model)).astype(np.float64) for m in motions]
    pixel = np.stack([np.stack([c.project(j) for j in joint], axis=1) for c in cameras])
    pixel = pixel + noise * random.standard_normal(pixel.shape)
    return np.concatenate([pixel, np.full_like(pixel[..., :1], 0.9)], -1).astype(np.float32)


def depth_image(
    camera: PinholeCamera, vertex: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [mm] and mask of a hand: of the samples in a pixel the nearest wins."""
    share = np.array([(a, b, 4 - a - b) for a in range(5) for b in range(5 - a)]) / 4
    point = np.einsum("sk,fkc->fsc", share, vertex[faces]).reshape(-1, 3).astype(np.float64)
    pixel = np.round(camera.project(point)).astype(int)
    is_inside = ((pixel >= 0) & (pixel < SIZE)).all(-1)
    millimetre = np.full((SIZE, SIZE), 60000.0)
    near = 1000 * camera.camera_depth(point)
    np.minimum.at(millimetre, (pixel[is_inside, 1], pixel[is_inside, 0]), near[is_inside])
    is_hand = millimetre < 60000
    depth = np.where(is_hand, np.round(millimetre), 0).astype(np.uint16)
    return depth, is_hand.astype(np.uint8)


def write_scene(
    folder: Path,
    motions: list[HandMotion],
    cameras: list[PinholeCamera],
    keypoint: np.ndarray | None,
    *,
    metric: bool = True,
    depth: bool = False,
) -> Sequence:
    """Write a sequence of the hands, with keypoints and, if asked for, depth and masks."""
    names = [f"view{i}" for i in range(len(cameras))]
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=motions[0].frame_count,
        metric=metric,
        length_unit="m" if metric else "square",
        hands=tuple(motion.side for motion in motions),
        views=tuple(ViewMeta(name=n, camera=c) for n, c in zip(names, cameras, strict=True)),
    )
    labels = {"right": 2, "left": 3}
    with SequenceWriter(folder) as writer:
        for view, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            if keypoint is not None:
                writer.save_array(f"views/{name}/keypoint.npy", keypoint[view])
            for frame in range(motions[0].frame_count if depth else 0):
                hand = load_hand_model(motions[0].side, motions[0].model)
                vertex = motions[0].vertices(hand)[frame]
                image, mask = depth_image(camera, vertex, hand.faces)
                writer.save_image(f"views/{name}/depth/{frame:05d}.png", image)
                mask = (mask * labels[motions[0].side]).astype(np.uint8)
                writer.save_image(f"views/{name}/mask/{frame:05d}.png", mask)
        return writer.finish(meta)
