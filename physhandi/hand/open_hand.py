"""The open hand: the WebXR generic hand (MIT) with a parent table and ten shape coefficients."""

import json
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from physhandi.hand.model import (
    JOINT_COUNT,
    KEYPOINT_BONE,
    PARENT_BONE,
    HandModel,
    HandPose,
)
from physhandi.hand.names import HandSide
from physhandi.hand.skinning import blend, joint_turns, place, turn_bones

_MAGIC = b"glTF"
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_DTYPE = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


@dataclass(frozen=True, kw_only=True)
class SkinnedMesh:
    """One mesh with its skeleton in the pose in which the two were bound."""

    vertex: Float[ndarray, "vertex 3"]
    """Vertices in the file's frame, equal positions merged [m]."""
    faces: Int[ndarray, "face 3"]
    """Vertices of each triangle, counter-clockwise from outside."""
    weight: Float[ndarray, "vertex bone"]
    """Share of each bone in a vertex; rows sum to one."""
    T_mesh_bone: Float[ndarray, "bone 4 4"]
    """Maps bone coordinates to the file's frame [m]."""
    bone_names: tuple[str, ...]
    """Name of each bone's node."""


def read_skinned_mesh(path: Path) -> SkinnedMesh:
    """Read the first mesh and skin of a ``.glb`` file and weld vertices at the same position.

    Raises:
        ValueError: If the file is not a binary glTF; names the file.
    """
    document, binary = _chunks(path)
    primitive = document["meshes"][0]["primitives"][0]
    attributes, skin = primitive["attributes"], document["skins"][0]
    position = _array(document, binary, attributes["POSITION"])
    bone = _array(document, binary, attributes["JOINTS_0"]).astype(np.int64)
    share = _array(document, binary, attributes["WEIGHTS_0"])
    T_bone_mesh = _array(document, binary, skin["inverseBindMatrices"])
    T_bone_mesh = T_bone_mesh.reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)

    vertex, first, welded = np.unique(position, axis=0, return_index=True, return_inverse=True)
    weight = np.zeros((len(position), len(T_bone_mesh)))
    np.add.at(weight, (np.arange(len(position))[:, None], bone), share)
    weight = weight[first]
    faces = welded.reshape(-1)[_array(document, binary, primitive["indices"]).reshape(-1, 3)]
    return SkinnedMesh(
        vertex=vertex.astype(np.float64),
        faces=faces.astype(np.int64),
        weight=weight / weight.sum(axis=1, keepdims=True),
        T_mesh_bone=np.linalg.inv(T_bone_mesh),
        bone_names=tuple(document["nodes"][node]["name"] for node in skin["joints"]),
    )


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    if content[:4] != _MAGIC:
        raise ValueError(f"{path} is not a binary glTF file (it starts with {content[:4]!r})")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset + 8 <= len(content):
        length, kind = struct.unpack_from("<II", content, offset)
        chunks[kind] = content[offset + 8 : offset + 8 + length]
        offset += 8 + length
    if set(chunks) < {_JSON_CHUNK, _BINARY_CHUNK}:
        raise ValueError(f"{path} lacks glTF's JSON or binary chunk")
    return json.loads(chunks[_JSON_CHUNK]), chunks[_BINARY_CHUNK]


def _array(document: dict[str, Any], binary: bytes, index: int) -> ndarray:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width, count = _WIDTH[accessor["type"]], accessor["count"]
    offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    dtype = np.dtype(_DTYPE[accessor["componentType"]])
    return np.frombuffer(binary, dtype, count * width, offset).reshape(count, width)


KEYPOINT_OFFSET = 1e-3 * np.array(
    [
        (-5.3, -17.1, 0.8),
        (-3.8, 1.4, -2.0),
        (1.8, -1.4, -1.8),
        (1.0, 3.0, 4.1),
        (-0.5, -0.3, -2.4),
        (1.1, -6.1, 1.8),
        (0.3, 1.9, -0.4),
        (0.3, 3.2, -0.3),
        (0.5, -3.9, 0.1),
        (-1.4, -3.9, 0.9),
        (-1.3, 2.4, 0.0),
        (-0.2, 3.8, -0.4),
        (0.3, -4.4, 0.5),
        (0.0, -4.7, 0.8),
        (-2.1, 0.7, -0.9),
        (-2.2, 4.3, -2.1),
        (-3.0, -1.8, -0.6),
        (-1.1, -4.7, -1.3),
        (-0.1, 0.8, 0.6),
        (-0.5, 1.4, -0.2),
        (0.6, -3.4, 1.8),
    ]
)
"""Offset of each keypoint from its joint (or fingertip node) in the right template's frame [m]."""


ASSETS = Path(__file__).parent / "assets"

