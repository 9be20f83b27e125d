"""Reads the skinned mesh of a binary glTF file; nothing else of the format."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

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
