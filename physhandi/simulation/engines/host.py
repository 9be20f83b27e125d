"""The interface of a simulator that the engines use."""

from typing import Any, Protocol

import warp as wp
from numpy import ndarray

from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


class EngineHost(Protocol):
    """A simulator, as an engine sees it."""

    model: SpringMassModel
    parameters: SimulationParameters
    device: Any
    world: wp.array
    clearance: wp.array
    first_divergence: wp.array
    position: wp.array
    velocity: wp.array

    @property
    def material(self) -> tuple[wp.array, wp.array, wp.array]:
        """Rest length, stiffness and damping of every spring."""
        ...

    @property
    def controls(self) -> tuple[wp.array, wp.array]:
        """Positions of the control nodes at the start and the end of the frame [m]."""
        ...

    def array(self, value: ndarray, dtype: Any) -> wp.array:
        """Copy an array to the device."""
        ...