SHAPE_NAMES = (
    "size",
    "palm_length",
    "palm_width",
    "thumb_length",
    "index_length",
    "middle_length",
    "ring_length",
    "pinky_length",
    "finger_thickness",
    "thumb_set",
)
"""Length that each shape coefficient scales."""
SHAPE_RATE = (0.05, 0.06, 0.06, 0.06, 0.06, 0.06, 0.06, 0.06, 0.08, 0.12)
"""A coefficient b multiplies its length by ``exp(rate * b)``; -3 to 3 is the sensible range."""

_FINGERS = ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger")
_THUMB_BONES = ("thumb-metacarpal", "thumb-phalanx-proximal", "thumb-phalanx-distal")
_PHALANGES = ("phalanx-proximal", "phalanx-intermediate", "phalanx-distal")
_JOINT_NODES = _THUMB_BONES + tuple(
    f"{finger}-{bone}" for finger in _FINGERS[1:] for bone in _PHALANGES
)
_KEYPOINT_NODES = [
    "wrist",
    *(
        node
        for finger in range(5)
        for node in (*_JOINT_NODES[3 * finger : 3 * finger + 3], f"{_FINGERS[finger]}-tip")
    ),
]
_FINGER_OF_JOINT = [joint // 3 for joint in range(JOINT_COUNT)]


@dataclass(frozen=True)
class _Skeleton:
    """The bones of one shape: how the template's neighbourhood of each bone is deformed."""

    stretch: Float[Tensor, "16 3 3"]
    """Stretch of each bone, less the identity."""
    shift: Float[Tensor, "16 3"]
    """How far each bone's origin lies from the template's [m]."""
    joint: Float[Tensor, "16 3"]
    """Origin of each bone [m]."""


class OpenHand(HandModel):
    """Linear blend skinning of a welded, watertight hand of 1,159 vertices.

    The template's frame has its origin in the wrist; fingers point along -y. A joint's rotation
    vector is expressed in its bone's frame: about x it curls (negative flexes), about y it
    spreads, about z it twists. The left hand is the mirror image (x to -x) of the right one, so
    an articulation ``(a, b, c)`` of the right hand mirrors to ``(a, -b, -c)``.
    """

    kind = "open"

    def __init__(self, mesh: SkinnedMesh, side: HandSide) -> None:
        """Arrange the right hand's mesh by joints and, for a left hand, mirror it.

        Args:
            mesh: The right hand with WebXR's 25 bones.
            side: Which hand to build.
        """
        bone = {name: index for index, name in enumerate(mesh.bone_names)}
        origin = mesh.T_mesh_bone[bone["wrist"], :3, 3]
        joint = [bone[name] for name in _JOINT_NODES]
        mirror = np.array([-1.0 if side == "left" else 1.0, 1.0, 1.0])

        weight = mesh.weight[:, joint]
        self.side: HandSide = side
        self.faces = mesh.faces if side == "right" else np.ascontiguousarray(mesh.faces[:, ::-1])
        self.vertex_count = len(mesh.vertex)
        self.weight = np.concatenate([1.0 - weight.sum(1, keepdims=True), weight], axis=1)
        self.template = (mesh.vertex - origin) * mirror
        self.joint_position = (mesh.T_mesh_bone[joint, :3, 3] - origin) * mirror
        axes = np.stack([_nearest_rotation(T[:3, :3]) for T in mesh.T_mesh_bone[joint]])
        self.joint_axes = mirror[:, None] * axes * mirror
        keypoint = [bone[name] for name in _KEYPOINT_NODES]
        node = mesh.T_mesh_bone[keypoint, :3, 3]
        self.keypoint_position = (node + KEYPOINT_OFFSET - origin) * mirror
        self.keypoint_weight = np.eye(JOINT_COUNT + 1)[KEYPOINT_BONE]
        self.palm_axes = _palm_axes(self.joint_position)
        self._tensors: dict[torch.dtype, dict[str, Tensor]] = {}

    @staticmethod
    @cache
    def load(side: HandSide) -> "OpenHand":
        """Load the vendored hand of one side."""
        return OpenHand(read_skinned_mesh(ASSETS / "right.glb"), side)

    def __call__(
        self,
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
        wrist_rotation: Float[Tensor, "batch 3"],
        wrist_translation: Float[Tensor, "batch 3"],
        scale: float | Float[Tensor, ""] = 1.0,
    ) -> HandPose:
        """Pose surface and keypoints; see `HandModel`."""
        skeleton = self._skeleton(shape)
        bones = self._turn_bones(skeleton, articulation)
        vertex, keypoint = (self._skin(part, skeleton, *bones) for part in ("vertex", "keypoint"))
        wrist = (wrist_rotation, wrist_translation, scale)
        return HandPose(place(vertex, *wrist), place(keypoint, *wrist))

    def local_vertices(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch vertex 3"]:
        """Pose the surface in the wrist's frame; see `HandModel`."""
        skeleton = self._skeleton(shape)
        return self._skin("vertex", skeleton, *self._turn_bones(skeleton, articulation))

    def local_keypoints(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch 21 3"]:
        """Pose the keypoints in the wrist's frame; see `HandModel`."""
        skeleton = self._skeleton(shape)
        return self._skin("keypoint", skeleton, *self._turn_bones(skeleton, articulation))

    def chosen_vertices(
        self,
        index: Int[Tensor, "batch point"],
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
    ) -> Float[Tensor, "batch point 3"]:
        """Pose some vertices of each surface alone; see `HandModel`."""
        skeleton, flat = self._skeleton(shape), index.flatten()
        shaped, weight = (
            part.index_select(0, flat).unflatten(0, index.shape)
            for part in (self._shaped("vertex", skeleton), self._constants(shape)["vertex_weight"])
        )
        return blend(shaped, weight, skeleton.joint, *self._turn_bones(skeleton, articulation))

    def bone_origins(self, shape: Float[Tensor, " 10"]) -> Float[Tensor, "16 3"]:
        """Compute where the bones begin in the unposed hand: the wrist, then the 15 joints [m]."""
        return self._skeleton(shape).joint

    def _skeleton(self, shape: Float[Tensor, " 10"]) -> _Skeleton:
        fixed = self._constants(shape)
        ratio = torch.expm1(shape * fixed["rate"])
        zero = torch.zeros_like(ratio[0])
        palm = torch.diag_embed(torch.stack([ratio[2], ratio[1], zero]))
        palm = fixed["palm_axes"] @ palm @ fixed["palm_axes"].T
        length = ratio[3:8][_FINGER_OF_JOINT]
        thickness = ratio[8].expand(JOINT_COUNT)
        finger = torch.diag_embed(torch.stack([thickness, thickness, length], 1))
        finger = fixed["joint_axes"] @ finger @ fixed["joint_axes"].transpose(-1, -2)

        offset = fixed["offset"].reshape(5, 3, 3)
        root = offset[:, 0] @ palm + torch.cat([ratio[9:], zero.expand(4)])[:, None] * offset[:, 0]
        beyond = length.reshape(5, 3, 1)[:, 1:] * offset[:, 1:]
        shift = torch.cat([root[:, None], beyond], 1).cumsum(1).reshape(-1, 3)
        shift = torch.cat([torch.zeros_like(shift[:1]), shift])

        grown = 1 + ratio[0]
        stretch = torch.cat([palm[None], finger]) * grown + ratio[0] * fixed["identity"]
        shift = shift * grown + ratio[0] * fixed["bone"]
        return _Skeleton(stretch, shift, fixed["bone"] + shift)

    def _turn_bones(
        self, skeleton: _Skeleton, articulation: Float[Tensor, "batch 15 3"]
    ) -> tuple[Tensor, Tensor]:
        """Compute each bone's rotation, less the identity, and how far its origin moved."""
        axes = self._constants(articulation)["joint_axes"]
        return turn_bones(joint_turns(articulation, axes), skeleton.joint)

    def _skin(
        self, part: str, skeleton: _Skeleton, rotation: Tensor, moved: Tensor
    ) -> Float[Tensor, "batch point 3"]:
        weight, shaped = self._constants(rotation)[f"{part}_weight"], self._shaped(part, skeleton)
        return blend(shaped, weight, skeleton.joint, rotation, moved)

    def _shaped(self, part: str, skeleton: _Skeleton) -> Float[Tensor, "point 3"]:
        fixed = self._constants(skeleton.joint)
        weight, point, arm = fixed[f"{part}_weight"], fixed[part], fixed[f"{part}_arm"]
        change = (skeleton.stretch @ arm[..., None])[..., 0] + skeleton.shift
        return point + (weight[..., None] * change).sum(1)

    def _constants(self, like: Tensor) -> dict[str, Tensor]:
        if like.dtype not in self._tensors:
            joint = np.concatenate([np.zeros((1, 3)), self.joint_position])
            arrays = {
                "bone": joint,
                "offset": self.joint_position - joint[PARENT_BONE],
                "joint_axes": self.joint_axes,
                "palm_axes": self.palm_axes,
                "rate": np.array(SHAPE_RATE),
                "identity": np.eye(3),
                "vertex": self.template,
                "vertex_weight": self.weight,
                "vertex_arm": self.template[:, None] - joint,
                "keypoint": self.keypoint_position,
                "keypoint_weight": self.keypoint_weight,
                "keypoint_arm": self.keypoint_position[:, None] - joint,
            }
            self._tensors[like.dtype] = {
                name: torch.as_tensor(array).to(like) for name, array in arrays.items()
            }
        return self._tensors[like.dtype]


def _nearest_rotation(matrix: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """Undo the rounding of the file's four decimals."""
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def _palm_axes(joint: Float[ndarray, "joint 3"]) -> Float[ndarray, "3 3"]:
    """Find the palm's width, length and normal as columns: wrist to middle knuckle is length."""
    length = joint[6] / np.linalg.norm(joint[6])
    width = joint[3] - joint[12]
    width = width - (width @ length) * length
    width /= np.linalg.norm(width)
    return np.stack([width, length, np.cross(width, length)], axis=1)
