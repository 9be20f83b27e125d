"""The true hand of made-up recordings: MakeHuman's (CC0), never the one that is fitted to them.

`true_hand_conversion` tells how `assets/true_hand.npz` was made. In the rest frame the wrist is the
origin, x points to the middle finger's knuckle, y to the thumb's side (to the other side for the
left hand, the mirror image) and z out of the back of the hand.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from physhandi.data.sequence_meta import Side
from physhandi.triangles import vertex_normals

ASSET = Path(__file__).parents[1] / "assets" / "true_hand.npz"
BONE_COUNT = 16
"""The wrist with the palm, then three bones of each finger from thumb to little finger."""
BONE_PARENT = (-1, *(0 if bone % 3 == 1 else bone - 1 for bone in range(1, BONE_COUNT)))
"""Parent of each bone; bone 0 has none."""
FINGERTIPS = (4, 8, 12, 16, 20)
"""Keypoints at the ends of the fingers, from thumb to little finger."""

_KEYPOINT_BONE = (0, *(bone for root in range(1, 16, 3) for bone in (root, root + 1, root + 2, -1)))
# A keypoint rides on the bone that begins at it; a fingertip on the finger's last bone.
_BONE_OF_KEYPOINT = tuple(
    bone if bone >= 0 else _KEYPOINT_BONE[number - 1] for number, bone in enumerate(_KEYPOINT_BONE)
)
_KEYPOINT_OF_BONE = tuple(_BONE_OF_KEYPOINT.index(bone) for bone in range(BONE_COUNT))
_SOFT_WAVE = 0.05
_SOFT_RANGE = (0.001, 0.002)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueHandPose:
    """Position, orientation and finger angles of a hand."""

    orientation: Float[ndarray, " 3"]
    """Rotation vector that turns the rest frame into the world [rad]."""
    position: Float[ndarray, " 3"]
    """Wrist in the world [m]."""
    bend: Float[ndarray, "bone 3"]
    """Rotation vector of each bone against the bone it hangs on [rad], in its own axes: about x it
    flexes (positive closes the fist), about y it spreads towards the thumb's side, about z it
    twists. The same values mean the mirrored motion for the left hand. Bone 0 stays zero."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedHand:
    """A hand in the world."""

    vertex: Float[ndarray, "vertex 3"]
    """Surface [m]."""
    keypoint: Float[ndarray, "21 3"]
    """Keypoints in MediaPipe's order [m]."""
    bone_transform: Float[ndarray, "bone 4 4"]
    """Transforms from the resting hand to the world by each bone."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Capsule:
    """A capsule of the hand's contact shape: all points within a radius of a line."""

    bone: int
    """Bone that carries it."""
    start: Float[ndarray, " 3"]
    """One end of the line, in the rest pose [m]."""
    end: Float[ndarray, " 3"]
    """The other end, nearer to the fingertip [m]."""
    radius: float
    """Distance of the surface from the line [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueHand:
    """Linear blend skinning of MakeHuman's hand of 16 bones."""

    side: Side
    """Side of the hand."""
    rest_vertex: Float[ndarray, "vertex 3"]
    """Surface in the rest pose [m]."""
    faces: Int[ndarray, "face 3"]
    """Triangles, counter-clockwise from outside; the surface is closed."""
    weight: Float[ndarray, "vertex bone"]
    """Share of each bone in a vertex; rows sum to one."""
    rest_keypoint: Float[ndarray, "21 3"]
    """Keypoints in the rest pose [m]."""
    bone_names: tuple[str, ...]
    """Name of each bone, as ``index-2``."""
    bone_parent: tuple[int, ...] = BONE_PARENT
    """Bone that each bone hangs on; -1 for the wrist."""

    @cached_property
    def bone_origin(self) -> Float[ndarray, "bone 3"]:
        """Where each bone begins in the rest pose [m]."""
        return self.rest_keypoint[list(_KEYPOINT_OF_BONE)]

    @cached_property
    def bone_axes(self) -> Float[ndarray, "bone 3 3"]:
        """Axes in which each bone bends, as columns: flexion, spread, twist.

        Those of the left hand are the mirror image, so they are left-handed.
        """
        mirror = _mirror(self.side)
        keypoint = self.rest_keypoint * mirror
        axes = [np.eye(3)]
        for bone in range(1, BONE_COUNT):
            start = _KEYPOINT_OF_BONE[bone]
            along = _unit(keypoint[start + 1] - keypoint[start])
            if bone <= 3:
                # The thumb closes towards the root of the little finger.
                flexion = _unit(np.cross(along, keypoint[17] - keypoint[start]))
            else:
                flexion = _unit(np.cross([0.0, 0.0, 1.0], along))
            axes.append(np.stack([flexion, np.cross(along, flexion), along], axis=1))
        return mirror[:, None] * np.stack(axes)

    @property
    def capsules(self) -> tuple[Capsule, ...]:
        """Solids that cover the hand: one for each finger bone, five for the palm."""
        return self._capsules

    @cached_property
    def _capsules(self) -> tuple[Capsule, ...]:
        joints = self.rest_keypoint
        lines = [(bone, _KEYPOINT_OF_BONE[bone]) for bone in range(1, BONE_COUNT)]
        capsules = [self._finger_capsule(bone, joints[k], joints[k + 1]) for bone, k in lines]
        owner = self.weight.argmax(axis=1)
        palm = self.rest_vertex[owner == 0]
        for knuckle in (5, 9, 13, 17):
            root = joints[0] + 0.25 * (joints[knuckle] - joints[0]) * [1.0, 1.6, 1.0]
            capsules.append(_fit_capsule(0, root, joints[knuckle], palm))
        capsules.append(_fit_capsule(0, joints[0], joints[1], palm))
        return tuple(capsules)

    def bone_transforms(self, pose: TrueHandPose) -> Float[ndarray, "bone 4 4"]:
        """Compute the transforms from the resting hand to each bone's pose."""
        turn = np.asarray(pose.bend, dtype=np.float64)
        if turn.shape != (BONE_COUNT, 3) or turn[0].any():
            raise ValueError("The bend of a hand has 16 rows of 3, and bone 0 stays zero.")
        return self.transforms_of(pose.orientation, pose.position, turn)

    def transforms_of(
        self,
        orientation: Float[ndarray, "*pose 3"],
        position: Float[ndarray, "*pose 3"],
        bend: Float[ndarray, "*pose bone 3"],
    ) -> Float[ndarray, "*pose bone 4 4"]:
        """Compute `bone_transforms` of many poses; what is given means what it means in a pose."""
        own = _matrices(bend)
        own = self.bone_axes @ own @ self.bone_axes.transpose(0, 2, 1)
        transform = np.tile(np.eye(4), (*bend.shape[:-1], 1, 1))
        transform[..., 0, :3, :3] = _matrices(orientation)
        transform[..., 0, :3, 3] = position
        for link in (1, 2, 3):  # of all five fingers at once
            bones = slice(link, BONE_COUNT, 3)
            above = transform[..., list(self.bone_parent[bones]), :, :]
            origin = self.bone_origin[bones, :, None]
            rotation = above[..., :3, :3] @ own[..., bones, :, :]
            place = above[..., :3, :3] @ origin + above[..., :3, 3:]
            transform[..., bones, :3, :3] = rotation
            transform[..., bones, :3, 3:] = place - rotation @ origin
        return transform

    def pose(self, pose: TrueHandPose) -> PosedHand:
        """Compute surface and keypoints of a pose."""
        return self.carry(self.bone_transforms(pose))

    def carry(self, transform: Float[ndarray, "bone 4 4"]) -> PosedHand:
        """Compute surface and keypoints from the transforms of the bones.

        Args:
            transform: Takes points of the resting hand with each bone into the world; bones need
                not meet where they hang together.
        """
        blended = np.tensordot(self.weight, transform[:, :3], axes=1)
        vertex = np.einsum("vij,vj->vi", blended[:, :, :3], self.rest_vertex) + blended[:, :, 3]
        bone = transform[list(_BONE_OF_KEYPOINT), :3]
        keypoint = np.einsum("kij,kj->ki", bone[:, :, :3], self.rest_keypoint) + bone[:, :, 3]
        return PosedHand(vertex=vertex, keypoint=keypoint, bone_transform=transform)

    def _finger_capsule(self, bone: int, start: ndarray, end: ndarray) -> Capsule:
        around = self.rest_vertex[self.weight.argmax(axis=1) == bone]
        capsule = _fit_capsule(bone, start, end, around)
        if bone % 3:
            return capsule
        # The last one ends where the fingertip does.
        along = _unit(end - start)
        reach = ((around - start) @ along).max() - capsule.radius
        end = start + along * reach
        return Capsule(bone=bone, start=start, end=end, radius=capsule.radius)


