"""The object fit's view of one sequence: nodes, controls, observations and the loss.

`build_problem` reduces a sequence to an `ObjectProblem`; `mean_loss` simulates problems and
compares them with what was observed (physics.md §4.1).
"""

import math
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from physhandi.data.observation import ObjectObservation, thinned
from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.config import ObjectFitConfig
from physhandi.simulation.contact_intervals import ContactIntervals
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

TRACK_CARRIERS = 4
"""Nodes that carry one observed surface point."""
MOST_DISTANCES = 2**25
"""Most pairs of a point and a node whose distances are kept at a time on a GPU."""
SUBSTEP_SAFETY = 1.25
"""Factor by which the substeps exceed the stability limit."""


@dataclass(frozen=True, kw_only=True)
class ObjectProblem:
    """One sequence as tensors for the object fit."""

    name: str
    object_node: Float[ndarray, "node 3"]
    """Object nodes at frame 0 [m]."""
    rest_node: Float[ndarray, "node 3"]
    """The object's rest shape, which gives topology and rest lengths [m]."""
    control: Float[ndarray, "all_frame control 3"]
    """Positions of the control nodes, also in frames that are not fitted [m]."""
    hand_face: Int32[ndarray, "face 3"]
    """Triangles of the hands' surface, their corners control nodes; see `SpringMassModel`."""
    frame_rate: float
    """Frames a second [Hz]."""
    ground_height: float | None
    """Height of the ground plane; None without ground [m]."""
    gravity: float
    """Acceleration along -z [m/s²]."""
    initial_velocity: Float[ndarray, "node 3"]
    """Velocity of the object nodes at frame 0 [m/s]."""
    clearance: Float[ndarray, " node"]
    """Height above the ground at which each object node touches it [m]."""
    cloud: Float[Tensor, "frame point 3"]
    """Observed object points, padded [m]."""
    is_observed: Bool[Tensor, "frame point"]
    """False on padding."""
    track: Float[Tensor, "frame track 3"]
    """Observed tracks of the frames to fit [m]."""
    is_valid: Bool[Tensor, "frame track"]
    """Whether a track's motion is valid in a frame."""
    carrier: Int[Tensor, "track carrier"]
    """The nodes that carry each track."""
    carrier_weight: Float[Tensor, "track carrier"]
    """Weight of each carrier; rows sum to one."""
    track_offset: Float[Tensor, "track 3"]
    """Position of a track less the weighted mean of its carriers, at frame 0 [m]."""
    surface_count: int | None = None
    """Leading nodes that lie on the surface, which alone enter the Chamfer term; None for all."""
    contacts: ContactIntervals | None = None
    """Contacts of the hands over time; None for contact with all that is near them at frame 0."""

    @property
    def frame_count(self) -> int:
        """Number of frames to fit, frame 0 included."""
        return self.cloud.shape[0]

    def on(self, device: str) -> "ObjectProblem":
        """Copy what is compared with a simulation to a device, where its losses are computed."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(
            self, **{n: value.to(device) for n, value in tensors.items() if torch.is_tensor(value)}
        )

    def predict_tracks(self, node: Float[Tensor, "frame node 3"]) -> Float[Tensor, "frame track 3"]:
        """Carry the tracked surface points along with the nodes."""
        # A gradient that adds in parallel would have other bits every time. That of index_select on
        # a CPU is a sum in the order of the tracks, that of a matrix product on a GPU has an order.
        if node.is_cuda:
            matrix = node.new_zeros(len(self.carrier), node.shape[1])
            matrix = matrix.scatter_add(1, self.carrier, self.carrier_weight)
            return matrix @ node + self.track_offset
        carrier = node.index_select(1, self.carrier.flatten()).unflatten(1, self.carrier.shape)
        return (carrier * self.carrier_weight[..., None]).sum(dim=2) + self.track_offset

    def frame_losses(
        self,
        node: Float[Tensor, "frame node 3"],
        *,
        first_frame: int = 1,
        track_weight: float = 1.0,
        freeze_counts: bool = False,
    ) -> Float[Tensor, " frame"]:
        """Compare simulated nodes with the observations, frame by frame [m²].

        Args:
            node: Simulated nodes of the frames ``first_frame, first_frame + 1, …`` [m].
            first_frame: Frame of the first row of ``node``.
            track_weight: Weight of the track term beside the Chamfer term.
            freeze_counts: Divide by frame 1's counts in every frame, as PhysTwin does.

        Returns:
            Chamfer plus weighted track loss of each frame.
        """
        frames = slice(first_frame, first_frame + node.shape[0])
        cloud_count = track_count = None
        if freeze_counts:
            cloud_count = self.is_observed[1].sum().float().expand(node.shape[0])
            track_count = self.is_valid[1].sum().float().expand(node.shape[0])
        chamfer = chamfer_loss(
            self.cloud[frames],
            self.is_observed[frames],
            node[:, : self.surface_count],
            count=cloud_count,
        )
        track = track_loss(
            self.track[frames], self.is_valid[frames], self.predict_tracks(node), count=track_count
        )
        return chamfer + track_weight * track


def build_problem(
    *,
    name: str,
    observation: ObjectObservation,
    object_node: Float[ndarray, "node 3"],
    rest_node: Float[ndarray, "node 3"],
    control: Float[ndarray, "frame control 3"],
    hand_face: Int32[ndarray, "face 3"],
    frame_count: int,
    frame_rate: float,
    ground_height: float | None,
    gravity: float,
    clearance: Float[ndarray, " node"] | None = None,
    surface_count: int | None = None,
    chamfer_points: Literal["cloud", "tracks"] = "cloud",
    cloud_points: int | None = 300,
    starts_at_rest: bool = False,
    contacts: ContactIntervals | None = None,
) -> ObjectProblem:
    """Reduce a sequence to the tensors that the object fit reads.

    Args:
        name: Name of the sequence, for messages.
        observation: What was seen of the object.
        object_node: Object nodes at frame 0 [m].
        rest_node: The same nodes in the rest shape [m].
        control: Control node positions over all frames [m].
        hand_face: Triangles of the hands' surface, their corners control nodes; none if control
            nodes are no surface.
        frame_count: Frames to fit, counted from 0; later ones are never read.
        frame_rate: Frames a second [Hz].
        ground_height: Height of the ground; None without ground [m].
        gravity: Acceleration along -z [m/s²].
        clearance: Height above the ground at which each object node touches it [m]; 0 if left out.
        surface_count: Number of leading nodes that lie on the surface; None if unknown.
        chamfer_points: Whether the Chamfer term compares with the fused cloud or with the visible
            tracks.
        cloud_points: Most points of a frame that enter the Chamfer term; None for all.
        starts_at_rest: Whether the object rests at frame 0, whatever the tracks say.
        contacts: What the hands touch, and when; None for what is near them at frame 0, always.

    Returns:
        The problem, on the CPU.

    Raises:
        FitError: If there is nothing to compare the simulation with.
    """
    if frame_count < 2:
        raise FitError(
            f"Sequence '{name}' has {frame_count} frame to fit of {observation.frame_count}, but "
            "motion needs at least 2. Raise split.reconstruction in sequence.yaml, or give a "
            "longer recording."
        )
    clouds = observation.cloud or tuple(np.zeros((0, 3), np.float32) for _ in range(frame_count))
    if chamfer_points == "tracks":
        if not observation.is_visible.any():
            raise FitError(
                f"Sequence '{name}' has no tracks of the object, but chamfer_points is 'tracks': "
                "add markers or track.npy, or choose chamfer_points: cloud."
            )
        pairs = zip(observation.point, observation.is_visible, strict=True)
        clouds = tuple(point[is_visible] for point, is_visible in pairs)
    cloud, is_observed = _pad_clouds(clouds, frame_count, cloud_points)
    track, carrier, weight, offset = _carriers(observation, np.asarray(object_node, np.float32))
    is_there = np.isfinite(observation.point).all(axis=2)
    valid = (is_there & observation.is_motion_valid)[:frame_count, track]
    if not is_observed[1:].any() and not valid[1:].any():
        raise FitError(
            f"Sequence '{name}' shows the object in no frame after frame 0 of the {frame_count} to "
            "fit: there is nothing to compare a simulation with. Check its markers, "
            "or masks, depth and tracks."
        )
    velocity = np.zeros(np.shape(object_node), np.float32)
    if not starts_at_rest:
        velocity = initial_velocity(observation, object_node, frame_rate)
    return ObjectProblem(
        name=name,
        object_node=np.asarray(object_node, np.float32),
        rest_node=np.asarray(rest_node, np.float32),
        control=np.asarray(control, np.float32),
        hand_face=hand_face,
        frame_rate=frame_rate,
        ground_height=ground_height,
        gravity=gravity,
        initial_velocity=velocity,
        clearance=np.asarray(
            np.zeros(len(velocity)) if clearance is None else clearance, np.float32
        ),
        cloud=cloud,
        is_observed=is_observed,
        track=torch.from_numpy(np.asarray(observation.point[:frame_count, track], np.float32)),
        is_valid=torch.from_numpy(np.asarray(valid)),
        carrier=torch.from_numpy(carrier),
        carrier_weight=torch.from_numpy(weight),
        track_offset=torch.from_numpy(offset),
        surface_count=surface_count,
        contacts=contacts,
    )


def _pad_clouds(
    clouds: tuple[ndarray, ...], frame_count: int, most: int | None
) -> tuple[Float[Tensor, "frame point 3"], Bool[Tensor, "frame point"]]:
    picked = [thinned(cloud, most) for cloud in clouds[:frame_count]]
    width = max((len(points) for points in picked), default=0)
    padded = np.zeros((frame_count, width, 3), np.float32)
    real = np.zeros((frame_count, width), bool)
    for frame, points in enumerate(picked):
        padded[frame, : len(points)] = points
        real[frame, : len(points)] = True
    return torch.from_numpy(padded), torch.from_numpy(real)


def _carriers(
    observation: ObjectObservation, object_node: Float[ndarray, "node 3"]
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Attach each track to its own node, or to the nodes nearest to it in frame 0.

    Returns the indices of the attached tracks, then carriers, weights and offsets [m] of each.
    """
    if observation.node_of_track is not None:
        track = np.arange(observation.track_count)
        carrier = np.asarray(observation.node_of_track)[:, None].astype(np.int64)
        weight = np.ones((len(track), 1), np.float32)
        return track, carrier, weight, np.zeros((len(track), 3), np.float32)
    track = np.flatnonzero(observation.is_visible[0])
    start = np.asarray(observation.point[0, track], np.float32)
    return track, *attach(start, object_node)


