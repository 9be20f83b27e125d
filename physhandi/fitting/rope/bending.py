"""Fitted parameters of a rope that bends, and the model that follows from them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.errors import FitError
from physhandi.fitting.object_problem import ObjectProblem, problem_parameters
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.rod import Rod
from physhandi.simulation.topology import build_model

AXIAL_STIFFNESS = 1e4
"""Stiffness of the springs by the mass of a metre [m²/s²]: a swung rope is strained by less than
1 %, and substeps stay long."""
AXIAL_DAMPING = 100.0
"""Dashpot along the springs [N·s/m]."""
GRIP_STIFFNESS = 4.0
"""Stiffness of a virtual spring [N/m] over that of the springs along the rope."""
GRIP_LENGTH = 1e-6
"""Rest length of a virtual spring: next to nothing, for a node sits on its control node [m]."""
GRIP_REACH = 0.25
"""Distance up to which a control node holds a node, as a part of the shortest segment."""
LOGARITHMS = ("stiffness", "damping", "drag", "twist_stiffness")
"""Numbers of `Bending` that are positive."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bending:
    """Fitted parameters of a rope, the same in all sequences."""

    stiffness: float
    """Bending stiffness EI by the mass of a metre [m⁴/s²]."""
    damping: float
    """Time for which a change of curvature counts as bending [s]."""
    drag: float
    """Decay rate of every velocity [1/s]."""
    twist_stiffness: float
    """Twist stiffness GJ by the mass of a metre [m⁴/s²]."""
    curvature: Float[ndarray, "vertex 2"]
    """Curvature at rest of each vertex that is not an end [1/m]."""

    def to_vector(self) -> Float[ndarray, " number"]:
        """Give the numbers that steps are made in: `LOGARITHMS`, then curvatures."""
        logarithms = np.log([getattr(self, name) for name in LOGARITHMS])
        return np.concatenate([logarithms, self.curvature.ravel()])

    @classmethod
    def from_vector(cls, vector: Float[ndarray, " number"]) -> "Bending":
        """Undo `to_vector`."""
        count = len(LOGARITHMS)
        values = (float(value) for value in np.exp(vector[:count]))
        named = dict(zip(LOGARITHMS, values, strict=True))
        return cls(**named, curvature=vector[count:].reshape(-1, 2))

    def to_array(self) -> Float[ndarray, " number"]:
        """Give all numbers as they are: `LOGARITHMS`, then curvatures."""
        positive = [getattr(self, name) for name in LOGARITHMS]
        return np.concatenate([positive, self.curvature.ravel()])

    @classmethod
    def from_array(cls, array: Float[ndarray, " number"]) -> "Bending":
        """Undo `to_array`, to the last bit."""
        count = len(LOGARITHMS)
        named = dict(zip(LOGARITHMS, array[:count].tolist(), strict=True))
        return cls(**named, curvature=array[count:].reshape(-1, 2))

    @classmethod
    def straight(cls, vertex_count: int) -> "Bending":
        """Describe a rope of which nothing is known but that it is straight at rest."""
        return cls(
            stiffness=0.025,
            damping=0.02,
            drag=0.3,
            twist_stiffness=0.025,
            curvature=np.zeros((vertex_count - 2, 2)),
        )


def rope_parameters(problem: ObjectProblem, start: SimulationParameters) -> SimulationParameters:
    """Choose the parameters of springs that keep a rope's length and hold it in its grips."""
    step = np.linalg.norm(np.diff(problem.rest_node.astype(np.float64), axis=0), axis=1)
    along = AXIAL_STIFFNESS / float(step.mean()) ** 2
    return start.replace(
        stiffness=along * float(step.mean()),
        virtual_stiffness=GRIP_STIFFNESS * along * GRIP_LENGTH,
        virtual_rest_length_floor=GRIP_LENGTH,
        virtual_connection_radius=GRIP_REACH * float(step.min()),
        virtual_max_neighbors=1,
        damping=AXIAL_DAMPING,
    )


def rope_model(
    problem: ObjectProblem, parameters: SimulationParameters, bending: Bending
) -> SpringMassModel:
    """Build the springs and the rod of a rope in one sequence.

    Raises:
        FitError: If no control node lies on a node of the rope.
    """
    count = len(problem.object_node)
    rod = Rod(
        node=np.arange(count, dtype=np.int32),
        held_by=problem.control.shape[1] - 1,
        length=np.ones(count, np.float32),
        natural_curvature=np.zeros((count, 2), np.float32),
        stiffness=0.0,
        damping=0.0,
        twist_stiffness=0.0,
    )
    model = build_model(
        problem.object_node,
        problem.control[0],
        problem_parameters(parameters, problem),
        rest_node=problem.rest_node,
        rod=rod,
    )
    if model.virtual_spring_count == 0:
        raise FitError(
            f"Sequence '{problem.name}': no control node lies on a node of the rope, so nothing "
            "holds it. Check that control.npy and object_node.npy lie in one world."
        )
    model = replace(model, initial_velocity=problem.initial_velocity, clearance=problem.clearance)
    model = gripped(model)
    return replace(model, rod=bent(model, bending))


def gripped(model: SpringMassModel) -> SpringMassModel:
    """Give the springs of a rope beside nodes that are held their lengths at frame 0.

    Grippers take hold of a rope a little farther up or down in each recording. Without a rod, a
    model is not changed.
    """
    if model.rod is None:
        return model
    own = model.spring_nodes[: model.object_spring_count]
    held = model.spring_nodes[model.object_spring_count :].min(axis=1)
    offset = model.object_node[own[:, 1]] - model.object_node[own[:, 0]]
    is_beside = np.isin(own, held).any(axis=1)
    rest_length = model.rest_length.copy()
    rest_length[: len(own)][is_beside] = np.linalg.norm(offset, axis=1)[is_beside]
    order = np.argsort(model.rod.node)
    first = np.minimum(order[own[:, 0]], order[own[:, 1]])
    edge = np.empty(len(own), np.float32)
    edge[first] = rest_length[: len(own)]
    length = 0.5 * (np.append(edge, edge[-1]) + np.append(edge[0], edge))
    rod = replace(model.rod, length=length.astype(np.float32))
    return replace(model, rest_length=rest_length, rod=rod)


def bent(model: SpringMassModel, bending: Bending) -> Rod:
    """Give a model's rod with other numbers."""
    rod = model.rod
    if rod is None:
        raise ValueError("The model has no rod.")
    curvature = np.zeros((len(rod.node), 2), np.float32)
    curvature[1:-1] = bending.curvature
    spacing = float(model.rest_length[: model.object_spring_count].mean())
    return replace(
        rod,
        natural_curvature=curvature,
        # Each node weighs 1 kg.
        stiffness=bending.stiffness / spacing,
        damping=bending.damping,
        twist_stiffness=bending.twist_stiffness / spacing,
    )
