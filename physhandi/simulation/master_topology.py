"""The superset of springs of all candidates of a search, and the subset of each candidate."""

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.simulation.contact_intervals import ContactIntervals, always
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import MINIMUM_LENGTH, virtual_floor


@dataclass(frozen=True, kw_only=True, eq=False)
class MasterTopology:
    """The springs of the largest radii and neighbor limits; each candidate has a subset.

    A spring exists for a candidate if its length is below the candidate's radius and its rank
    below its neighbor limit: the rank is the place of one end among the other's neighbors,
    counted from 0, by the end that is quicker to propose it. Where a limit cuts between neighbors
    that are equally far, the choice may be another one than `topology.build_model`'s.
    """

    object_node: Float32[ndarray, "node 3"]
    """Positions of the object nodes at frame 0 [m]."""
    initial_velocity: Float32[ndarray, "node 3"]
    """Velocities of the object nodes at frame 0 [m/s]."""
    clearance: Float32[ndarray, " node"]
    """Height above the ground at which each object node touches it [m]."""
    control_count: int
    """Number of control nodes."""
    spring_nodes: Int32[ndarray, "spring 2"]
    """The two nodes of each spring; object springs first, then virtual ones."""
    length: Float[ndarray, " spring"]
    """Length at rest [m]."""
    rank: Int32[ndarray, " spring"]
    """Place among the neighbors of the end that proposes the spring first."""
    object_spring_count: int
    """Number of leading springs that join two object nodes; the others are virtual."""
    attached: Int32[ndarray, "virtual 2"]
    """Frames in which each virtual spring is attached and lets go; see `SpringMassModel`."""

    @classmethod
    def of(
        cls,
        object_node: Float[ndarray, "node 3"],
        control_0: Float[ndarray, "control 3"],
        parameters: Many[SimulationParameters],
        *,
        rest_node: Float[ndarray, "node 3"] | None = None,
        initial_velocity: Float[ndarray, "node 3"] | None = None,
        clearance: Float[ndarray, " node"] | None = None,
        contacts: ContactIntervals | None = None,
    ) -> "MasterTopology":
        """Find the springs of all candidates at once.

        Args:
            object_node: Positions of the object nodes at frame 0 [m].
            control_0: Positions of the control nodes at frame 0 [m].
            parameters: The candidates.
            rest_node: The object's rest shape [m], if it differs from frame 0.
            initial_velocity: Of the object nodes at frame 0 [m/s]; at rest if left out.
            clearance: Height above the ground at which each object node touches it [m]; 0 if left
                out.
            contacts: What touches, and when; see `topology.build_model`.
        """
        node = np.asarray(object_node, dtype=np.float64)
        rest = node if rest_node is None else np.asarray(rest_node, dtype=np.float64)
        control = np.asarray(control_0, dtype=np.float64)
        springs, length, rank = _ranked_neighbors(
            rest,
            max(p.connection_radius for p in parameters),
            max(p.max_neighbors for p in parameters),
        )
        reach = (
            max(p.virtual_connection_radius for p in parameters),
            max(p.virtual_max_neighbors for p in parameters),
        )
        if contacts is None:
            virtual, virtual_length, virtual_rank = _ranked_holds(control, node, *reach)
            attached = always(len(virtual))
        else:
            near = contacts.within(*reach)
            virtual, virtual_length = near.spring_nodes(len(node)), near.distance.astype(np.float64)
            virtual_rank, attached = near.rank, near.interval
        still = np.zeros(node.shape)
        return cls(
            object_node=node.astype(np.float32),
            initial_velocity=np.asarray(
                still if initial_velocity is None else initial_velocity, np.float32
            ),
            clearance=np.asarray(
                np.zeros(len(node)) if clearance is None else clearance, np.float32
            ),
            control_count=len(control),
            spring_nodes=np.concatenate([springs, virtual]).astype(np.int32),
            length=np.concatenate([length, virtual_length]),
            rank=np.concatenate([rank, virtual_rank]).astype(np.int32),
            object_spring_count=len(springs),
            attached=attached,
        )

    def has(self, parameters: SimulationParameters) -> Bool[ndarray, " spring"]:
        """Mark the springs that a candidate has."""
        object_part = slice(None, self.object_spring_count)
        virtual_part = slice(self.object_spring_count, None)
        exists = np.empty(len(self.length), dtype=bool)
        for part, radius, most in (
            (object_part, parameters.connection_radius, parameters.max_neighbors),
            (
                virtual_part,
                parameters.virtual_connection_radius,
                parameters.virtual_max_neighbors,
            ),
        ):
            exists[part] = (self.length[part] < radius) & (self.rank[part] < most)
        return exists

    def rest_length(self, parameters: SimulationParameters) -> Float32[ndarray, " spring"]:
        """Compute the rest length of every spring with a candidate's floors [m]."""
        floor = np.full(len(self.length), virtual_floor(parameters))
        floor[: self.object_spring_count] = parameters.rest_length_floor
        return np.maximum(self.length, floor).astype(np.float32)

    def model(self, parameters: SimulationParameters) -> SpringMassModel:
        """Build the model of one candidate, as `topology.build_model` does."""
        exists = self.has(parameters)
        return self._model(parameters, exists)

    def whole(self, parameters: SimulationParameters) -> SpringMassModel:
        """Build a model that has all springs."""
        return self._model(parameters, np.ones(len(self.length), dtype=bool))

    def _model(
        self, parameters: SimulationParameters, exists: Bool[ndarray, " spring"]
    ) -> SpringMassModel:
        is_object = np.arange(len(exists)) < self.object_spring_count
        stiffness = np.where(is_object, parameters.stiffness, parameters.virtual_stiffness)
        damping = np.where(stiffness > 0.0, parameters.damping, 0.0)
        return SpringMassModel(
            object_node=self.object_node,
            initial_velocity=self.initial_velocity,
            clearance=self.clearance,
            spring_nodes=self.spring_nodes[exists],
            rest_length=self.rest_length(parameters)[exists],
            stiffness=stiffness[exists].astype(np.float32),
            damping=damping[exists].astype(np.float32),
            object_spring_count=int(exists[: self.object_spring_count].sum()),
            control_count=self.control_count,
            attached=self.attached[exists[self.object_spring_count :]],
        )


