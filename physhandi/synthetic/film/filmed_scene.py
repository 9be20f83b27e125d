"""The scene of a synthetic recording: surfaces that move over time."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.sequence_meta import SIDES, Side
from physhandi.synthetic.engines.truth import PhysicalTruth
from physhandi.synthetic.film.degradations import Degradations, hand_shift
from physhandi.synthetic.film.filming import SurfacePoints
from physhandi.synthetic.film.rendering import Dye, Scene, compose, light_camera
from physhandi.synthetic.hands.true_hand import TrueHand, soft_tissue_offset
from physhandi.triangles import triangle_areas

MASK_VALUE: dict[Side, int] = {"right": 2, "left": 3}
"""Mask value of each hand."""
_DYES = {
    "cloth": Dye(),
    "towel": Dye(top=(0.66, 0.30, 0.26), back=(0.78, 0.50, 0.45)),
    "rope": Dye(top=(0.80, 0.68, 0.36), stripe=(0.30, 0.25, 0.18)),
    "plush": Dye(top=(0.47, 0.34, 0.24), stripe=(0.78, 0.66, 0.52)),
    "pouch": Dye(top=(0.26, 0.34, 0.58), stripe=(0.85, 0.72, 0.30)),
}
_DRAWN_PER_KEPT = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmedHand:
    """The surface of one hand over time."""

    side: Side
    """Side of the hand."""
    vertex: Float[ndarray, "frame vertex 3"]
    """Vertices [m]."""
    faces: Int[ndarray, "face 3"]
    """Triangles."""
    keypoint: Float[ndarray, "frame 21 3"]
    """Keypoints in MediaPipe's order [m]."""
    shift: Float[ndarray, "frame 3"]
    """Offset at which it is filmed and detected, an error of the recording [m]."""

    def in_place(self) -> "FilmedHand":
        """Return the hand where it really is."""
        return replace(self, shift=np.zeros_like(self.shift))


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmedScene:
    """Everything that is filmed, in every frame."""

    name: str
    """Kind of the body."""
    skin: Float[ndarray, "frame vertex 3"]
    """Surface of the body [m]."""
    faces: Int[ndarray, "face 3"]
    """Its triangles, seen from outside or from above."""
    contact: Bool[ndarray, "frame vertex"]
    """Whether a hand touches a place of the surface."""
    hands: tuple[FilmedHand, ...]
    """Hands, the right one first."""
    frame_rate: float
    """Frames per second [Hz]."""
    device: str = "cpu"
    """Warp device that draws it."""

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.skin)

    def extent(self) -> Float[ndarray, "point 3"]:
        """List points that span the space used over time [m]."""
        parts = [self.skin[::5, ::4], *(hand.keypoint[::5] for hand in self.hands)]
        return np.concatenate([part.reshape(-1, 3) for part in parts]).astype(np.float64)

    def skin_at(self, frame: float) -> Float[ndarray, "vertex 3"]:
        """Interpolate the surface of the body at a frame or between two [m]."""
        return _between(self.skin, frame)

    def keypoints_at(self, frame: float) -> Float[ndarray, "hand 21 3"]:
        """Interpolate the keypoints of all hands as detected, at a frame or between two [m]."""
        keypoints = [
            _between(hand.keypoint, frame) + _between(hand.shift, frame) for hand in self.hands
        ]
        return np.stack(keypoints) if keypoints else np.zeros((0, 21, 3))

    def scene_at(self, frame: float) -> Scene:
        """Compose the visible surfaces at a frame or between two."""
        rest = self.skin[0]
        return compose(
            self.skin_at(frame),
            self.faces,
            # Height counts too, or the sides of a thick body would have stripes drawn out.
            np.stack([rest[:, 0], rest[:, 1] + rest[:, 2]], axis=1).astype(np.float64),
            [
                (
                    MASK_VALUE[hand.side],
                    _between(hand.vertex, frame) + _between(hand.shift, frame),
                    hand.faces,
                )
                for hand in self.hands
            ],
            dye=_DYES.get(self.name),
            light=light_camera(800, 1800.0),
            device=self.device,
        )


def make_filmed_scene(
    truth: PhysicalTruth, hands: Mapping[Side, TrueHand], level: Degradations, seed: int
) -> FilmedScene:
    """Give body and hands the surfaces that cameras see.

    Args:
        truth: What has happened.
        hands: Bare hand of each side that takes part.
        level: How the hands differ from what any model knows, and how far off they are found.
        seed: Decides the soft tissue and the way in which they are off.
    """
    body = truth.body
    filmed = []
    for side in SIDES:
        if side not in truth.hands:
            continue
        bare = hands[side]
        tissue = level.hand_mismatch * soft_tissue_offset(bare, seed)
        hand = replace(bare, rest_vertex=bare.rest_vertex + tissue)
        posed = [hand.carry(transform) for transform in truth.hands[side]]
        random = np.random.default_rng([seed, 20, MASK_VALUE[side]])
        filmed.append(
            FilmedHand(
                side=side,
                vertex=np.stack([one.vertex for one in posed]),
                faces=hand.faces,
                keypoint=np.stack([one.keypoint for one in posed]),
                shift=hand_shift(truth.frame_count, truth.frame_rate, level, random),
            )
        )
    return FilmedScene(
        name=body.name,
        skin=body.skin(truth.position.astype(np.float64)),
        faces=body.faces,
        contact=truth.contact[:, body.skin_node],
        hands=tuple(filmed),
        frame_rate=truth.frame_rate,
    )


def spread_points(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"], count: int, random: Generator
) -> SurfacePoints:
    """Sample points all over a surface that are far from each other.

    Of many points drawn evenly over the area, the one farthest from all chosen so far is next.

    Args:
        vertex: Vertices [m].
        faces: Triangles.
        count: Number of points.
        random: Decides which.
    """
    area = triangle_areas(vertex, faces)
    drawn = _DRAWN_PER_KEPT * count
    face = random.choice(len(faces), size=drawn, p=area / area.sum())
    every = SurfacePoints(faces[face], random.dirichlet(np.ones(3), size=drawn))
    point = every.at(vertex)
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(drawn, np.inf)
    for number in range(1, count):
        step = point - point[chosen[number - 1]]
        distance = np.minimum(distance, np.einsum("pd,pd->p", step, step))
        chosen[number] = distance.argmax()
    return every.pick(chosen)


def surface_area(vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]) -> float:
    """Compute the area of a surface [m²]."""
    return float(triangle_areas(vertex, faces).sum())


def _between(value: ndarray, frame: float) -> ndarray:
    """Interpolate between the frames before and after; beyond the ends hold the last one."""
    frame = min(max(frame, 0.0), len(value) - 1.0)
    before = min(int(frame), max(len(value) - 2, 0))
    share = frame - before
    if share == 0.0:
        return np.asarray(value[before], dtype=np.float64)
    return (1 - share) * value[before] + share * value[before + 1]
