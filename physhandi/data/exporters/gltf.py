"""A run's motion as one binary glTF file (.glb), for Blender, three.js and other viewers.

Hands are skinned: their bones turn, one channel a bone. The object has no skeleton, so each frame
is a morph target of one point cloud that springs share as lines; glTF knows no other vertex
animation that Blender and three.js both read. Between frames both interpolate linearly, as nodes
do. three.js holds every weight in a shader constant, of which WebGL 2 promises 256.
"""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.data.exporters.scene_data import MovingSurface, SceneData
from physhandi.srgb import to_linear
from physhandi.triangles import unit_normals

POINTS, LINES, TRIANGLES = 0, 1, 4
"""Modes of a glTF primitive."""
_COMPONENT = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_KIND = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTICES, _INDICES = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Turns our world, z up, into glTF's, y up."""


class GltfDocument:
    """One scene with one animation, whose node `world` has z up, as the project has."""

    def __init__(self, frame_rate: float, frame_count: int, extras: dict[str, Any]) -> None:
        """Begin a scene.

        Args:
            frame_rate: Frames per second of the animation [Hz].
            frame_count: Frames of the animation.
            extras: Notes for readers of the file.
        """
        self._extras = extras
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._top: list[int] = []
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._binary = bytearray()
        self._frame_count = frame_count
        self.world = self.add_node("world", None, rotation=_Z_UP)
        time = (np.arange(frame_count) / frame_rate).astype(np.float32)
        self._time = self.add_array(time, has_bounds=True)

    def add_array(
        self, array: ndarray, *, target: int | None = None, has_bounds: bool = False
    ) -> int:
        """Store an array of numbers, vectors or matrices; its axes after the first are theirs."""
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self._binary),
            "byteLength": array.nbytes,
        }
        if target is not None:
            view["target"] = target
        self._binary += np.ascontiguousarray(array).tobytes()
        self._binary += b"\0" * (-len(self._binary) % 4)
        accessor: dict[str, Any] = {
            "bufferView": self._add("bufferViews", view),
            "componentType": _COMPONENT[array.dtype.name],
            "count": len(array),
            "type": _KIND[array.shape[1:]],
        }
        if has_bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self._add("accessors", accessor)

    def add_positions(self, position: Float[ndarray, "point 3"]) -> int:
        """Store positions or displacements of vertices."""
        return self.add_array(position.astype(np.float32), target=_VERTICES, has_bounds=True)

    def add_attribute(self, array: ndarray) -> int:
        """Store another attribute of vertices."""
        return self.add_array(array, target=_VERTICES)

    def add_indices(self, index: Int[ndarray, "part corner"]) -> int:
        """Store which vertices make each triangle or line."""
        return self.add_array(index.reshape(-1).astype(np.uint32), target=_INDICES)

    def add_material(self, name: str, color: tuple[float, float, float]) -> int:
        """Store a matt color (linear red, green, blue)."""
        surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.9}
        return self._add(
            "materials", {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
        )

    def add_node(self, name: str, parent: int | None, **fields: Any) -> int:
        """Add a node below another, or at the top."""
        number = self._add("nodes", {"name": name, **fields})
        if parent is None:
            self._top.append(number)
        else:
            self._lists["nodes"][parent].setdefault("children", []).append(number)
        return number

    def add_mesh(self, name: str, primitives: list[dict[str, Any]]) -> int:
        """Store a mesh; its morph targets, if any, have no weight at first."""
        mesh: dict[str, Any] = {"name": name, "primitives": primitives}
        if "targets" in primitives[0]:
            mesh["weights"] = [0.0] * len(primitives[0]["targets"])
        return self._add("meshes", mesh)

    def add_skin(
        self, name: str, joints: list[int], T_bone_hand: Float[ndarray, "bone 4 4"]
    ) -> int:
        """Store which nodes move a mesh; glTF's matrices lie column by column."""
        inverse = self.add_array(T_bone_hand.transpose(0, 2, 1).astype(np.float32))
        return self._add(
            "skins",
            {
                "name": name,
                "joints": joints,
                "skeleton": joints[0],
                "inverseBindMatrices": inverse,
            },
        )

    def animate(self, node: int, path: str, value: Float[ndarray, "row ..."]) -> None:
        """Animate a node's translation, rotation or weights by one row (or one run) a frame."""
        output = self.add_array(value.astype(np.float32))
        self._samplers.append({"input": self._time, "output": output, "interpolation": "LINEAR"})
        target = {"node": node, "path": path}
        self._channels.append({"sampler": len(self._samplers) - 1, "target": target})

    def morph_targets(
        self,
        position: Float[ndarray, "frame point 3"],
        normal: Float[ndarray, "frame point 3"] | None = None,
    ) -> dict[str, Any]:
        """Store every later frame as a displacement from the first, as a primitive has them."""
        moved = position[1:].astype(np.float32) - position[:1].astype(np.float32)
        targets = [{"POSITION": self.add_positions(frame)} for frame in moved]
        if normal is not None:
            for target, turned in zip(targets, normal[1:] - normal[:1], strict=True):
                target["NORMAL"] = self.add_attribute(turned.astype(np.float32))
        return {"targets": targets} if targets else {}

    def animate_morph(self, node: int) -> None:
        """Make weights that select each frame's target in its frame alone."""
        if self._frame_count > 1:
            weight = np.eye(self._frame_count, dtype=np.float32)[:, 1:]
            self.animate(node, "weights", weight.reshape(-1))

    def to_bytes(self) -> bytes:
        """Write the file."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "PhysHanDI", "extras": self._extras},
            "scene": 0,
            "scenes": [{"nodes": self._top}],
            **self._lists,
            "buffers": [{"byteLength": len(self._binary)}],
        }
        if self._channels:
            motion = {"name": "motion", "samplers": self._samplers, "channels": self._channels}
            document["animations"] = [motion]
        text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = b"".join(
            struct.pack("<II", len(content), kind) + bytes(content)
            for content, kind in ((text, _JSON_CHUNK), (self._binary, _BINARY_CHUNK))
        )
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _add(self, kind: str, entry: dict[str, Any]) -> int:
        entries = self._lists.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1


_OBJECT, _SPRING, _HAND = (0.045, 0.156, 0.716), (0.35, 0.45, 0.75), (0.753, 0.457, 0.328)


def scene_to_gltf(scene: SceneData) -> bytes:
    """Describe hands, object nodes, springs and surface of all frames as binary glTF (``.glb``).

    A hand without a skin (in runs of version 0.1) becomes a mesh with a morph target a frame.
    """
    extras = {"sequence": scene.sequence, "run": scene.run, "length_unit": scene.length_unit}
    document = GltfDocument(scene.frame_rate, scene.frame_count, extras)
    for side, hand in scene.hands.items():
        if side in scene.skins:
            _add_skinned_hand(document, side, scene.skins[side], scene.frame_count)
        else:
            _add_moving_surface(document, side, hand, scene.frame_count)
    if scene.rollout.shape[1]:
        _add_object(document, scene)
    surface = scene.object_surface()
    if surface is not None and surface.face is not None:
        _add_object_surface(document, surface, surface.face)
    return document.to_bytes()


def _add_skinned_hand(
    document: GltfDocument, side: str, skin: Mapping[str, ndarray], frame_count: int
) -> None:
    name = f"{side}_hand"
    bones: list[int] = []
    texts = bytes(skin["name"]).decode().split("\n")
    parents: list[int] = skin["parent"].tolist()
    for bone, (text, parent) in enumerate(zip(texts, parents, strict=True)):
        above = document.world if parent < 0 else bones[parent]
        translation, rotation = (
            skin[part][:frame_count, bone] for part in ("translation", "rotation")
        )
        first = {"translation": translation[0].tolist(), "rotation": rotation[0].tolist()}
        bones.append(document.add_node(f"{side}_{text}", above, **first))
        document.animate(bones[-1], "rotation", rotation)
        if np.ptp(translation, axis=0).any():
            document.animate(bones[-1], "translation", translation)
    attributes = {
        "POSITION": document.add_positions(skin["vertex"]),
        "NORMAL": document.add_attribute(unit_normals(skin["vertex"], skin["faces"])),
        "JOINTS_0": document.add_attribute(skin["vertex_bone"].astype(np.uint8)),
        "WEIGHTS_0": document.add_attribute(skin["vertex_weight"].astype(np.float32)),
    }
    primitive = {
        "attributes": attributes,
        "indices": document.add_indices(skin["faces"]),
        "material": document.add_material(name, _HAND),
        "mode": TRIANGLES,
    }
    mesh = document.add_mesh(name, [primitive])
    skin_number = document.add_skin(name, bones, skin["T_bone_hand"])
    # A skinned mesh has no parent: only its bones place it.
    document.add_node(name, None, mesh=mesh, skin=skin_number)


def _add_moving_surface(
    document: GltfDocument, side: str, hand: MovingSurface, frame_count: int
) -> None:
    name, vertex = f"{side}_hand", hand.vertex[:frame_count]
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": document.add_positions(vertex[0])},
        "material": document.add_material(name, _HAND),
        "mode": POINTS,
        **document.morph_targets(vertex),
    }
    if hand.face is not None:
        primitive |= {"indices": document.add_indices(hand.face), "mode": TRIANGLES}
    mesh = document.add_mesh(name, [primitive])
    document.animate_morph(document.add_node(name, document.world, mesh=mesh))


def _add_object(document: GltfDocument, scene: SceneData) -> None:
    shared = {
        "attributes": {"POSITION": document.add_positions(scene.rollout[0])},
        **document.morph_targets(scene.rollout),
    }
    node_material = document.add_material("object_nodes", _OBJECT)
    primitives = [{**shared, "material": node_material, "mode": POINTS}]
    springs = scene.spring_nodes[: scene.object_spring_count]
    if len(springs):
        material = document.add_material("object_springs", _SPRING)
        lines = {"indices": document.add_indices(springs), "material": material, "mode": LINES}
        primitives.append({**shared, **lines})
    mesh = document.add_mesh("object", primitives)
    document.animate_morph(document.add_node("object", document.world, mesh=mesh))


def _add_object_surface(
    document: GltfDocument, surface: MovingSurface, face: Int[ndarray, "face 3"]
) -> None:
    normal = np.stack([unit_normals(vertex, face) for vertex in surface.vertex])
    attributes = {
        "POSITION": document.add_positions(surface.vertex[0]),
        "NORMAL": document.add_attribute(normal[0]),
    }
    if surface.color is not None:
        # Vertices of glTF speak of amounts of light.
        light = to_linear(surface.color.astype(np.float32) / 255)
        attributes["COLOR_0"] = document.add_attribute(light)
    material = document.add_material(
        "object_surface", _OBJECT if surface.color is None else (1.0, 1.0, 1.0)
    )
    primitive = {
        "attributes": attributes,
        "indices": document.add_indices(face),
        "material": material,
        "mode": TRIANGLES,
        **document.morph_targets(surface.vertex, normal),
    }
    mesh = document.add_mesh("object_surface", [primitive])
    document.animate_morph(document.add_node("object_surface", document.world, mesh=mesh))
