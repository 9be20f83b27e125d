"""Reads the results of PhysTwin's optimisation of a case; they contain no topology."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.importers.phystwin_files import fail, named, numbers
from physhandi.data.untrusted.pickles import read_untrusted


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Optimised collision coefficients, before the simulator clamps them."""

    restitution: float
    """``collide_elas``, of the ground."""
    friction: float
    """``collide_fric``, of the ground."""
    self_restitution: float
    """``collide_object_elas``, between nodes."""
    self_friction: float
    """``collide_object_fric``, between nodes."""


@dataclass(frozen=True, kw_only=True)
class Optimum:
    """Content of ``optimal_params.pkl``: the result of the zeroth-order search."""

    stiffness: float
    """``global_spring_Y`` [N]."""
    object_radius: float
    """Nodes nearer than this are joined [m]."""
    object_max_neighbours: int
    """Most hits of one node's search, the node itself included."""
    controller_radius: float
    """Nodes nearer than this to a controller are held by it [m]."""
    controller_max_neighbours: int
    """Most hits of one controller's search."""
    collision_distance: float
    """``collision_dist`` [m]."""
    drag: float
    """``drag_damping`` as it was found [1/s]."""
    damping: float
    """``dashpot_damping`` as it was found [N·s/m]."""
    contact: Contact
    """Collision coefficients."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Checkpoint:
    """Content of ``best_*.pth``: the result of the first-order optimisation, without topology."""

    stiffness: Float[ndarray, " spring"]
    """``spring_Y`` of each spring, in the order in which PhysTwin found the springs [N]."""
    object_spring_count: int
    """Number of leading springs that join two object nodes."""
    contact: Contact
    """Collision coefficients."""
    epoch: int
    """Epoch after which it was stored."""


def read_optimum(path: Path) -> Optimum:
    """Read ``optimal_params.pkl``.

    Raises:
        ImportFailedError: If a field is missing or holds an impossible value.
    """
    table = named(path, read_untrusted(path))
    # PhysTwin's config turns the searched neighbour limits into whole numbers by int().
    return Optimum(
        stiffness=_scalar(path, table, "global_spring_Y", least=0.0),
        object_radius=_scalar(path, table, "object_radius", least=1e-6),
        object_max_neighbours=int(_scalar(path, table, "object_max_neighbours", least=1.0)),
        controller_radius=_scalar(path, table, "controller_radius", least=1e-6),
        controller_max_neighbours=int(_scalar(path, table, "controller_max_neighbours", least=1.0)),
        collision_distance=_scalar(path, table, "collision_dist", least=0.0),
        drag=_scalar(path, table, "drag_damping", least=0.0),
        damping=_scalar(path, table, "dashpot_damping", least=0.0),
        contact=_contact(path, table),
    )


def read_phystwin_checkpoint(path: Path) -> Checkpoint:
    """Read ``best_*.pth`` or ``iter_*.pth``.

    Raises:
        ImportFailedError: If a field is missing or holds an impossible value.
    """
    table = named(path, read_untrusted(path))
    stiffness = numbers(path, table, "spring_Y", ("spring",))
    wrong = np.flatnonzero(~(np.isfinite(stiffness) & (stiffness >= 0)))
    if wrong.size:
        fail(path, f"spring_Y: spring {wrong[0]} is {stiffness[wrong[0]]}; expected 0 or more [N]")
    return Checkpoint(
        stiffness=stiffness,
        object_spring_count=int(_scalar(path, table, "num_object_springs", least=0.0)),
        contact=_contact(path, table),
        epoch=int(_scalar(path, table, "epoch")) if "epoch" in table else -1,
    )


def read_inference(path: Path, shape: tuple[int, int]) -> Float[ndarray, "frame node 3"]:
    """Read ``inference.pkl``, PhysTwin's own rollout of all frames [m].

    Args:
        path: The file.
        shape: Number of frames and of nodes that it must have.

    Raises:
        ImportFailedError: If it has another shape, or a node is not finite.
    """
    position = numbers(path, {"content": read_untrusted(path)}, "content", (*shape, 3))
    wrong = np.argwhere(~np.isfinite(position).all(axis=-1))
    if wrong.size:
        frame, node = wrong[0]
        fail(path, f"content: frame {frame}, node {node} is {position[frame, node].tolist()}")
    return position


def _contact(path: Path, table: Mapping[str, Any]) -> Contact:
    return Contact(
        restitution=_scalar(path, table, "collide_elas"),
        friction=_scalar(path, table, "collide_fric"),
        self_restitution=_scalar(path, table, "collide_object_elas"),
        self_friction=_scalar(path, table, "collide_object_fric"),
    )


def _scalar(path: Path, table: Mapping[str, Any], field: str, *, least: float = -math.inf) -> float:
    """Read a field as one finite number, or an array of one."""
    fields = {field: np.ravel(table[field])} if field in table else table
    value = float(numbers(path, fields, field, (1,))[0])
    if not math.isfinite(value) or value < least:
        expected = "a finite number" if math.isinf(least) else f"a number from {least:g} on"
        fail(path, f"{field} is {value}; expected {expected}")
    return value