def attach(
    point: Float[ndarray, "point 3"], node: Float[ndarray, "node 3"]
) -> tuple[
    Int[ndarray, "point carrier"], Float[ndarray, "point carrier"], Float[ndarray, "point 3"]
]:
    """Let each point be carried by the `TRACK_CARRIERS` nodes nearest to it.

    Returns:
        The nodes, nearest first; their weights, by inverse distance; and the point less their
        weighted mean [m].
    """
    count = min(TRACK_CARRIERS, len(node))
    distance, carrier = KDTree(node).query(point, k=count)
    distance, carrier = np.reshape(distance, (-1, count)), np.reshape(carrier, (-1, count))
    weight = 1.0 / (distance + 1e-4)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    offset = point - (node[carrier] * weight[..., None]).sum(axis=1)
    return carrier.astype(np.int64), weight, offset.astype(np.float32)


def initial_velocity(
    observation: ObjectObservation, object_node: Float[ndarray, "node 3"], frame_rate: float
) -> Float[ndarray, "node 3"]:
    """Estimate the velocity of every node at frame 0 [m/s].

    The velocity of identified points between the first two frames is interpolated over all nodes;
    without identified points the object starts at rest. Only frames 0 and 1 are read, so a
    prediction from frame 0 uses no later observation.
    """
    is_visible = observation.is_visible[:2].all(axis=0)
    if observation.node_of_track is None or not is_visible.any():
        return np.zeros(object_node.shape, np.float32)
    moved = (observation.point[1] - observation.point[0])[is_visible] * frame_rate
    count = min(2, int(is_visible.sum()))
    source = object_node[np.asarray(observation.node_of_track)[is_visible]]
    distance, near = KDTree(source).query(object_node, k=count)
    distance, near = np.reshape(distance, (-1, count)), np.reshape(near, (-1, count))
    weight = 1.0 / (distance + 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    return (moved[near] * weight[..., None]).sum(axis=1).astype(np.float32)


def chamfer_loss(
    observed: Float[Tensor, "frame point 3"],
    is_observed: Bool[Tensor, "frame point"],
    node: Float[Tensor, "frame node 3"],
    *,
    count: Float[Tensor, " frame"] | None = None,
) -> Float[Tensor, " frame"]:
    """Average the squared distance from observed points to the nearest node, one way [m²].

    The choice of the nearest node has no gradient (physics.md §4.1; PhysTwin's Chamfer term).

    Args:
        observed: Observed points, padded to one length [m].
        is_observed: False on padding.
        node: Simulated object nodes [m].
        count: Divisor of each frame; None takes its number of points.

    Returns:
        One value a frame; 0 where a frame has no points.
    """
    if node.is_cuda:
        # Whose gradient adds in a fixed order, unlike that of gather.
        nearest = _nearest_of_all(observed, node.detach())
        is_chosen = nearest[..., None] == torch.arange(node.shape[1], device=node.device)
        chosen = is_chosen.to(node.dtype) @ node
    else:
        nearest = _nearest(observed, is_observed, node)
        chosen = torch.gather(node, 1, nearest[..., None].expand(-1, -1, 3))
    squared = ((torch.nan_to_num(observed) - chosen) ** 2).sum(dim=2) * is_observed
    divisor = is_observed.sum(dim=1) if count is None else count
    return squared.sum(dim=1) / divisor.clamp(min=1)


def track_loss(
    observed: Float[Tensor, "frame track 3"],
    is_valid: Bool[Tensor, "frame track"],
    predicted: Float[Tensor, "frame track 3"],
    *,
    count: Float[Tensor, " frame"] | None = None,
) -> Float[Tensor, " frame"]:
    """Average the squared distance between observed and simulated tracks [m²].

    PhysTwin's smooth L1 with β = 1 m, averaged over coordinates, is one sixth of this value.

    Args:
        observed: Observed tracks [m].
        is_valid: Where a track can be trusted.
        predicted: The same surface points, carried by the simulated nodes [m].
        count: Divisor of each frame; None takes its number of valid tracks.

    Returns:
        One value a frame; 0 where a frame has no valid track.
    """
    squared = ((torch.nan_to_num(observed) - predicted) ** 2).sum(dim=2) * is_valid
    divisor = is_valid.sum(dim=1) if count is None else count
    return squared.sum(dim=1) / divisor.clamp(min=1)


def node_acceleration_loss(
    velocity: Float[Tensor, "frame node 3"],
) -> Float[Tensor, " frame"]:
    """Penalise second differences of the velocity, half-squared [m²/s²].

    PhysTwin's regulariser of the zeroth-order stage: smooth L1 with β = 1 of the difference of
    two successive velocity changes [m/s], averaged over nodes and coordinates. One value a frame,
    0 for the first two.
    """
    change = velocity[1:] - velocity[:-1]
    jerk = change[1:] - change[:-1]
    value = torch.nn.functional.smooth_l1_loss(jerk, torch.zeros_like(jerk), reduction="none")
    return torch.cat([velocity.new_zeros(2), value.mean(dim=(1, 2))])[: velocity.shape[0]]


def _nearest(
    observed: Float[Tensor, "frame point 3"],
    is_observed: Bool[Tensor, "frame point"],
    node: Float[Tensor, "frame node 3"],
) -> Int[Tensor, "frame point"]:
    """Find the nearest node of each observed point; a tree is faster than all pairs."""
    nearest = torch.zeros(is_observed.shape, dtype=torch.int64)
    for frame, nodes in enumerate(node.detach().cpu().numpy()):
        is_real = is_observed[frame].cpu()
        if len(nodes) and is_real.any():
            _, index = KDTree(nodes).query(observed[frame].cpu()[is_real].numpy())
            nearest[frame, is_real] = torch.from_numpy(index)
    return nearest.to(node.device)


def _nearest_of_all(
    observed: Float[Tensor, "frame point 3"], node: Float[Tensor, "frame node 3"]
) -> Int[Tensor, "frame point"]:
    """Find the nearest node of each observed point by comparing all, as a GPU does fastest."""
    frames = max(1, MOST_DISTANCES // max(1, observed.shape[1] * node.shape[1]))
    nearest = []
    for points, nodes in zip(observed.split(frames), node.split(frames), strict=True):
        squared = (points[..., :1] - nodes[..., 0, None].mT) ** 2
        for axis in (1, 2):
            squared += (points[..., axis, None] - nodes[..., axis, None].mT) ** 2
        nearest.append(squared.argmin(dim=2))
    return torch.cat(nearest)


def problem_parameters(
    parameters: SimulationParameters, problem: ObjectProblem
) -> SimulationParameters:
    """Fill in frame rate, ground and gravity of one sequence (`SimulationParameters.in_world`)."""
    return parameters.in_world(
        frame_rate=problem.frame_rate,
        ground_height=problem.ground_height,
        gravity=problem.gravity,
    )


def build_problem_model(
    problem: ObjectProblem, parameters: SimulationParameters
) -> SpringMassModel:
    """Connect the object's nodes and attach the control nodes of frame 0."""
    model = build_model(
        problem.object_node,
        problem.control[0],
        problem_parameters(parameters, problem),
        rest_node=problem.rest_node,
        contacts=problem.contacts,
    )
    return replace(
        model,
        initial_velocity=problem.initial_velocity,
        clearance=problem.clearance,
        hand_face=problem.hand_face,
    )


def simulate_problem(
    problem: ObjectProblem, model: SpringMassModel, parameters: SimulationParameters, device: str
) -> tuple[Float[Tensor, "frame node 3"], Float[Tensor, "frame node 3"]]:
    """Simulate the frames to fit; returns positions [m] and velocities [m/s]."""
    return rollout_in(Simulator(model, problem_parameters(parameters, problem), device), problem)


def rollout_in(
    simulator: Simulator, problem: ObjectProblem
) -> tuple[Float[Tensor, "frame node 3"], Float[Tensor, "frame node 3"]]:
    """Simulate the frames to fit in a simulator of the problem's; see `simulate_problem`."""
    rollout = simulator.rollout(problem.control[: problem.frame_count])
    return torch.from_numpy(rollout.position), torch.from_numpy(rollout.velocity)


def mean_loss(
    problems: Many[ObjectProblem],
    models: dict[str, SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    device: str,
    *,
    acceleration_weight: float = 0.0,
    on_rollout: Callable[[ObjectProblem, Float[Tensor, "frame node 3"]], None] | None = None,
) -> float:
    """Simulate every sequence and average its frame losses; infinite if one diverges [m²].

    The mean is over the frames 1, 2, … to fit (physics.md §4.1); frame 0 is the initial state.
    `on_rollout` receives each simulated motion [m].
    """

    def simulate(problem: ObjectProblem) -> tuple[Tensor, Tensor]:
        return simulate_problem(problem, models[problem.name], parameters, device)

    return mean_loss_of(
        problems,
        simulate,
        config,
        acceleration_weight=acceleration_weight,
        on_rollout=on_rollout,
    )


def mean_loss_of(
    problems: Many[ObjectProblem],
    simulate: Callable[[ObjectProblem], tuple[Tensor, Tensor]],
    config: ObjectFitConfig,
    *,
    acceleration_weight: float = 0.0,
    on_rollout: Callable[[ObjectProblem, Float[Tensor, "frame node 3"]], None] | None = None,
) -> float:
    """Average the frame losses of rollouts as `mean_loss` does, however they are simulated [m²].

    `simulate` gives what `simulate_problem` gives.
    """
    losses = []
    for problem in problems:
        try:
            node, velocity = simulate(problem)
        except SimulationDivergedError:
            return math.inf
        node, velocity = (state.to(problem.cloud.device) for state in (node, velocity))
        if on_rollout is not None:
            on_rollout(problem, node)
        frame_losses = problem.frame_losses(
            node[1:], track_weight=config.track_weight, freeze_counts=config.freezes_counts
        )
        if acceleration_weight > 0.0:
            frame_losses = frame_losses + acceleration_weight * node_acceleration_loss(velocity)[1:]
        losses.append(float(frame_losses.mean()))
    return float(np.mean(losses))


def settle_substeps(
    models: Many[SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    *,
    safety: float = SUBSTEP_SAFETY,
) -> SimulationParameters:
    """Choose substeps that keep all models stable, if the configuration sets them automatically.

    Near the limit a simulation may stay bounded and still be noise: without the margin a search
    finds parameters whose gradients are useless.
    """
    if not config.automatic_substeps:
        return parameters
    needed = max(stable_substeps(model, parameters, safety=safety) for model in models)
    return with_substeps(parameters, needed)


def with_substeps(parameters: SimulationParameters, needed: int) -> SimulationParameters:
    """Give parameters the least round number of substeps that is not below what is needed."""
    return parameters.replace(substeps_per_frame=10 * math.ceil(needed / 10))
