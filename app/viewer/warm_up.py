"""What the live simulation process does before anybody asks, so that nobody waits for it."""

import logging

import numpy as np

from physhandi.errors import PhysHandiError
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

logger = logging.getLogger(__name__)

_PARAMETERS = SimulationParameters(
    connection_radius=0.015,
    virtual_connection_radius=0.015,
    stiffness=10.0,
    virtual_stiffness=10.0,
    damping=0.1,
    substeps_per_frame=100,
)


def warm_up(device: str) -> None:
    """Simulate a small cube for a frame, which loads the kernels or compiles them.

    What fails here fails again when somebody asks for a rollout, who is then told.

    Args:
        device: Warp device.
    """
    node = 0.01 * np.stack(np.meshgrid(*3 * [np.arange(3.0)]), axis=-1).reshape(-1, 3)
    node = node.astype(np.float32)
    control = np.repeat(node[None, :4], 2, axis=0)
    try:
        model = build_model(node, control[0], _PARAMETERS)
        Simulator(model, _PARAMETERS, device).rollout(control)
        stable_substeps(model, _PARAMETERS, control[0])
    except (PhysHandiError, ValueError, OSError, RuntimeError):
        logger.exception("the live simulation could not be prepared")
