"""The fitted object of a run, rebuilt for other parameters."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.run import RunFolder
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout, load_fitted
from physhandi.settings import changes
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters, parameter_names
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import largest_stable_step
from physhandi.simulation.topology import MINIMUM_VIRTUAL_REST_LENGTH, retopologize, virtual_springs

_MATERIAL = parameter_names("material")
_BUILT_IN = parameter_names("material", "topology")
"""Parameters that are built into the model; the others are read by the simulator."""
_STEP = parameter_names("step")


class FittedObject:
    """The fitted object of one sequence of a run, from which sliders start."""

    def __init__(self, folder: str, sequence: str) -> None:
        run = RunFolder.open(Path(folder))
        take = load_fitted(run, sequence)
        if take is None:
            raise MissingInputError(
                f"Run '{run.name}' has no fitted object for sequence '{sequence}' to simulate."
            )
        self.take: ObjectRollout = take
        self._all_controls = np.ascontiguousarray(take.control, dtype=np.float32)
        self._control = self._all_controls
        # Springs begin where the hands were when they were laid; refinement may have moved these.
        moved = f"sequences/{sequence}/attachment.npy"
        self._all_attached = run.array(moved) if run.has(moved) else self._all_controls[0]
        self._attached = self._all_attached
        self._chosen: tuple[int, ...] | None = None
        self._latest: tuple[tuple[float, ...], SpringMassModel] | None = None
        self._simulator: Simulator | None = None
        self._limit: tuple[SpringMassModel, float, float] | None = None
        self._rest_node = None
        if run.has("object/material.safetensors"):
            self._rest_node = run.tensors("object/material.safetensors").get("rest_node")

    def choose_controls(self, chosen: Sequence[int] | None) -> Float[ndarray, "frame control 3"]:
        """Let only some of the control nodes hold the object from now on.

        The object's own springs then stay as fitted, whatever the parameters say of them.

        Args:
            chosen: Numbers of control nodes; None for all.

        Returns:
            Their positions [m].
        """
        wanted = None if chosen is None else tuple(chosen)
        if wanted != self._chosen:
            self._chosen, self._latest = wanted, None
            everything = self._all_controls
            self._control = everything if wanted is None else everything[:, list(wanted)].copy()
            attached = self._all_attached
            self._attached = attached if wanted is None else attached[list(wanted)].copy()
        return self._control

    def model(self, parameters: SimulationParameters) -> SpringMassModel:
        """Build the springs for other parameters, keeping what was fitted."""
        key = tuple(getattr(parameters, name) for name in _BUILT_IN)
        if self._latest is None or self._latest[0] != key:
            self._latest = (key, self._build(parameters))
        return self._latest[1]

    def needed_substeps(self, model: SpringMassModel, parameters: SimulationParameters) -> int:
        """Estimate the fewest substeps a frame that a model survives, without any margin."""
        known, scale = self._limit, parameters.stiffness_scale
        if known is None or known[0] is not model or known[1] != scale:
            step = largest_stable_step(model, parameters, self._control[0])
            known = self._limit = (model, scale, step)
        return max(1, math.ceil(1.0 / (parameters.simulated_frame_rate * known[2])))

    def simulator(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> Simulator:
        """Place a model on the device, or use it again if it is there already."""
        known = self._simulator
        if (
            known is not None
            and known.model is model
            and not set(_STEP) & set(changes(known.parameters, parameters))
        ):
            known.set_parameters(parameters)
            return known
        self._simulator = Simulator(model, parameters, device=device)
        return self._simulator

    def _build(self, parameters: SimulationParameters) -> SpringMassModel:
        fitted, model = self.take.parameters, self.take.model
        if self._chosen is not None:
            return _hold_anew(model, parameters, self._attached)
        is_changed = set(_BUILT_IN) & set(changes(fitted, parameters))
        if is_changed <= set(_MATERIAL):
            return _scale_material(model, fitted, parameters) if is_changed else model
        return retopologize(
            model, parameters, self._attached, fitted=fitted, rest_node=self._rest_node
        )


def _scale_material(
    model: SpringMassModel, fitted: SimulationParameters, parameters: SimulationParameters
) -> SpringMassModel:
    """Scale stiffness and damping of the springs as the parameters for all of them changed."""

    def scaled(value: ndarray, field: str) -> ndarray:
        was, now = getattr(fitted, field), getattr(parameters, field)
        if was == now:
            return value
        return value * np.float32(now / was) if was > 0 else np.full_like(value, now)

    own, virtual = np.split(model.stiffness, [model.object_spring_count])
    stiffness = [scaled(own, "stiffness"), scaled(virtual, "virtual_stiffness")]
    return replace(
        model,
        stiffness=np.concatenate(stiffness),
        damping=scaled(model.damping, "damping"),
    )


def _hold_anew(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
) -> SpringMassModel:
    """Join an object to other control nodes: its own springs stay, the virtual ones are new."""
    springs, length = virtual_springs(
        control_0.astype(np.float64),
        model.object_node.astype(np.float64),
        parameters.virtual_connection_radius,
        parameters.virtual_max_neighbors,
    )
    floor = max(parameters.virtual_rest_length_floor, MINIMUM_VIRTUAL_REST_LENGTH)
    own = slice(0, model.object_spring_count)

    def joined(fitted: ndarray, new: ndarray | float) -> ndarray:
        extra = np.broadcast_to(np.asarray(new, dtype=np.float32), (len(springs),))
        return np.concatenate([fitted[own], extra])

    return replace(
        model,
        spring_nodes=np.concatenate([model.spring_nodes[own], springs]),
        rest_length=joined(model.rest_length, np.maximum(length, floor)),
        stiffness=joined(model.stiffness, parameters.virtual_stiffness),
        damping=joined(model.damping, parameters.damping),
        control_count=len(control_0),
    )
