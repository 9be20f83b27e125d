"""The object's state in the last observed frame, from which prediction starts.

A fit leaves residuals, and a simulation of later frames carries them along. The nodes are shifted
to where the tracks were seen; where the springs go on from is said in `simulation.restart`.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError, SimulationDivergedError
from physhandi.metrics.baselines import last_residual
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart, rests_on
from physhandi.simulation.simulator import Rollout, Simulator

VELOCITY_FRAMES = 3
"""Last frames over which the velocity is averaged. Over two of them the noise of tracks would be
twice as large; the more there are, the farther it lags behind a motion that changes."""
FEWEST_LYING = 0.1
"""Part of the nodes that has to lie on the ground for its sliding to tell something."""
SLIDING = 0.0125
"""Least speed at which what lies is taken to slide [m/s]; tracks of toys that stand still, whose
few lying nodes are seen from above, move by up to 0.01."""
STUCK, STUCK_TIME = 0.25, 0.5
"""What lies is stuck if it would go on by less than this part of the way that was seen, and has not
been faster for so long [s]: what is pushed sticks and slips."""
LEAST_FRICTION = 1.0 / 32.0
"""Least part of the friction that is left."""
FRICTION_HALVINGS = 6
"""How often the interval between the least part and all of it is halved, on a logarithmic scale."""


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
    keeps_sliding: bool = False,
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
        control: Control nodes in every frame [m]; of those after `frame`, `VELOCITY_FRAMES` tell
            whether what slides goes on.
        observation: What was seen; only frame 0, the frame itself and those before it are read.
        frame: The frame.
        device: Warp device.
        strain_time: Time until the frame over which the strain of springs in the air is
            averaged [s].
        grip_strength: How many times the object's weight all virtual springs that act in the frame
            pull together when each of them slips; 0 if none ever does.
        keeps_sliding: Whether less friction is left where what lies on the ground was seen to slide
            and would be stuck: as much as it goes on with as fast as it was seen.

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
    restart = Restart(
        frame=frame,
        position=position.astype(np.float32),
        velocity=velocity.astype(np.float32),
        strain_frames=max(1, round(strain_time * parameters.simulated_frame_rate)),
        averages_in_air=True,
        shifts_nodes=True,
        grip_strength=_limit(grip_strength, model, parameters, frame),
    )
    if not keeps_sliding:
        return restart
    share = _friction_share(Simulator(model, parameters, device), restart, motion.position, control)
    return replace(restart, friction_share=share)


def _limit(
    strength: float, model: SpringMassModel, parameters: SimulationParameters, frame: int
) -> float:
    """Share some times the object's weight among the virtual springs that act in a frame [N]."""
    weight = model.node_count * max(parameters.gravity, 0.0)  # A node weighs 1 kg.
    springs = np.count_nonzero(model.acts_in(frame)[model.object_spring_count :])
    return float(np.float32(strength * weight / max(springs, 1)))


def _friction_share(
    simulator: Simulator,
    restart: Restart,
    position: Float[ndarray, "before node 3"],
    control: Float[ndarray, "frame control 3"],
) -> float:
    """Find how much friction is left if what lies slides on as fast as it was seen to.

    Fitted frames in which it lies still are explained by any friction that is large enough, so a
    fit takes one that may be far too large for what follows. A part with which the motion runs away
    counts as too small.

    Args:
        simulator: Simulates the object; its state is replaced.
        restart: The observed state.
        position: The rollout's own nodes up to its frame [m].
        control: Control nodes; those of the next `VELOCITY_FRAMES` frames tell the way.

    Returns:
        The part of the friction that is left, `LEAST_FRICTION` to 1; 1 where nothing slides, or
        slides on by itself.
    """
    frame, rate = restart.frame, simulator.parameters.simulated_frame_rate
    lies = rests_on(simulator.model, simulator.parameters.ground_height, position[frame])
    ahead = control[frame : frame + VELOCITY_FRAMES + 1]
    if lies.mean() < FEWEST_LYING or len(ahead) < 2:
        return 1.0
    velocity = restart.velocity[lies].mean(axis=0, dtype=np.float64)[:2]
    speed = np.linalg.norm(velocity)
    # The mean of a part that lies still is that of its tracks' few worst errors.
    if speed < SLIDING or np.median(restart.velocity[lies, :2] @ velocity) < SLIDING * speed:
        return 1.0
    since = max(0, frame - round(STUCK_TIME * rate))
    way = (position[frame] - position[since])[lies].mean(axis=0, dtype=np.float64)[:2]
    if way @ velocity >= STUCK * speed**2 * (frame - since) / rate:
        return 1.0
    strained = restart.strained_frames

    def slides(share: float) -> float:
        less = replace(restart, friction_share=share)
        simulator.continue_from(less, position[strained], control[strained])
        try:
            for number, (start, end) in enumerate(pairwise(ahead), frame + 1):
                simulator.step_frame(number, start, end)
        except SimulationDivergedError:
            return np.inf
        way = (simulator.position.numpy() - position[frame])[lies].mean(axis=0)[:2]
        return float(way @ velocity / speed**2 * rate / (len(ahead) - 1))

    if slides(1.0) >= STUCK:
        return 1.0
    fastest = slides(LEAST_FRICTION)
    if fastest <= 1.0:  # If it hardly slides even so, it is not friction that holds it.
        return LEAST_FRICTION if fastest >= STUCK else 1.0
    low, high = np.log(LEAST_FRICTION), 0.0
    for _ in range(FRICTION_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slides(float(np.exp(middle))) > 1.0 else (low, middle)
    return float(np.float32(np.exp(0.5 * (low + high))))


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
