"""The quantities that color an object: their names, units and values in one frame."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.color.colormaps import Scale
from app.viewer.color.difference import rollout_difference
from app.viewer.content.layers import Coloring
from physhandi.data.object_mass import ObjectMass
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.forces import node_means


@dataclass(frozen=True, kw_only=True, eq=False)
class Values:
    """A quantity in one frame, in SI units; NaN where it is not known."""

    node: Float[ndarray, " node"]
    """At the object nodes."""
    spring: Float[ndarray, "spring 2"]
    """At both ends of the springs, in the model's order."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A quantity, its unit and its color scale."""

    label: str
    """Its name."""
    about: str
    """Its definition at nodes and springs, in a sentence."""
    unit: str
    """Unit in which it is written, ``mm`` if it is a length."""
    factor: float = 1.0
    """Written value of one SI unit."""
    scale: Scale = "sequential"
    """Its color map."""
    is_logarithmic: bool = False
    """Whether equal ratios are equal steps of color."""
    is_static: bool = False
    """Whether it is the same in all frames."""


QUANTITIES: Mapping[Coloring, Quantity] = {
    "error": Quantity(
        label="Error",
        about="Distance of the object from what was observed in this frame",
        unit="mm",
        factor=1e3,
    ),
    "stiffness": Quantity(
        label="Stiffness",
        about="Force per unit strain of a spring; at a node the geometric mean of its springs",
        unit="N",
        is_logarithmic=True,
        is_static=True,
    ),
    "damping": Quantity(
        label="Damping",
        about="Dashpot of a spring; at a node the mean of its springs",
        unit="N·s/m",
        is_static=True,
    ),
    "strain": Quantity(
        label="Strain",
        about="How much longer (red) or shorter (blue) than at rest; at a node the mean of its "
        "springs",
        unit="%",
        factor=1e2,
        scale="diverging",
    ),
    "speed": Quantity(label="Speed", about="Of nodes; along a spring that of its ends", unit="m/s"),
    "force": Quantity(
        label="Force",
        about="Pull of a spring; at a node the sum of the forces of the hand on it",
        unit="N",
    ),
    "difference": Quantity(
        label="Difference",
        about="Distance from the same node of the fitted rollout",
        unit="mm",
        factor=1e3,
    ),
}
"""Every coloring but ``plain``."""


def in_length_unit(quantity: Quantity, unit: str) -> Quantity:
    """Write a quantity in the units of a content whose lengths are in `unit`, ``"m"`` if metric."""
    if unit == "m" or quantity.unit not in {"mm", "m/s"}:
        return quantity
    if quantity.unit == "mm":
        return replace(quantity, unit=unit, factor=1.0)
    return replace(quantity, unit=f"{unit}/s")


_OF_FORCE = ("N", "N·s/m")


def for_mass(quantity: Quantity, mass: ObjectMass | None, node_count: int) -> Quantity:
    """Write forces, stiffness and damping for what the object weighs, and say so.

    Args:
        quantity: The quantity.
        mass: What the object weighs; None if nobody knows.
        node_count: Nodes of its model, of 1 kg each.
    """
    if quantity.unit not in _OF_FORCE:
        return quantity
    if mass is None:
        return replace(quantity, about=f"{quantity.about}; for nodes of 1 kg each")
    factor = quantity.factor * mass.force_factor(node_count)
    about = f"{quantity.about}; for an object of {mass.text} ({mass.source})"
    return replace(quantity, factor=factor, about=about)


ErrorOf = Callable[[ObjectRollout, int], Float[ndarray, " node"]]
"""Measures how far each node of a frame is from what was observed [m]."""


def measure(
    coloring: Coloring,
    rollout: ObjectRollout,
    frame: int,
    *,
    error_of: ErrorOf | None = None,
    reference: ObjectRollout | None = None,
) -> Values:
    """Measure a quantity in one frame.

    Args:
        coloring: Which one, not ``plain``.
        rollout: The rollout.
        frame: One of its frames that is ready.
        error_of: Measures the error; without it the error is unknown.
        reference: What ``difference`` compares with; without it the difference is unknown.
    """
    model = rollout.model
    match coloring:
        case "stiffness":
            value = rollout.parameters.stiffness_scale * model.stiffness.astype(np.float64)
            mean = np.exp(node_means(model, np.log(np.maximum(value, 1e-300))))
            return Values(node=mean, spring=_both_ends(value))
        case "damping":
            value = model.damping.astype(np.float64)
            return Values(node=node_means(model, value), spring=_both_ends(value))
        case "strain":
            value = rollout.strains(frame)
            return Values(node=node_means(model, value), spring=_both_ends(value))
        case "force":
            pull = np.linalg.norm(rollout.forces(frame), axis=1)
            return Values(node=pull, spring=_both_ends(np.abs(rollout.tensions(frame))))
        case "speed":
            _, velocity, _, control_velocity = rollout.state(frame)
            node, control = (np.linalg.norm(v, axis=1) for v in (velocity, control_velocity))
            return Values(node=node, spring=np.concatenate([node, control])[model.spring_nodes])
        case "error" | "difference":
            node = _distance(coloring, rollout, frame, error_of, reference)
            return Values(node=node, spring=from_nodes(rollout, node))
        case "plain":
            raise ValueError("plain colors have no quantity to measure")


def _distance(
    coloring: Coloring,
    rollout: ObjectRollout,
    frame: int,
    error_of: ErrorOf | None,
    reference: ObjectRollout | None,
) -> Float[ndarray, " node"]:
    """Measure the distance from the observation or from the reference; NaN without them."""
    if coloring == "error" and error_of is not None:
        return error_of(rollout, frame)
    if coloring == "difference" and reference is not None and reference.ready > 0:
        return rollout_difference(rollout, frame, reference, min(frame, reference.ready - 1))
    return np.full(rollout.model.node_count, np.nan)


def _both_ends(value: Float[ndarray, " spring"]) -> Float[ndarray, "spring 2"]:
    return np.repeat(value[:, None], 2, axis=1)


def from_nodes(rollout: ObjectRollout, node: Float[ndarray, " node"]) -> Float[ndarray, "spring 2"]:
    """Give spring ends their node's value; a control node has none, so it gets the other end's."""
    ends = np.sort(rollout.model.spring_nodes, axis=1)
    swapped = rollout.model.spring_nodes[:, 0] > rollout.model.spring_nodes[:, 1]
    is_control = ends[:, 1] >= rollout.model.node_count
    ends[is_control, 1] = ends[is_control, 0]
    ends[swapped] = ends[swapped][:, ::-1]
    return node[ends]
