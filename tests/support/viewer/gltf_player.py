"""Reads binary glTF files by pygltflib and plays them by the specification."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation

KINDS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# What the exporter must undo: glTF's y is our z, its z our -y.
TO_OURS = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


class Player:
    """Plays the file by the glTF specification, at the times of its keys and between them."""

    def __init__(self, path: Path) -> None:
        self.gltf = GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def array(self, index: int) -> np.ndarray:
        accessor = self.gltf.accessors[index]
        view = self.gltf.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0
        width = WIDTHS[accessor.type]
        flat = np.frombuffer(
            self.blob, KINDS[accessor.componentType], accessor.count * width, view.byteOffset
        )
        if accessor.min:
            bounds = flat.reshape(-1, width)
            np.testing.assert_allclose(bounds.min(0), accessor.min, atol=1e-6)
            np.testing.assert_allclose(bounds.max(0), accessor.max, atol=1e-6)
        return flat if width == 1 else flat.reshape(-1, width)

    @cached_property
    def channels(self) -> dict[tuple[int, str], tuple[np.ndarray, np.ndarray]]:
        (animation,) = self.gltf.animations
        found = {}
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert sampler.interpolation == "LINEAR"
            found[channel.target.node, channel.target.path] = (
                self.array(sampler.input),
                self.array(sampler.output),
            )
        return found

    def node(self, name: str) -> int:
        return [node.name for node in self.gltf.nodes].index(name)

    def transform(self, node: int, frame: int) -> np.ndarray:
        channels, fields = self.channels, self.gltf.nodes[node]
        local = np.eye(4)
        for path in ("translation", "rotation"):
            value = getattr(fields, path)
            if (node, path) in channels:
                value = channels[node, path][1][frame]
            if value is not None and path == "translation":
                local[:3, 3] = value
            elif value is not None:
                local[:3, :3] = Rotation.from_quat(value).as_matrix()
        above = [i for i, other in enumerate(self.gltf.nodes) if node in (other.children or [])]
        return self.transform(above[0], frame) @ local if above else local

    def skinned(self, name: str, frame: int) -> np.ndarray:
        node = self.gltf.nodes[self.node(name)]
        skin, (primitive,) = self.gltf.skins[node.skin], self.gltf.meshes[node.mesh].primitives
        bind = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        bones = np.array([self.transform(joint, frame) for joint in skin.joints]) @ bind
        attributes = primitive.attributes
        vertex = self.array(attributes.POSITION)
        moved = np.einsum(
            "vkab,vb->vka",
            bones[self.array(attributes.JOINTS_0)],
            np.c_[vertex, np.ones(len(vertex))],
        )
        weight = self.array(attributes.WEIGHTS_0)
        np.testing.assert_allclose(weight.sum(1), 1, atol=1e-6)
        return (weight[..., None] * moved).sum(1)[:, :3] @ TO_OURS.T

    def morphed(self, name: str, primitive: Any, weight: np.ndarray) -> np.ndarray:
        vertex = self.array(primitive.attributes.POSITION).astype(np.float64)
        for share, target in zip(weight, primitive.targets, strict=True):
            vertex = vertex + share * self.array(target["POSITION"])
        matrix = self.transform(self.node(name), 0)
        return (vertex @ matrix[:3, :3].T + matrix[:3, 3]) @ TO_OURS.T

    def vertices(self, name: str, frame: int) -> np.ndarray:
        """Vertices of a moving point cloud or surface at the key of a frame."""
        node = self.node(name)
        primitive = self.gltf.meshes[self.gltf.nodes[node].mesh].primitives[0]
        time, weight = self.channels[node, "weights"]
        return self.morphed(name, primitive, weight.reshape(len(time), -1)[frame])
