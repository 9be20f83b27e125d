"""Stage 3: corrects the hands so that the object they move follows its observed motion.

`refine_hands` owns the loop, `Refinement` the loss and its gradient, `HandOffsets` the corrections
of one hand and `OffsetDescent` their optimizer. Paper, section 3.3 ("Hand Refinement") and its
supplement; physics.md §9 and §10.9-10.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.data.checkpoint import Checkpointer, resumed_note
from physhandi.errors import SimulationDivergedError
from physhandi.fitting.config import RefinementConfig as RefinementConfig
from physhandi.fitting.hands.losses import reprojection_loss
from physhandi.fitting.hands.observed import KeypointTarget
from physhandi.fitting.object_problem import ObjectProblem, problem_parameters
from physhandi.fitting.preview import RolloutPreview
from physhandi.hand.model import HandModel, HandPose
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.hand.rotation import rotation_matrix
from physhandi.one_thread import one_thread
from physhandi.progress import Progress
from physhandi.simulation import differentiable
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

Offset = dict[str, Tensor]
"""A correction of one hand, frames first: of its joints (``articulation``, added to their rotation
vectors [rad]), of the wrist's ``rotation`` (in the hand's own frame [rad]) and of its
``translation`` [m]."""
BETA_1 = 0.9
"""Decay of Adam's first moment."""
FLAT_GRADIENT = 1e-12
"""Adam's ε: change of the loss by one step below which the step shrinks [m²]."""
WEAK_FRAME = 1e-3
"""Share of the steepest frame's gradient below which a frame's step shrinks with its gradient."""
REFINEMENT_STAGE = "hand_refinement"
STEEPEST = 50.0
"""Gradients steeper than this many times that of an object tied rigidly to the hand count as
chaotic."""
HALVINGS = 4
"""Attempts to simulate a correction that diverges in later frames, each half as large."""
DOUBT = 3.0
"""Keypoint errors beyond this many expected errors lose their pull (Cauchy's loss)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinementProblem:
    """The hands of one sequence, and the fitted object that they move."""

    object_: ObjectProblem
    """Observations of the object in the frames to fit, none of later frames."""
    model: SpringMassModel
    """The fitted springs, virtual springs included; they are not changed."""
    parameters: SimulationParameters
    """The global parameters of the object."""
    motions: tuple[HandMotion, ...]
    """Hands of stage 1 over all frames, in the order of the control nodes."""
    hand_models: tuple[HandModel, ...]
    """Model of each hand."""
    chosen: Int[ndarray, " control"] | None = None
    """Indices of control nodes among the vertices of all hands; None for all."""
    targets: tuple[KeypointTarget, ...] = ()
    """Keypoints of each hand in the frames to fit; empty for no keypoint term."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedHands:
    """The result of stage 3 for one sequence."""

    motions: tuple[HandMotion, ...]
    """Corrected motion of each hand over all frames."""
    control: Float[ndarray, "all_frame control 3"]
    """Control nodes of the corrected hands [m]."""
    loss_before: float
    """Mean frame loss with the hands of stage 1 [m²]."""
    loss_after: float
    """Mean frame loss with the corrected hands, simulated from the stored result [m²]."""
    curve: list[list[float]]
    """Iteration and mean frame loss."""


