"""The object's state in the last observed frame, from which prediction starts.

A fit leaves residuals, and a simulation of later frames carries them along. The nodes are shifted
to where the tracks were seen; where the springs go on from is said in `simulation.restart`.
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
from physhandi.simulation.simulator import Rollout, Simulator

VELOCITY_FRAMES = 3
"""Last frames over which the velocity is averaged. Over two of them the noise of tracks would be
twice as large; the more there are, the farther it lags behind a motion that changes."""


def observed_state(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "frame control 3"],
    observation: ObjectObservation,
    frame: int,
    *,
    device: str = "cpu",
    strain_time: float = 0.0,
    grip_strength: float = 0.0,
) -> Restart:
    """Estimate position and velocity of the nodes in a frame.

    Each node is moved by the mean residual of the tracks around it, or by that of its own where
    tracks say which node they observe (`metrics.baselines.last_residual`), but not below the
    ground. Its velocity is that of the line that fits best to where it was seen, found in the same
    way, in the last `VELOCITY_FRAMES` frames: springs of a rollout swing about the true motion, and
    their velocity is less sure than no velocity at all. It is the rollout's if the frame before
    shows no track.

    Args:
        model: Fitted nodes and springs.
        parameters: Fitted parameters, in the world of the sequence.
        control: Control nodes in every frame [m].
        observation: What was seen; only frame 0, the frame itself and those before it are read.
        frame: The frame.
        device: Warp device.
        strain_time: Time until the frame over which the strain of springs in the air is
            averaged [s].
        grip_strength: How many times the object's weight all virtual springs that act in the frame
            pull together when each of them slips; 0 if none ever does.

    Raises:
        MissingInputError: If the frame shows no track whose place on the object is known.
        SimulationDivergedError: If the motion runs away before the frame.
    """
    motion = Simulator(model, parameters, device).rollout(control[: frame + 1])
    try:
        position = _seen(motion, observation, frame)
    except ValueError as error:
        raise MissingInputError(f"{error}.") from error
    velocity = _seen_velocity(motion, observation, frame, parameters.simulated_frame_rate)
    if parameters.ground_height is not None:
        position[:, 2] = np.maximum(position[:, 2], parameters.ground_height)
    return Restart(
        frame=frame,
        position=position.astype(np.float32),
        velocity=velocity.astype(np.float32),
        strain_frames=max(1, round(strain_time * parameters.simulated_frame_rate)),
        averages_in_air=True,
        shifts_nodes=True,
        grip_strength=_limit(grip_strength, model, parameters, frame),
    )


def _limit(
    strength: float, model: SpringMassModel, parameters: SimulationParameters, frame: int
) -> float:
    """Share some times the object's weight among the virtual springs that act in a frame [N]."""
    weight = model.node_count * max(parameters.gravity, 0.0)  # A node weighs 1 kg.
    springs = np.count_nonzero(model.acts_in(frame)[model.object_spring_count :])
    return float(np.float32(strength * weight / max(springs, 1)))


def _seen(motion: Rollout, observation: ObjectObservation, frame: int) -> Float[ndarray, "node 3"]:
    """Move the nodes of a frame to where the tracks were seen [m]."""
    own = motion.position[frame]
    return own + last_residual(
        motion.position[0],
        own,
        observation.point,
        observation.is_visible,
        frame,
        observation.node_of_track,
    )


def _seen_velocity(
    motion: Rollout,
    observation: ObjectObservation,
    last: int,
    frame_rate: float,
) -> Float[ndarray, "node 3"]:
    """Fit a line to where each node was seen in the last frames; its slope [m/s]."""
    first = last
    while first > max(0, last + 1 - VELOCITY_FRAMES) and _shows_tracks(observation, first - 1):
        first -= 1
    if first == last:
        return motion.velocity[last]
    frames = np.arange(first, last + 1)
    seen = np.stack([_seen(motion, observation, int(frame)) for frame in frames])
    time = (frames - frames.mean()) / frame_rate
    return np.tensordot(time, seen, axes=1) / (time**2).sum()


def _shows_tracks(observation: ObjectObservation, frame: int) -> bool:
    """Whether a frame shows a track whose place on the object is known."""
    visible = observation.is_visible
    return bool((visible[frame] & (visible[0] | (observation.node_of_track is not None))).any())
