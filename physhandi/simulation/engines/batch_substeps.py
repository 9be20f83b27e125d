"""Substeps with which each candidate of a search is stable, all found in one launch."""

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy import ndarray

from physhandi.rotations import unit
from physhandi.simulation.kernels.batch.loads import find_loads
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.stability import SAFETY, critical_step, substeps_of
from physhandi.simulation.topology import virtual_floor


def bound_substeps(
    master: MasterTopology,
    candidates: Sequence[SimulationParameters],
    device: str,
    *,
    safety: float = SAFETY,
) -> list[int]:
    """Return numbers of substeps that `stability.stable_substeps` does not exceed.

    A spring between nodes that move by x and y stores at most twice what it would store if each of
    them moved alone. So no mode is stiffer than twice the stiffest direction of a node whose
    neighbors stand still. Nothing is iterated, and no model is built.

    Args:
        master: Springs of all candidates.
        candidates: Their radii, neighbor limits and material.
        device: Warp device.
        safety: Factor on the number of substeps that is just stable.

    Returns:
        The substeps of a frame for each candidate.
    """
    own, nodes = master.object_spring_count, len(master.object_node)
    ends = master.spring_nodes
    node = np.concatenate([ends[:own, 0], ends[:own, 1], ends[own:].min(axis=1, initial=nodes)])
    number = np.arange(len(ends))
    spring = np.concatenate([number[:own], number])
    order = np.argsort(node, kind="stable")
    start = np.searchsorted(node[order], np.arange(nodes + 1))
    offset = np.diff(master.object_node.astype(np.float64)[ends[:own]], axis=1)[:, 0]
    limits = np.array([_limits(parameters) for parameters in candidates])

    def array(value: ndarray, kind: type, dtype: type) -> wp.array:
        return wp.array(value.astype(kind), dtype=dtype, device=device)

    shape = (len(candidates), nodes)
    loads = [wp.zeros(shape, dtype=wp.float64, device=device) for _ in range(2)]
    wp.launch(
        find_loads,
        dim=shape,
        inputs=[
            array(start, np.int32, wp.int32),
            array(spring[order], np.int32, wp.int32),
            own,
            array(unit(offset), np.float64, wp.vec3d),
            array(master.length, np.float64, wp.float64),
            array(master.rank, np.int32, wp.int32),
            array(limits, np.float64, wp.float64),
        ],
        outputs=loads,
        device=device,
    )
    most = zip(*(load.numpy().max(axis=1, initial=0.0) for load in loads), strict=True)
    return [
        substeps_of(critical_step(float(stiffness), float(damping)), parameters, safety)
        for parameters, (stiffness, damping) in zip(candidates, most, strict=True)
    ]


def _limits(parameters: SimulationParameters) -> list[list[float]]:
    """List what `kernels.batch.loads.find_loads` reads of a candidate."""
    return [
        [
            radius,
            most,
            floor,
            parameters.stiffness_scale * float(np.float32(stiffness)),
            float(np.float32(parameters.damping)) if stiffness > 0.0 else 0.0,
        ]
        for radius, most, floor, stiffness in (
            (
                parameters.connection_radius,
                parameters.max_neighbors,
                parameters.rest_length_floor,
                parameters.stiffness,
            ),
            (
                parameters.virtual_connection_radius,
                parameters.virtual_max_neighbors,
                virtual_floor(parameters),
                parameters.virtual_stiffness,
            ),
        )
    ]
