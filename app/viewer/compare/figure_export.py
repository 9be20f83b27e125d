"""Downloads of the figure's data: positions, springs and forces of both sides."""

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from app.viewer.compare.figure import Side
from physhandi.object_rollout import ObjectRollout

_COLUMNS = (
    *("side", "frame", "kind", "node", "control"),
    *("x_m", "y_m", "z_m", "force_x_N", "force_y_N", "force_z_N", "length_m", "rest_length_m"),
)


def write_figure_npz(sides: Mapping[str, Side]) -> bytes:
    """Write all frames of both sides.

    For each side ``ours_…`` and ``phystwin_…``: ``position`` "frame node 3" and ``control``
    "frame control 3" [m], ``spring_nodes``, ``rest_length`` [m], ``stiffness`` [N],
    ``object_spring_count``, ``force`` "frame node 3" [N], the sum over virtual springs on each
    object node, and ``frame``, the frame on the screen.

    Args:
        sides: The halves by their names; one that is not simulated yet is left out.
    """
    arrays: dict[str, Any] = {}
    for name, side in sides.items():
        rollout = side.rollout
        if rollout is None:
            continue
        values = {
            "position": rollout.position[: rollout.ready],
            "control": rollout.control[: rollout.ready],
            "spring_nodes": rollout.model.spring_nodes,
            "rest_length": rollout.model.rest_length,
            "stiffness": rollout.parameters.stiffness_scale * rollout.model.stiffness,
            "object_spring_count": np.int64(rollout.model.object_spring_count),
            "force": np.stack([rollout.forces(frame) for frame in range(rollout.ready)]),
            "frame": np.int64(side.frame),
        }
        arrays |= {f"{name}_{key}": value for key, value in values.items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def write_figure_csv(sides: Mapping[str, Side]) -> bytes:
    """Write the frame on the screen as one table.

    A row of kind ``node`` tells an object node's position and the sum of the forces on it; one of
    kind ``virtual_spring`` tells its control node's position, its force on the object node, its
    length and its rest length.

    Args:
        sides: The halves by their names; one that is not simulated yet is left out.
    """
    stream = io.StringIO()
    table = csv.writer(stream)
    table.writerow(_COLUMNS)
    for name, side in sides.items():
        if side.rollout is not None:
            table.writerows(_rows(name, side.rollout, side.frame))
    return stream.getvalue().encode()


def _rows(name: str, rollout: ObjectRollout, frame: int) -> list[list[Any]]:
    position, control = np.asarray(rollout.position[frame]), np.asarray(rollout.control[frame])
    rows: list[list[Any]] = []
    for node, (place, force) in enumerate(zip(position, rollout.forces(frame), strict=True)):
        rows.append([name, frame, "node", node, "", *_texts(place), *_texts(force), "", ""])
    first = rollout.model.object_spring_count
    springs = np.sort(rollout.model.spring_nodes[first:], axis=1)
    rest = rollout.model.rest_length[first:]
    for ends, force, length in zip(springs, rollout.spring_forces(frame), rest, strict=True):
        node, holder = int(ends[0]), int(ends[1]) - rollout.model.node_count
        stretched = float(np.linalg.norm(control[holder] - position[node]))
        texts = [*_texts(control[holder]), *_texts(force), *_texts([stretched, length])]
        rows.append([name, frame, "virtual_spring", node, holder, *texts])
    return rows


def _texts(values: Any) -> list[str]:
    return [f"{float(value):.7g}" for value in values]