@one_thread()
def refine_hands(
    problem: RefinementProblem,
    config: RefinementConfig,
    progress: Progress,
    *,
    device: str = "cpu",
    checkpointer: Checkpointer | None = None,
) -> RefinedHands:
    """Correct the poses of the hands by gradient descent through the simulator.

    Minimises the mean frame loss of the object's simulated motion over articulation, wrist
    rotation and wrist position in all frames to fit; shape, scale and the object do not change.
    Only vertices near a virtual spring act on the object; the rest of the hand follows because
    a frame takes one step as a whole (`OffsetDescent`) and is tied to stage 1.

    The virtual springs keep the rest lengths of stage 2, so a correction of frame 0 moves the hand
    *relative to* the object, which the loss sees. With springs rebuilt at every step, a correction
    common to all frames would have no effect and could not be found. Conversely, an error common
    to all frames when stage 2 built the springs has become part of the object and remains.

    Args:
        problem: Hands, object and observations.
        config: Settings of the stage.
        progress: Receives a report each iteration.
        device: Warp device.
        checkpointer: Keeps the state after an iteration; None keeps nothing.

    Returns:
        The best correction; the hands of stage 1 if none explains the object better.

    Raises:
        SimulationDivergedError: If the object diverges with the hands of stage 1 already.
        CancelledError: If the user asked to stop.
    """
    refinement = Refinement(problem, config, device)
    preview = RolloutPreview(REFINEMENT_STAGE, progress)
    curve: list[list[float]] = []

    def state() -> dict[str, ndarray]:
        return refinement.state() | {"curve": np.array(curve, np.float64).reshape(-1, 2)}

    checkpointer, first = checkpointer or Checkpointer(), 0
    loop = f"{REFINEMENT_STAGE}.{problem.object_.name}"
    resumed = checkpointer.load(loop, state(), growing=("curve",))
    if resumed is not None:
        first, curve = resumed.iteration, resumed.tensors["curve"].tolist()
        refinement.restore(resumed.tensors)
        note = resumed_note(first)
        progress.report(REFINEMENT_STAGE, first, config.iterations, None, note)
    for iteration in range(first, config.iterations + 1):
        progress.check_cancelled()
        message = ""
        try:
            loss = refinement.evaluate()
        except SimulationDivergedError as error:
            if not curve:
                raise
            message = f"step halved: {error}"
            loss = refinement.go_back()
        curve.append([float(iteration), loss])
        progress.report(REFINEMENT_STAGE, iteration, config.iterations, loss, message)
        if refinement.simulated is not None:
            preview.update(problem.object_, *refinement.simulated)
            preview.show(loss)
        if iteration < config.iterations:
            refinement.step()
            checkpointer.offer(loop, iteration + 1, state)
    return refinement.result(curve, progress)