_Ranked = tuple[Int[ndarray, "spring 2"], Float[ndarray, " spring"], Int[ndarray, " spring"]]


def _ranked_neighbors(node: ndarray, radius: float, most: int) -> _Ranked:
    """List pairs of nodes, their distances [m] and the better of their two ranks."""
    if most < 1 or len(node) < 2:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64)
    count = min(most + 1, len(node))
    distance, neighbor = (np.asarray(columns) for columns in KDTree(node).query(node, k=count))
    own = np.arange(len(node))[:, None]
    is_other = neighbor != own
    place = np.cumsum(is_other, axis=1) - 1
    is_spring = is_other & (place < most) & (distance < radius) & (distance > MINIMUM_LENGTH)
    first, second = np.broadcast_to(own, neighbor.shape)[is_spring], neighbor[is_spring]
    key = np.minimum(first, second) * len(node) + np.maximum(first, second)
    order = np.lexsort((place[is_spring], key))
    unique, index = np.unique(key[order], return_index=True)
    springs = np.stack(np.divmod(unique, len(node)), axis=1)
    length = np.linalg.norm(node[springs[:, 1]] - node[springs[:, 0]], axis=1)
    return springs, length, place[is_spring][order][index]


def _ranked_holds(control: ndarray, node: ndarray, radius: float, most: int) -> _Ranked:
    """List pairs of object node and control node, their distances [m] and ranks."""
    if most < 1 or len(node) == 0 or len(control) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64)
    count = min(most, len(node))
    distance, neighbor = (
        np.reshape(columns, (len(control), count))
        for columns in KDTree(node).query(control, k=count)
    )
    is_spring = distance < radius
    control_index = np.broadcast_to(np.arange(len(control))[:, None], neighbor.shape)[is_spring]
    rank = np.broadcast_to(np.arange(count), neighbor.shape)[is_spring]
    order = np.lexsort((control_index, neighbor[is_spring]))
    springs = np.stack([neighbor[is_spring], len(node) + control_index], axis=1)[order]
    return springs, distance[is_spring][order], rank[order]