def load_true_hand(side: Side, *, seed: int | None = None) -> TrueHand:
    """Load the true hand of one side.

    Args:
        side: Which hand; the left one is the mirror image.
        seed: Decides the soft tissue that is laid over the bare mesh (`soft_tissue_offset`); None
            adds none.
    """
    with np.load(ASSET) as stored:
        mirror = _mirror(side)
        faces = stored["faces"].astype(np.int64)
        bare = TrueHand(
            side=side,
            rest_vertex=stored["vertex"].astype(np.float64) * mirror,
            faces=faces if side == "right" else np.ascontiguousarray(faces[:, ::-1]),
            weight=stored["weight"].astype(np.float64),
            rest_keypoint=stored["keypoint"].astype(np.float64) * mirror,
            bone_names=tuple(str(name) for name in stored["bone_names"]),
        )
    if seed is None:
        return bare
    return TrueHand(
        side=side,
        rest_vertex=bare.rest_vertex + soft_tissue_offset(bare, seed),
        faces=bare.faces,
        weight=bare.weight,
        rest_keypoint=bare.rest_keypoint,
        bone_names=bare.bone_names,
    )


def soft_tissue_offset(hand: TrueHand, seed: int) -> Float[ndarray, "vertex 3"]:
    """Thicken a hand by 1 to 2 mm, unevenly, like soft tissue outside of any hand model.

    Args:
        hand: Bare hand.
        seed: Decides where it is thicker; the same seed gives the mirror image on the other side.

    Returns:
        Displacement of each vertex along its normal in the rest pose [m]; it changes smoothly, over
        about 5 cm.
    """
    random = np.random.default_rng([seed, 0x50F7])
    place = hand.rest_vertex * _mirror(hand.side)
    waves = 16
    direction = random.standard_normal((waves, 3)) * (2 * np.pi / _SOFT_WAVE / np.sqrt(3))
    phase = random.uniform(0, 2 * np.pi, waves)
    field = np.cos(place @ direction.T + phase).sum(axis=1) * np.sqrt(2 / waves)
    low, high = _SOFT_RANGE
    amount = low + (high - low) * (0.5 + 0.5 * np.tanh(field))
    return amount[:, None] * vertex_normals(hand.rest_vertex, hand.faces)


def _fit_capsule(bone: int, start: ndarray, end: ndarray, around: ndarray) -> Capsule:
    """Fit a capsule's radius: the median distance of the surface around its line."""
    line = end - start
    share = (around - start) @ line / (line @ line)
    beside = (share > 0.1) & (share < 0.9)
    foot = start + np.clip(share, 0, 1)[:, None] * line
    distance = np.sort(np.linalg.norm(around - foot, axis=1)[beside])
    nearest = distance if bone else distance[: max(len(distance) // 4, 1)]
    return Capsule(bone=bone, start=start, end=end, radius=float(np.median(nearest)))


def _matrices(vector: Float[ndarray, "*pose 3"]) -> Float[ndarray, "*pose 3 3"]:
    """Compute the matrices of rotation vectors [rad]."""
    matrix = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return matrix.reshape(*vector.shape, 3)


def _mirror(side: Side) -> Float[ndarray, " 3"]:
    return np.array([1.0, -1.0 if side == "left" else 1.0, 1.0])


def _unit(vector: ndarray) -> ndarray:
    return vector / np.linalg.norm(vector)
