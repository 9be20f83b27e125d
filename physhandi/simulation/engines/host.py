"""The interface of a simulator that the engines use."""

from typing import Any, Protocol

import warp as wp
from numpy import ndarray

from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


class FrameHost(Protocol):
    """Simulation by frames of a CUDA engine: a simulator, or several bodies side by side."""

    parameters: SimulationParameters
    device: Any
    world: wp.array
    """Of each body."""
    clearance: wp.array
    first_divergence: wp.array
    """Of each body."""

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


class EngineHost(FrameHost, Protocol):
    """A simulator, as an engine sees it."""

    model: SpringMassModel
    position: wp.array
    velocity: wp.array

    @property
    def has_contacts(self) -> bool:
        """Whether nodes collide with each other or with hands, which no engine computes."""
        ...
