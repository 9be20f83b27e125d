"""The object's state in the last observed frame, from which prediction starts.

A fit leaves residuals, and a simulation of later frames carries them along. The nodes are moved to
where the tracks were seen instead; how the springs are kept from pulling them back is said in
`simulation.restart`.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError
from physhandi.metrics.alignment import CARRIERS
from physhandi.metrics.baselines import last_residual, track_residuals
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Rollout, Simulator

VELOCITY_FRAMES = 3
"""Last frames over which the velocity is averaged. Over two of them the noise of tracks would be
twice as large; the more there are, the farther it lags behind a motion that changes."""

TRACK_WIDTH = 0.375
"""Least standard deviation of the Gaussian by which tracks around a node are weighted [least
distance between two nodes]. What is left of their noise becomes a part of the rest lengths, as if
the object were crumpled; the wider it is, the more bends are smoothed away."""
_HIDDEN = 0.5
"""Distance from the nearest track beyond which none shows a node [least distance between two]."""
MOST_TRACKS_AROUND = 60
"""Most tracks whose mean a node takes, the nearest."""


def observed_state(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "frame control 3"],
    observation: ObjectObservation,
    frame: int,
    *,
    device: str = "cpu",
    moves_hands: bool = False,
    strain_time: float = 0.0,
) -> Restart:
    """Estimate position and velocity of the nodes in a frame.

    Each node is moved by the mean residual of the tracks around it, weighted by a Gaussian of their
    distances in frame 0, but not deeper than where it touches the ground. A node that a hand holds
    and that no track shows counts as seen where the rollout has it, since the hand was seen. Where
    tracks say which node they observe, each node takes its own
    (`metrics.baselines.last_residual`). Its velocity is that of the line that fits best
    to where it was seen, found in the same way, in the last `VELOCITY_FRAMES` frames: springs of a
    rollout swing about the true motion, and their velocity is less sure than no velocity at all. It
    is the rollout's if the frame before shows no track.

    Args:
        model: Fitted nodes and springs.
        parameters: Fitted parameters, in the world of the sequence.
        control: Control nodes in every frame [m].
        observation: What was seen; only frame 0, the frame itself and those before it are read.
        frame: The frame.
        device: Warp device.
        moves_hands: Whether hands go on where what they hold was seen (`Restart.moves_hands`).
        strain_time: Time until the frame over which the strain of springs is averaged [s].

    Raises:
        MissingInputError: If the frame shows no track whose place on the object is known.
        SimulationDivergedError: If the motion runs away before the frame.
    """
    motion = Simulator(model, parameters, device).rollout(control[: frame + 1])
    try:
        position = _seen(model, motion, observation, frame)
    except ValueError as error:
        raise MissingInputError(f"{error}.") from error
    velocity = _seen_velocity(model, motion, observation, frame, parameters.simulated_frame_rate)
    if parameters.ground_height is not None:
        position[:, 2] = np.maximum(position[:, 2], parameters.ground_height + model.clearance)
    return Restart(
        frame=frame,
        position=position.astype(np.float32),
        velocity=velocity.astype(np.float32),
        moves_hands=moves_hands,
        eases_grips=True,
        strain_frames=max(1, round(strain_time * parameters.simulated_frame_rate)),
    )


def _seen(
    model: SpringMassModel, motion: Rollout, observation: ObjectObservation, frame: int
) -> Float[ndarray, "node 3"]:
    """Move the nodes of a frame to where the tracks were seen [m]."""
    start, own = motion.position[0].astype(np.float64), motion.position[frame]
    seen = observation.point, observation.is_visible, frame
    if observation.node_of_track is not None:
        return own + last_residual(start, own, *seen, observation.node_of_track)
    place, residual = track_residuals(start, own, *seen)
    nodes: Any = KDTree(start)
    spacing = float(nodes.query(start, k=[min(2, len(start))])[0].min())
    acts = model.acts_in(frame)[model.object_spring_count :]
    held = np.unique(model.spring_nodes[model.object_spring_count :][acts].min(axis=1))
    shown: Any = KDTree(place)
    hidden = start[held[shown.query(start[held])[0] > _HIDDEN * spacing]]
    place = np.concatenate([place, hidden])
    residual = np.concatenate([residual, np.zeros_like(hidden)])
    return own + _smoothed(start, place, residual, TRACK_WIDTH * spacing)


def _smoothed(
    node: Float[ndarray, "node 3"],
    place: Float[ndarray, "place 3"],
    value: Float[ndarray, "place 3"],
    width: float,
) -> Float[ndarray, "node 3"]:
    """Give each node the mean of the values around it, weighted by a Gaussian of the distance.

    Args:
        node: Where the mean is wanted [m].
        place: Where values are known [m].
        value: These values.
        width: Least standard deviation of the Gaussian [m]. Where places are few it is half the
            distance of the eighth nearest, about what places are apart on a surface.
    """
    tree: Any = KDTree(place)
    count = min(MOST_TRACKS_AROUND, len(place))
    distance, near = (np.reshape(each, (-1, count)) for each in tree.query(node, k=count))
    apart = 0.5 * distance[:, min(CARRIERS, count) - 1]
    weight = np.exp(-0.5 * (distance / np.maximum(width, apart)[:, None]) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nc,nci->ni", weight, value[near])


def _seen_velocity(
    model: SpringMassModel,
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
    seen = np.stack([_seen(model, motion, observation, int(frame)) for frame in frames])
    time = (frames - frames.mean()) / frame_rate
    return np.tensordot(time, seen, axes=1) / (time**2).sum()


def _shows_tracks(observation: ObjectObservation, frame: int) -> bool:
    """Whether a frame shows a track whose place on the object is known."""
    visible = observation.is_visible
    return bool((visible[frame] & (visible[0] | (observation.node_of_track is not None))).any())
