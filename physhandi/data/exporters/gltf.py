"""A run's motion as one binary glTF file (.glb), for Blender, three.js and other viewers.

Hands are skinned: their bones turn, one channel a bone. The object has no skeleton, so each frame
is a morph target of one point cloud that springs share as lines; glTF knows no other vertex
animation that Blender and three.js both read. Between frames both interpolate linearly, as nodes
do. three.js holds every weight in a shader constant, of which WebGL 2 promises 256.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from physhandi.data.atomic import write_bytes
from physhandi.data.exporters.gltf_document import LINES, POINTS, TRIANGLES, GltfDocument
from physhandi.data.exporters.scene_data import HandSurface, SceneData

_OBJECT, _SPRING, _HAND = (0.045, 0.156, 0.716), (0.35, 0.45, 0.75), (0.753, 0.457, 0.328)


def write_gltf(path: Path, scene: SceneData) -> None:
    """Write hands, object nodes and object springs of all frames to a ``.glb`` file.

    A hand without a skin (in runs of version 0.1) becomes a mesh with a morph target a frame.

    Args:
        path: File to write.
        scene: The motion.
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
    write_bytes(path, document.to_bytes())


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
        "NORMAL": document.add_attribute(_normals(skin["vertex"], skin["faces"])),
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
    held = document.add_skin(name, bones, skin["T_bone_hand"])
    # A skinned mesh hangs nowhere: its bones alone place it.
    document.add_node(name, None, mesh=mesh, skin=held)


def _add_moving_surface(
    document: GltfDocument, side: str, hand: HandSurface, frame_count: int
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


def _normals(vertex: ndarray, faces: ndarray) -> ndarray:
    """Compute unit normals of vertices, the area-weighted mean of their triangles'."""
    corner = vertex[faces].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros(vertex.shape)
    for index in range(3):
        np.add.at(total, faces[:, index], normal)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    # A vertex without a triangle has no normal; glTF wants some unit vector.
    return np.where(length > 0, total / np.maximum(length, 1e-30), [0, 0, 1.0]).astype(np.float32)
