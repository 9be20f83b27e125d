"""Writes files in MANO's format: a made-up hand, since MANO itself may not be shipped.

It is the open hand with edges collapsed until 778 vertices and 1,538 faces are left (the wrist is
open, as MANO's), turned into MANO's frame and numbered as MANO numbers its tips and joints.
"""

from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from physhandi.hand.open_hand import OpenHand
from support.hostile.foreign_pickle import chumpy_array, chumpy_select, python2_pickle

VERTICES, FACES = 778, 1538
TIPS = {744: 0, 320: 1, 443: 2, 554: 3, 671: 4}
"""MANO's vertices at the tips of thumb, index, middle, ring and pinky."""
JOINTS = (0, 4, 5, 6, 7, 8, 9, 13, 14, 15, 10, 11, 12, 1, 2, 3)
"""Bone of the open hand (0 the palm, then thumb to pinky) at each of MANO's joints."""
PARENT = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
WRIST = np.array([0.0957, 0.0064, 0.0062])
TO_MANO = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Turns the open right hand (fingers along -y, palm to -x) so that fingers point along -x."""


@cache
def mano_arrays(side: str) -> dict[str, Any]:
    """The fields of a made-up MANO file, as plain arrays; treat them as read-only."""
    hand = OpenHand.load("right")
    kept, faces = _simplified(hand)
    faces = _opened(hand.template, faces)
    kept, faces = _numbered(hand, kept, faces)
    vertex = hand.template[kept] @ TO_MANO.T + WRIST
    joint = np.concatenate([np.zeros((1, 3)), hand.joint_position])[list(JOINTS)]
    joint = joint @ TO_MANO.T + WRIST
    random = np.random.default_rng(3)
    change = _shape_change(hand)[kept]
    arrays = {
        "v_template": vertex,
        "shapedirs": np.einsum("ac,vck->vak", TO_MANO, change),
        "posedirs": 3e-4 * random.standard_normal((VERTICES, 3, 135)),
        "J_regressor": scipy.sparse.csc_matrix(np.stack([_regressor(vertex, j) for j in joint])),
        "weights": hand.weight[kept][:, list(JOINTS)],
        "kintree_table": np.array([np.array(PARENT) % 2**32, np.arange(16)]),
        "f": faces.astype(np.uint32),
        "hands_mean": 0.2 * random.standard_normal(45),
        "hands_components": np.linalg.qr(random.standard_normal((45, 45)))[0],
    }
    if side == "left":
        mirror = np.array([-1.0, 1, 1])
        arrays["v_template"] = vertex * mirror
        arrays["f"] = np.ascontiguousarray(arrays["f"][:, ::-1])
        arrays["shapedirs"] = arrays["shapedirs"] * mirror[:, None]
        # A mirrored pose turns about mirrored axes: entry (r, c) of R - I gains both signs.
        turned = np.outer(mirror, mirror).reshape(9)
        posedirs = arrays["posedirs"].reshape(VERTICES, 3, 15, 9)
        posedirs = posedirs * mirror[:, None, None] * turned
        arrays["posedirs"] = posedirs.reshape(VERTICES, 3, 135)
        arrays["hands_mean"] = (arrays["hands_mean"].reshape(15, 3) * [1, -1, -1]).reshape(45)
    return arrays


def posed_mano(
    arrays: dict, shape: np.ndarray, pose: np.ndarray, turn: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """MANO as its paper defines it, one pose at a time; the pose is 45 numbers in MANO's order."""
    rotation = Rotation.from_rotvec(np.concatenate([turn[None], pose.reshape(15, 3)])).as_matrix()
    shaped = arrays["v_template"] + arrays["shapedirs"] @ shape
    joint = arrays["J_regressor"].toarray() @ shaped
    posed = shaped + arrays["posedirs"] @ (rotation[1:] - np.eye(3)).ravel()
    world = []
    for number, parent in enumerate(PARENT):
        local = np.eye(4)
        local[:3, :3] = rotation[number]
        local[:3, 3] = joint[number] - (joint[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    skinning = np.array(world)
    skinning[:, :3, 3] -= np.einsum("jab,jb->ja", skinning[:, :3, :3], joint)
    blended = np.einsum("vj,jab->vab", arrays["weights"], skinning)
    vertex = np.einsum("vab,vb->va", blended, np.c_[posed, np.ones(len(posed))])[:, :3]
    return vertex + shift, np.array(world)[:, :3, 3] + shift


def write_mano(folder: Path, side: str = "right", **changes: Any) -> Path:
    """Write ``MANO_<SIDE>.pkl`` as Python 2 and chumpy would; a field set to None is left out."""
    fields = {**mano_arrays(side), "bs_style": "lbs", "bs_type": "lrotmin", **changes}
    fields = {name: value for name, value in fields.items() if value is not None}
    if isinstance(fields.get("shapedirs"), np.ndarray):
        fields["shapedirs"] = chumpy_select(fields["shapedirs"])
    if "J" not in fields:
        fields["J"] = chumpy_array(np.zeros((16, 3)))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"MANO_{side.upper()}.pkl"
    path.write_bytes(python2_pickle(fields))
    return path


def _simplified(hand: OpenHand) -> tuple[np.ndarray, np.ndarray]:
    """Collapse the shortest edges that may go until 779 vertices are left."""
    faces = [tuple(face) for face in hand.faces.tolist()]
    around: list[set[int]] = [set() for _ in range(hand.vertex_count)]
    of: list[set[int]] = [set() for _ in range(hand.vertex_count)]
    for number, face in enumerate(faces):
        for vertex in face:
            around[vertex] |= set(face) - {vertex}
            of[vertex].add(number)
    tips = set(_tip_vertices(hand))
    kept = set(range(hand.vertex_count))
    edges = [(a, b) for a in kept for b in around[a] if a < b]
    length = np.linalg.norm(np.diff(hand.template[np.array(edges)], axis=1)[:, 0], axis=1)
    for index in np.argsort(length, kind="stable"):
        a, b = edges[index]
        # Two common neighbours: the surface stays a surface. Ends of fingers stay where they are.
        if len(kept) == VERTICES + 1:
            break
        if not {a, b} <= kept or b in tips or b not in around[a] or len(around[a] & around[b]) != 2:
            continue
        for number in of[b] & of[a]:
            for vertex in faces[number]:
                of[vertex] = of[vertex] - {number}
        for number in list(of[b]):
            faces[number] = tuple(a if vertex == b else vertex for vertex in faces[number])
            of[a].add(number)
        for vertex in around[b]:
            around[vertex] = (around[vertex] - {b}) | ({a} if vertex != a else set())
        around[a] |= around[b] - {a}
        of[b] = set()
        kept.discard(b)
    assert len(kept) == VERTICES + 1
    left = sorted({number for vertex in kept for number in of[vertex]})
    return np.array(sorted(kept)), np.array([faces[number] for number in left])


def _opened(template: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Cut a hole of 16 edges around the vertex farthest down the wrist."""
    gone = int(faces.ravel()[np.argmax(template[faces.ravel(), 1])])
    cut = set(np.flatnonzero((faces == gone).any(axis=1)).tolist())
    while len(cut) < 16:
        # Each face that hangs on by one edge widens the hole by one edge.
        rim = {vertex for number in cut for vertex in faces[number].tolist()}
        sides = {
            frozenset(pair) for number in cut for pair in combinations(faces[number].tolist(), 2)
        }
        cut.add(
            next(
                number
                for number, face in enumerate(faces.tolist())
                if number not in cut
                and len(rim & set(face)) == 2
                and frozenset(rim & set(face)) in sides
            )
        )
    return np.delete(faces, sorted(cut), axis=0)


def _numbered(hand: OpenHand, kept: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out what was cut, and give the fingertips MANO's numbers."""
    kept = np.intersect1d(kept, faces)
    tips = _tip_vertices(hand)
    order = [int(vertex) for vertex in kept if vertex not in tips]
    for number in sorted(TIPS):
        order.insert(number, tips[TIPS[number]])
    number_of = {vertex: number for number, vertex in enumerate(order)}
    assert (len(order), len(faces)) == (VERTICES, FACES)
    return np.array(order), np.vectorize(number_of.__getitem__)(faces)


def _tip_vertices(hand: OpenHand) -> list[int]:
    tip = hand.keypoint_position[4::4]
    return [int(np.linalg.norm(hand.template - point, axis=1).argmin()) for point in tip]


def _shape_change(hand: OpenHand) -> np.ndarray:
    """How the open hand's vertices move with its ten shape coefficients."""
    still = torch.zeros(1, 15, 3, dtype=torch.float64), *torch.zeros(2, 1, 3, dtype=torch.float64)
    columns = []
    for unit in torch.eye(10, dtype=torch.float64):
        moved = hand(0.5 * unit, *still).vertex - hand(-0.5 * unit, *still).vertex
        columns.append(moved[0].numpy())
    return np.stack(columns, axis=-1)


def _regressor(vertex: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Weights of nearby vertices, not negative and with sum 1, whose mean is the joint."""
    near = np.argsort(np.linalg.norm(vertex - joint, axis=1))[:60]
    weight = nnls(np.concatenate([vertex[near].T, np.ones((1, 60))]), np.append(joint, 1.0))[0]
    row = np.zeros(len(vertex))
    row[near] = weight / weight.sum()
    return row
