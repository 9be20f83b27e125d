"""How much work the stages of a fit are, so that fits with other settings can be compared."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from physhandi.errors import UsageError
from physhandi.fitting.config import (
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SPRINGS,
    PipelineConfig,
    config_from_dict,
)

_NODE_COST = 6.0
"""What a node costs in a substep, in springs."""
_LEAST_SUBSTEPS = 120.0
"""Substeps of a soft object: none is longer than 1/3600 s."""
_DEPTH_COST = 15.0
"""What an update of the hand with depth costs, in updates without (measured: 14 to 18)."""
_GRADIENT_COST = 3.0
"""What a simulation with its gradient costs, in simulations without."""


@dataclass(frozen=True)
class Extent:
    """How much was recorded: what a fit's work grows with, beside its settings."""

    frames: int
    """Frames of all sequences together."""
    sequences: int
    """Number of sequences."""


def effort_of(profile: Mapping[str, Any], extent: Extent) -> dict[str, float]:
    """Weigh every stage in units of its own; only ratios between two fits mean anything.

    Args:
        profile: Settings, as a run stores them.
        extent: What the fit looks at.

    Returns:
        For each stage that depends on the settings its weight. Stages that are not in it take a
        time that grows with the frames alone.
    """
    try:
        config = config_from_dict(dict(profile))
    except UsageError:
        return {}
    rollout = extent.frames * _rollout_cost(config)
    search = config.object_.search
    # Without a word about it pycma takes so many candidates.
    count = search.population or 4 + int(3 * math.log(max(1, len(search.variables))))
    hand = config.hand
    springs, refinement = config.object_.first_order, config.refinement
    return {
        HANDS: extent.frames * (hand.iterations + _DEPTH_COST * hand.depth_iterations),
        OBSERVATION: float(extent.frames),
        SEARCH: rollout * (1 + search.generations * count),
        SPRINGS: rollout * (1 + springs.iterations * (1 + _GRADIENT_COST)),
        REFINEMENT: rollout * (refinement.iterations + 1) * (1 + _GRADIENT_COST),
        EVALUATION: float(extent.frames),
        "rollout": rollout,
    }


def hand_halves(profile: Mapping[str, Any], extent: Extent) -> tuple[float, float, float] | None:
    """Weigh the two loops of stage 1 one by one.

    Returns:
        The share of the stage's iterations that the first loop has, then the weights of the loop
        without depth and of that with depth; none if there is only one.
    """
    try:
        hand = config_from_dict(dict(profile)).hand
    except UsageError:
        return None
    if not hand.depth_iterations:
        return None
    share = hand.iterations / (hand.iterations + hand.depth_iterations)
    return (
        share,
        float(extent.frames * hand.iterations),
        float(extent.frames * hand.depth_iterations),
    )


def _rollout_cost(config: PipelineConfig) -> float:
    """Weigh the simulation of one frame: springs and nodes of a surface, times substeps."""
    parameters = config.simulation
    neighbors = max(1, parameters.max_neighbors)
    nodes = config.node_spacing**-2
    substeps = float(parameters.substeps_per_frame)
    if config.object_.automatic_substeps:
        length = 0.7 * max(parameters.connection_radius, 1e-4)
        stiffness = parameters.stiffness * parameters.stiffness_scale / length
        fastest = math.sqrt(2.0 * neighbors * stiffness)
        substeps = max(_LEAST_SUBSTEPS, 1.25 * fastest / 2.0 / parameters.frame_rate)
    return nodes * (0.5 * neighbors + _NODE_COST) * substeps
