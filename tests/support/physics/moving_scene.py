"""A small run with two moving hands, an object and its surface, for tests of exporters."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physhandi.fitting.artefacts import save_hand_vertices, save_motions
from physhandi.hand.motion import HandMotion
from physhandi.run import Run

FRAMES, NODES, RATE = 4, 5, 25.0
ROLLOUT = np.random.default_rng(4).normal(size=(FRAMES, NODES, 3)).astype(np.float32)
SPRINGS = np.array([[0, 1], [1, 2], [3, 4], [NODES + 3, 0]], np.int32)


def _motions() -> tuple[HandMotion, ...]:
    random = np.random.default_rng(1)
    return tuple(
        HandMotion(
            side=side,
            shape=random.normal(size=10),
            articulation=0.5 * random.normal(size=(FRAMES, 15, 3)),
            wrist_rotation=2 * random.normal(size=(FRAMES, 3)),
            wrist_translation=0.3 * random.normal(size=(FRAMES, 3)),
        )
        for side in ("right", "left")
    )


def write_run(folder: Path, *, has_object: bool = True) -> Run:
    run = Run.create(folder, name="fit", kind="reconstruction", sequences=["/data/lift"], config={})
    with run.begin_attempt() as attempt:
        base = "sequences/lift"
        attempt.save_yaml(f"{base}/meta.yaml", {"frame_rate": RATE, "frame_count": FRAMES})
        save_motions(attempt, "lift", _motions())
        save_hand_vertices(attempt, "lift")
        if has_object:
            attempt.save_array(f"{base}/rollout.npy", ROLLOUT)
            counts = {"object_spring_count": np.array([3], np.int32)}
            attempt.save_tensors(f"{base}/model.safetensors", {"spring_nodes": SPRINGS, **counts})
        attempt.publish()
    return Run.open(run.folder)


@dataclass(frozen=True)
class Pyramid:
    """A pyramid over the x-y plane whose top rises as the nodes move on, in four gray levels.

    The fifth vertex is in no triangle.
    """

    vertex: np.ndarray
    face: np.ndarray
    color: np.ndarray

    def place(self, node: np.ndarray) -> np.ndarray:
        (frame,) = np.flatnonzero((node == ROLLOUT).all(axis=(1, 2)))
        return self.vertex[frame]


def pyramid() -> Pyramid:
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], np.float32)
    vertex = np.tile(corner, (FRAMES, 1, 1))
    vertex[:, 3, 2] += np.arange(FRAMES)
    face = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    color = np.repeat(np.array([[0], [10], [128], [255], [255]], np.uint8), 3, axis=1)
    return Pyramid(vertex, face, color)
