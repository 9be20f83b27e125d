"""The object's state in the last observed frame, from which prediction starts.

A fit leaves residuals, and a simulation of later frames carries them along. The nodes are moved to
where the tracks were seen instead; how the springs are kept from pulling them back is said in
`simulation.restart`.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError
from physhandi.metrics.baselines import last_residual
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Simulator


def observed_state(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "frame control 3"],
    observation: ObjectObservation,
    frame: int,
    *,
    device: str = "cpu",
) -> Restart:
    """Estimate position and velocity of the nodes in a frame.

    Each node is moved by the residual of the tracks around it (`metrics.baselines.last_residual`),
    but not deeper than where it touches the ground. The velocity is the rollout's: it belongs to
    the motion of the hands that goes on, and differences of noisy tracks would change little but
    add their noise.

    Args:
        model: Fitted nodes and springs.
        parameters: Fitted parameters, in the world of the sequence.
        control: Control nodes in every frame [m].
        observation: What was seen; only frame 0 and the frame itself are read.
        frame: The frame.
        device: Warp device.

    Raises:
        MissingInputError: If the frame shows no track whose place on the object is known.
        SimulationDivergedError: If the motion runs away before the frame.
    """
    motion = Simulator(model, parameters, device).rollout(control[: frame + 1])
    own = motion.position[frame]
    try:
        shift = last_residual(
            motion.position[0],
            own,
            observation.point,
            observation.is_visible,
            frame,
            observation.node_of_track,
        )
    except ValueError as error:
        raise MissingInputError(f"{error}.") from error
    position = own + shift
    if parameters.ground_height is not None:
        position[:, 2] = np.maximum(position[:, 2], parameters.ground_height + model.clearance)
    return Restart(
        frame=frame,
        position=position.astype(np.float32),
        velocity=motion.velocity[frame].copy(),
    )
