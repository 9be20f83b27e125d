"""Frames as binary PLY: object nodes, hand meshes, and virtual springs as edges."""

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData

_OBJECT, _CONTROL, _HAND = (
    np.array(color, np.uint8) for color in ((60, 110, 220), (210, 60, 50), (225, 180, 155))
)


def frame_to_ply(scene: SceneData, frame: int) -> bytes:
    """Describe one frame as binary PLY.

    Vertices are the object nodes, then the control nodes, the hand vertices, and those of the
    object's surface; hands whose vertices are the control nodes are not repeated. Colors tell them
    apart.

    Args:
        scene: The motion.
        frame: Which frame.
    """
    parts = [scene.rollout[frame], scene.control[frame]]
    colors = [_OBJECT, _CONTROL]
    offset = scene.rollout.shape[1]
    hand_vertices = sum(hand.vertex.shape[1] for hand in scene.hands.values())
    is_control = hand_vertices == scene.control.shape[1]
    if not is_control:
        offset += scene.control.shape[1]
    faces: list[ndarray] = []
    for hand in scene.hands.values():
        if not is_control:
            parts.append(hand.vertex[frame])
            colors.append(_HAND)
        if hand.face is not None:
            faces.append(np.asarray(hand.face) + offset)
        offset += hand.vertex.shape[1]
    surface = scene.object_surface(slice(frame, frame + 1))
    if surface is not None and surface.face is not None:
        parts.append(surface.vertex[0])
        colors.append(_OBJECT if surface.color is None else surface.color)
        faces.append(surface.face + offset)
    vertex = np.concatenate(parts).astype(np.float32)
    color = np.concatenate(
        [np.broadcast_to(c, (len(part), 3)) for part, c in zip(parts, colors, strict=True)]
    )
    comments = (
        f"sequence {scene.sequence}, frame {frame} at {scene.frame_rate:g} frames per second",
        f"world z-up, lengths in {scene.length_unit}",
    )
    return ply_bytes(
        vertex,
        color,
        np.concatenate([np.zeros((0, 3), np.int32), *faces]),
        scene.virtual_springs_in(frame),
        comments,
    )


def ply_bytes(
    vertex: Float[ndarray, "vertex 3"],
    color: UInt8[ndarray, "vertex 3"],
    face: Int[ndarray, "face 3"],
    edge: Int[ndarray, "edge 2"],
    comments: tuple[str, ...] = (),
) -> bytes:
    """Encode colored vertices, triangles and edges as little-endian PLY."""
    rgb = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(vertex), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *rgb])
    for axis, name in enumerate("xyz"):
        vertices[name] = vertex[:, axis]
    for channel, (name, _) in enumerate(rgb):
        vertices[name] = color[:, channel]
    faces = np.zeros(len(face), dtype=[("count", "u1"), ("index", "<i4", (3,))])
    faces["count"] = 3
    faces["index"] = face
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name, _ in rgb),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        f"element edge {len(edge)}",
        "property int vertex1",
        "property int vertex2",
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    return text.encode() + vertices.tobytes() + faces.tobytes() + edge.astype("<i4").tobytes()


def frame_files(
    scene: SceneData, frames: Iterable[int] | None = None
) -> Iterator[tuple[str, bytes]]:
    """Describe frames, or else all of them, as files: ``frame_00000.ply`` and so on."""
    for frame in range(scene.frame_count) if frames is None else frames:
        yield f"frame_{frame:05d}.ply", frame_to_ply(scene, frame)