class Refinement:
    """The corrections of all hands, their gradient, and the best of them so far."""

    def __init__(self, problem: RefinementProblem, config: RefinementConfig, device: str) -> None:
        self.problem = problem
        self.config = config
        self.device = device
        self.parameters = problem_parameters(problem.parameters, problem.object_)
        self.hands = [
            HandOffsets(motion, model, problem.object_.frame_count)
            for motion, model in zip(problem.motions, problem.hand_models, strict=True)
        ]
        self.reach = config.window or problem.object_.frame_count
        self.rate = 1.0
        self.first_loss: float | None = None
        self.best = [hand.copy() for hand in self.hands]
        self.best_total = np.inf
        self.simulated: tuple[Tensor, Tensor] | None = None
        """Object nodes and control nodes of the latest evaluation."""
        self._begin_descent()

    def evaluate(self) -> float:
        """Simulate, update the best correction, and compute the gradient of the corrections.

        Returns:
            Mean frame loss [m²].

        Raises:
            SimulationDivergedError: If the simulation diverges.
        """
        poses = [hand.pose() for hand in self.hands]
        control = control_nodes([pose.vertex for pose in poses], self.problem.chosen)
        loss, pull = self._pull_of_object(control.detach())
        ties = torch.stack([self._ties(number, pose) for number, pose in enumerate(poses)]).sum()
        total = loss + float(ties.detach())
        self.first_loss = loss if self.first_loss is None else self.first_loss
        if total < self.best_total and loss <= self.first_loss:
            self.best_total = total
            self.best = [hand.copy() for hand in self.hands]
        for hand in self.hands:
            hand.forget_gradient()
        ((control * pull).sum() + ties).backward()
        return loss

    def state(self) -> dict[str, ndarray]:
        """Copy everything that the next iterations depend on, as it is after a step."""
        first = np.nan if self.first_loss is None else self.first_loss
        state: dict[str, ndarray] = {
            "reach": np.array([self.reach]),
            "rate": np.array([self.rate]),
            "losses": np.array([first, self.best_total], np.float64),
        }
        for number, (descent, best) in enumerate(zip(self.descents, self.best, strict=True)):
            state[f"{number}.count"] = np.array([descent.count])
            parts = {"value": descent.hand.value, "best": best}
            parts |= {"first": descent.first, "second": descent.second}
            for part, tensors in parts.items():
                for name, tensor in tensors.items():
                    state[f"{number}.{part}.{name}"] = tensor.detach().numpy().copy()
        return state

    def restore(self, state: Mapping[str, ndarray]) -> None:
        """Return to what `state` gave."""
        self.reach, self.rate = int(state["reach"][0]), float(state["rate"][0])
        first, self.best_total = state["losses"].tolist()
        self.first_loss = None if np.isnan(first) else first
        for number, (descent, best) in enumerate(zip(self.descents, self.best, strict=True)):
            descent.count = int(state[f"{number}.count"][0])
            parts = {"value": descent.hand.value, "best": best}
            parts |= {"first": descent.first, "second": descent.second}
            with torch.no_grad():
                for part, tensors in parts.items():
                    for name, tensor in tensors.items():
                        tensor.copy_(torch.from_numpy(state[f"{number}.{part}.{name}"]))

    def step(self) -> None:
        """Update the corrections along the gradient and decay the step."""
        for descent in self.descents:
            descent.step(self.rate)
        self.rate *= self.config.decay

    def go_back(self) -> float:
        """Return to the best correction and continue from it with half the step."""
        self._restore(1.0)
        self.rate /= 2
        self._begin_descent()
        return self.evaluate()

    def result(self, curve: list[list[float]], progress: Progress) -> RefinedHands:
        """Simulate the best correction over all frames; halve it while it diverges, then drop it.

        A correction that does not lower the loss is dropped too.
        """
        before = curve[0][1]
        motions, after = self.problem.motions, before
        for halving in range(HALVINGS):
            self._restore(0.5**halving)
            carried = self.config.carry_time * self.problem.object_.frame_rate
            refined = tuple(hand.motion(carried) for hand in self.hands)
            try:
                loss = self._simulated_loss(self._control(refined))
            except SimulationDivergedError as error:
                total = self.config.iterations
                progress.report(REFINEMENT_STAGE, total, total, None, f"correction halved: {error}")
                continue
            if loss < before:
                motions, after = refined, loss
            break
        return RefinedHands(
            motions=motions,
            control=self._control(motions),
            loss_before=before,
            loss_after=after,
            curve=curve,
        )

    def _begin_descent(self) -> None:
        config = self.config
        self.descents = [
            OffsetDescent(hand, config.rates, config.beta_2, by_parameter=config.steps_by_parameter)
            for hand in self.hands
        ]

    def _pull_of_object(
        self, control: Float[Tensor, "frame control 3"]
    ) -> tuple[float, Float[Tensor, "frame control 3"]]:
        """Compute the mean frame loss [m²] and its gradient by the control nodes [m].

        Where motion is chaotic, the gradient grows without bound with the frames that it reaches
        back over; the reach is then halved for this and all later evaluations.
        """
        while True:
            moved = control.clone().requires_grad_()
            node, _ = differentiable.rollout(
                self.problem.model, self.parameters, moved, device=self.device, window=self.reach
            )
            self.simulated = node.detach(), control
            loss = self._object_loss(node)
            (pull,) = torch.autograd.grad(loss, moved, allow_unused=True)
            pull = torch.zeros_like(moved) if pull is None else pull
            steepness = float(pull.double().sum(dim=1).norm())
            is_sane = steepness <= STEEPEST * float(loss.detach()) ** 0.5
            if is_sane or self.reach == 1:
                return float(loss.detach()), torch.nan_to_num(pull)
            self.reach = max(1, self.reach // 2)

    def _object_loss(self, node: Float[Tensor, "frame node 3"]) -> Float[Tensor, ""]:
        object_ = self.problem.object_
        return object_.frame_losses(node[1:], track_weight=self.config.track_weight).mean()

    def _ties(self, number: int, pose: HandPose) -> Float[Tensor, ""]:
        """Sum one hand's weighted priors: distance to stage 1, smoothness, keypoints [m²]."""
        config = self.config
        moved = self.hands[number].displacement(pose)
        change = moved[1:] - moved[:-1]
        total = config.prior_weight * (moved**2).sum(-1).mean()
        total = total + config.smoothness_weight * (change**2).sum(-1).mean()
        if self.problem.targets and config.keypoint_weight > 0:
            keypoint_loss = reprojection_loss(pose.keypoint, self.problem.targets[number], DOUBT)
            total = total + config.keypoint_weight * keypoint_loss
        return total

    def _control(self, motions: tuple[HandMotion, ...]) -> Float[ndarray, "frame control 3"]:
        control = control_trajectory(motions, self.problem.hand_models)
        return control if self.problem.chosen is None else control[:, self.problem.chosen]

    def _simulated_loss(self, control: Float[ndarray, "frame control 3"]) -> float:
        """Simulate all frames as an evaluation does; return the loss of the fitted ones [m²]."""
        rollout = Simulator(self.problem.model, self.parameters, self.device).rollout(control)
        node = torch.from_numpy(rollout.position[: self.problem.object_.frame_count])
        return float(self._object_loss(node))

    def _restore(self, share: float) -> None:
        for hand, offset in zip(self.hands, self.best, strict=True):
            hand.restore({name: share * value for name, value in offset.items()})


class HandOffsets:
    """Corrections of one hand in the frames to fit; zero is the hand of stage 1."""

    def __init__(self, motion: HandMotion, model: HandModel, frame_count: int) -> None:
        """Start from zero.

        Args:
            motion: The hand of stage 1 over all frames.
            model: Model of that hand.
            frame_count: Frames to correct, counted from 0.
        """
        self.before = motion
        self.model = model
        self.frame_count = frame_count
        shapes = {"articulation": (15, 3), "rotation": (3,), "translation": (3,)}
        self.value: Offset = {
            name: torch.zeros(frame_count, *shape, requires_grad=True)
            for name, shape in shapes.items()
        }
        self._shape = _tensor(motion.shape)
        self._articulation = _tensor(motion.articulation[:frame_count])
        self._rotation = rotation_matrix(_tensor(motion.wrist_rotation[:frame_count]))
        self._translation = _tensor(motion.wrist_translation[:frame_count])
        with torch.no_grad():
            self._vertex = self.pose().vertex

    def pose(self) -> HandPose:
        """Pose the corrected hand in the frames to fit."""
        offset = self.value
        still = torch.zeros_like(self._translation)
        hand = self.model(self._shape, self._articulation + offset["articulation"], still, still)
        turn = (self._rotation @ rotation_matrix(offset["rotation"])).transpose(-1, -2)
        place = (self._translation + offset["translation"])[:, None]
        scale = self.before.scale
        return HandPose(
            scale * (hand.vertex @ turn + place), scale * (hand.keypoint @ turn + place)
        )

    def displacement(self, pose: HandPose) -> Float[Tensor, "frame vertex 3"]:
        """Displacement of the surface since stage 1 [m]."""
        return pose.vertex - self._vertex

    def copy(self) -> Offset:
        """Copy the correction, for `restore`."""
        return {name: tensor.detach().clone() for name, tensor in self.value.items()}

    def forget_gradient(self) -> None:
        """Drop the gradient of the last evaluation."""
        for tensor in self.value.values():
            tensor.grad = None

    def restore(self, offset: Offset) -> None:
        """Return to a copied correction."""
        with torch.no_grad():
            for name, tensor in self.value.items():
                tensor.copy_(offset[name])

    def motion(self, carried: float) -> HandMotion:
        """Apply the correction to the motion of all frames.

        Frames after the fitted ones get the last correction, which decays exponentially: the hand
        does not jump, and the correction of a single frame does not last.

        Args:
            carried: Frames in which the last correction decays to 1/e; 0 drops it at once.
        """
        before = self.before
        offset = {
            name: _carry(tensor.detach().double().numpy(), before.frame_count, carried)
            for name, tensor in self.value.items()
        }
        turned = (
            Rotation.from_rotvec(before.wrist_rotation) * Rotation.from_rotvec(offset["rotation"])
        ).as_rotvec()
        wrist_rotation = _nearer_vector(turned, before.wrist_rotation)
        return replace(
            before,
            articulation=(before.articulation + offset["articulation"]).astype(np.float32),
            wrist_rotation=wrist_rotation.astype(np.float32),
            wrist_translation=(before.wrist_translation + offset["translation"]).astype(np.float32),
        )


class OffsetDescent:
    """Adam on the corrections of one hand, with one second moment for each frame.

    Plain Adam gives every number a step of about the same size, so joints with almost no effect on
    the object turn as far as those that hold it. With a shared second moment a frame moves along
    its gradient, scaled by the expected size of each kind of correction, by one step in all.
    `by_parameter` selects plain Adam, as the paper uses it.

    A step of fixed size makes much of a gradient that is nothing but rounding: a hand that does
    not touch the object in a frame has one 1e-7 times that of a frame in which it does. Gradients
    are therefore summed in a fixed order, so that the same input gives the same bits, and below
    `WEAK_FRAME` of the steepest frame a step shrinks with its gradient: rounding then moves a
    frame by less than a ten-thousandth of a step.
    """

    def __init__(
        self, hand: HandOffsets, rates: dict[str, float], beta_2: float, *, by_parameter: bool
    ) -> None:
        """Start without momentum.

        Args:
            hand: The corrections to update.
            rates: Step of each kind of correction [rad, rad, m].
            beta_2: Decay of the second moment.
            by_parameter: Whether every number has its own second moment.
        """
        self.hand = hand
        self.rates = rates
        self.beta_2 = beta_2
        self.by_parameter = by_parameter
        self.count = 0
        self.first = {name: torch.zeros_like(value) for name, value in hand.value.items()}
        self.second = {name: torch.zeros_like(value) for name, value in hand.value.items()}

    def step(self, share: float) -> None:
        """Update the corrections by their gradient, by this share of a full step."""
        self.count += 1
        gradient = {
            name: self.rates[name] * (torch.zeros_like(v) if v.grad is None else v.grad)
            for name, v in self.hand.value.items()
        }
        squared = {name: value**2 for name, value in gradient.items()}
        if not self.by_parameter:
            frame = torch.stack([value.flatten(1).sum(1) for value in squared.values()]).sum(0)
            squared = {
                name: frame.reshape(-1, *[1] * (value.ndim - 1)).expand_as(value)
                for name, value in squared.items()
            }
        with torch.no_grad():
            for name, offset in self.hand.value.items():
                self.first[name].lerp_(gradient[name], 1 - BETA_1)
                self.second[name].lerp_(squared[name], 1 - self.beta_2)
                mean = self.first[name] / (1 - BETA_1**self.count)
                size = (self.second[name] / (1 - self.beta_2**self.count)).sqrt()
                if not self.by_parameter:
                    size = size.clamp(min=WEAK_FRAME * float(size.max()))
                offset.sub_(share * self.rates[name] * mean / (size + FLAT_GRADIENT))


def control_nodes(
    vertices: Sequence[Float[Tensor, "frame _ 3"]], chosen: Int[ndarray, " control"] | None
) -> Float[Tensor, "frame control 3"]:
    """Join the vertices of all hands, in order, and select the control nodes (None for all)."""
    joined = torch.cat(list(vertices), dim=1)
    if chosen is None:
        return joined
    return joined.index_select(1, torch.from_numpy(chosen.astype(np.int64)))


def _carry(
    offset: Float[ndarray, "frame ..."], frame_count: int, carried: float
) -> Float[ndarray, "all_frame ..."]:
    """Append the exponentially decaying last correction for the frames that have none."""
    later = np.arange(1, frame_count - len(offset) + 1)
    share = np.exp(-later / carried) if carried > 0 else np.zeros(len(later))
    faded = share.reshape(-1, *[1] * (offset.ndim - 1)) * offset[-1:]
    return np.concatenate([offset, faded])


def _nearer_vector(
    vector: Float[ndarray, "frame 3"], to: Float[ndarray, "frame 3"]
) -> Float[ndarray, "frame 3"]:
    """Choose of each rotation's two vectors the one nearer to that of `to`."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    other = vector * (1 - 2 * np.pi / np.maximum(angle, 1e-9))
    near, far = (np.linalg.norm(v - to, axis=1, keepdims=True) for v in (vector, other))
    return np.where((far < near) & (angle > 1e-3), other, vector)


def _tensor(array: ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
