"""The surface of a run's hands as triangles of its control nodes."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.layout import SequenceFiles
from physhandi.data.run_folder import reading
from physhandi.data.sequence_meta import SIDES


def joined_faces(
    hands: Iterable[tuple[int, Int[ndarray, "face 3"]]], control_count: int
) -> Int32[ndarray, "all_face 3"]:
    """Number the triangles of hands by control nodes, as which all their vertices are numbered.

    Args:
        hands: Number of vertices and triangles of each hand, in the order of control nodes.
        control_count: Number of control nodes.

    Returns:
        The triangles; none where control nodes are not the vertices of the hands, but some of them
        or single points.
    """
    offset, faces = 0, [np.zeros((0, 3), np.int32)]
    for count, face in hands:
        faces.append((face + offset).astype(np.int32))
        offset += count
    return np.concatenate(faces) if offset == control_count else faces[0]


def stored_faces(out: Path, sequence: str, control_count: int) -> Int32[ndarray, "all_face 3"]:
    """Number the triangles of a run's hands by control nodes; see `joined_faces`.

    Args:
        out: Outputs of the run.
        sequence: Name of one of its sequences.
        control_count: Number of its control nodes.

    Raises:
        RunError: If a file is damaged.
    """
    files, hands = SequenceFiles(sequence), []
    for side in SIDES:
        vertex, face = (out / file for file in (files.hand_vertex(side), files.hand_face(side)))
        if vertex.is_file() and face.is_file():
            with reading(vertex):
                count = read_array(vertex, mmap=True).shape[1]
            with reading(face):
                hands.append((count, read_array(face)))
    return joined_faces(hands, control_count)
