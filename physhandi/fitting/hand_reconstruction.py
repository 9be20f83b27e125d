"""Stage 1: reconstructs the hands of a sequence from keypoints and depth (paper, 3.2).

`reconstruct_hands` fits one hand after the other: `guess_wrist` places the palm in every frame,
then `HandProblem` refines pose and shape by steps of Gauss and Newton or by gradient descent, first
on the keypoints, then on keypoints and depth; its motion may be smoothed in the end. Where one view
alone places the palm, and depth was measured, `search_hand` takes the place of the fit to
keypoints.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.adam import Adam
from physhandi.data.camera import PinholeCamera
from physhandi.data.checkpoint import Checkpointer, SavedState, resumed_note
from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, MissingInputError
from physhandi.fitting.checks.readiness import REMEDIES, missing_for_hands
from physhandi.fitting.config import HandFitConfig
from physhandi.fitting.hands.agreement import believed_keypoints
from physhandi.fitting.hands.gauss_newton import DampedSteps, NormalEquations, PoseRates
from physhandi.fitting.hands.left_right import hands_in_place
from physhandi.fitting.hands.losses import (
    DEPTH_DOUBT,
    REFRESH,
    correspond,
    depth_loss,
    distance_curvature,
    distance_loss,
    free_space_curvature,
    free_space_loss,
    hand_acceleration_loss,
    keypoint_costs,
    limit_curvature,
    limit_loss,
    reprojection_curvature,
    reprojection_loss,
    velocity_loss,
)
from physhandi.fitting.hands.observed import (
    DepthTarget,
    FreeSpace,
    KeypointTarget,
    depth_target,
    free_space,
    keypoint_target,
)
from physhandi.fitting.hands.poses import (
    NARROWS,
    PosedHands,
    doubt_breadth,
    hand_optimizer,
    step_share,
)
from physhandi.fitting.hands.search import SearchedHand, search_hand
from physhandi.fitting.hands.smoothing import best_strengths, smoothed_pose
from physhandi.fitting.hands.wrist_guess import (
    WristGuess,
    guess_wrist,
    template_keypoints,
    way_to_depth,
)
from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import HandSide
from physhandi.one_thread import one_thread
from physhandi.perception.keypoints import detect_sequence
from physhandi.progress import NullProgress, Preview, Progress

_Step = Callable[[int, Tensor, Adam | DampedSteps | None], None]
"""Receives the number of an update, its loss, and the optimizer if it can be stored."""
_MOST_STEPS = 40
"""Most steps of Gauss and Newton to keypoints, and as many to keypoints and depth."""
_NARROWING_STEPS = 10.0
"""Steps over which keypoint errors that far off still pull become fewer."""
HAND_STAGE = "hand_reconstruction"
"""Name of the stage in progress reports."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandFit:
    """The result of stage 1."""

    motions: tuple[HandMotion, ...]
    """Motion of each hand that was found, in the order of the sequence's hands."""
    keypoint: Float[ndarray, "view frame hand 21 3"]
    """Keypoints that were seen, those included that were not believed; NaN where not seen [px]."""
    loss_before: float
    """Loss of the first guess, without depth."""
    loss_after: float
    """Loss of the result, without depth."""
    curve: list[tuple[int, float]] = field(default_factory=list)
    """Loss of every tenth iteration or of every step of Gauss and Newton, summed over hands."""
    left_out: Mapping[HandSide, str] = field(default_factory=dict)
    """Hands that no frame shows well enough to place them, and why; they have no motion."""


def reconstruct_hands(
    sequence: Sequence,
    config: HandFitConfig | None = None,
    progress: Progress | None = None,
    *,
    keypoint: Float[ndarray, "view frame hand 21 3"] | None = None,
    checkpointer: Checkpointer | None = None,
) -> HandFit:
    """Fit a hand model to all frames of a sequence at once.

    Shape is constant; a sequence that is not metric gets one scale for each hand. Frames that no
    view saw are bridged by smoothness; no frame is left out. A hand that cannot be placed in any
    frame is, as long as another one can.

    Args:
        sequence: The recording; its `hands` are fitted.
        config: Settings of the fit.
        progress: Receives a report every tenth iteration, or every step of Gauss and Newton.
        keypoint: Keypoints to fit to [px]; None takes those of `observed_keypoints`.
        checkpointer: Keeps the state of each hand's fit; None keeps nothing.

    Raises:
        MissingInputError: If there is no hand, no view, no color image to detect keypoints in, or
            no MANO model although the settings name it.
        FitError: If no frame shows any of the hands well enough for a first guess.
    """
    config, progress = config or HandFitConfig(), progress or NullProgress()
    missing = sequence.missing("hands", "views") if keypoint is not None else None
    missing = missing_for_hands(sequence) if missing is None else missing
    if missing:
        remedies = "; ".join(REMEDIES[part] for part in missing)
        raise MissingInputError(
            f"Sequence '{sequence.name}': stage 1 lacks {', '.join(missing)}: {remedies}."
        )
    if keypoint is None:
        keypoint = observed_keypoints(sequence, progress)
    models = [load_hand_model(side, config.model) for side in sequence.hands]
    if config.judges_keypoints and len(models) == 2:
        cameras = [view.camera for view in sequence.views]
        templates = [template_keypoints(model) for model in models]
        keypoint = hands_in_place(cameras, keypoint, templates)
    fits: list[SolvedHand] = []
    left_out: dict[HandSide, str] = {}
    for hand, (side, model) in enumerate(zip(sequence.hands, models, strict=True)):
        try:
            problem = HandProblem(sequence, keypoint[:, :, hand], model, config)
        except FitError as error:
            left_out[side] = str(error)
            continue
        try:
            fits.append(problem.solve(progress, checkpointer or Checkpointer()))
        except FitError as error:
            raise FitError(f"Sequence '{sequence.name}': {error}") from error
    if not fits:
        raise FitError(f"Sequence '{sequence.name}': {' '.join(left_out.values())}")
    # A hand whose fit ended earlier stays as it is.
    longest = max((fit.curve for fit in fits), key=len)
    curve = [
        (iteration, float(sum(fit.curve[min(at, len(fit.curve) - 1)][1] for fit in fits)))
        for at, (iteration, _) in enumerate(longest)
    ]
    return HandFit(
        motions=tuple(fit.motion for fit in fits),
        keypoint=keypoint.astype(np.float32),
        loss_before=sum(fit.loss_before for fit in fits),
        loss_after=sum(fit.loss_after for fit in fits),
        curve=curve,
        left_out=left_out,
    )


def observed_keypoints(
    sequence: Sequence, progress: Progress
) -> Float[ndarray, "view frame hand 21 3"]:
    """Collect the keypoints of all views [px]: stored ones, else those found in color images.

    A view with neither, such as one that recorded depth alone, has NaN throughout.
    """
    blank = np.full((sequence.frame_count, len(sequence.hands), 21, 3), np.nan, np.float32)
    keypoint = {view.name: view.keypoint for view in sequence.views}
    searched = [view for view in sequence.views if keypoint[view.name] is None and view.has_color]
    if searched:
        detected = detect_sequence(sequence, progress, views=searched)
        keypoint |= {view.name: one for view, one in zip(searched, detected, strict=True)}
    return np.stack([blank if one is None else one for one in keypoint.values()])


@dataclass(frozen=True, eq=False)
class SolvedHand:
    """The fit of one hand; the fields mean what they mean in `HandFit`."""

    motion: HandMotion
    loss_before: float
    loss_after: float
    curve: list[tuple[int, float]]


class HandProblem:
    """The fit of one hand: observations, parameters, loss and optimizer."""

    def __init__(
        self,
        sequence: Sequence,
        keypoint: Float[ndarray, "view frame 21 3"],
        model: HandModel,
        config: HandFitConfig,
    ) -> None:
        self.model, self.config, self.metric = model, config, sequence.metric
        cameras: list[PinholeCamera] = [view.camera for view in sequence.views]
        if config.judges_keypoints:
            keypoint = believed_keypoints(
                sequence.views, keypoint, template_keypoints(model), sequence.frame_rate
            )
        self.target: KeypointTarget = keypoint_target(cameras, keypoint, config.keypoint_noise)
        tolerance = config.agreement * float(self.target.noise.max())
        self.depth: DepthTarget | None = None
        if sequence.metric and config.depth_iterations:
            self.depth = depth_target(
                sequence,
                model.side,
                config.depth_points,
                keypoint if config.starts_at_depth else None,
            )
        guess = guess_wrist(
            cameras,
            keypoint,
            model,
            metric=sequence.metric,
            tolerance=tolerance,
        )
        self.frame_rate = sequence.frame_rate
        self.parameters = _parameters(guess, len(keypoint[0]))
        self._hands = PosedHands(model, self.parameters)
        self.name = sequence.name
        self.joints: Tensor | None = None
        """The 21 keypoints of every frame in the latest evaluation, for previews."""
        self._searched: SearchedHand | None = None
        """What is searched before depth is fitted; None if keypoints are fitted before that."""
        self.space: FreeSpace | None = None
        """Where one view looked through; several see enough of a hand without that."""
        if self.depth is not None and config.starts_at_depth:
            self._place_by_depth(self.depth)
            if config.search_iterations and guess.from_one_view:
                self._searched = SearchedHand(
                    cameras, keypoint, self.target, self.depth, guess, model, self.frame_rate
                )
                if config.free_space_weight:
                    self.space = free_space(sequence.views, self.target)

    def loss(self, breadth: float) -> Tensor:
        """Compute the keypoint loss and the priors; depth is not in it."""
        return self._loss_of(self._hands.keypoints(), breadth)

    def loss_with_depth(self, target: DepthTarget) -> Tensor:
        """Compute the loss and what depth adds to it."""
        metres = self._hands.keypoints()
        loss = self._loss_of(metres, self.config.doubt) + self.depth_term(target)
        if self.space is None:
            return loss
        free = free_space_loss(metres, self.space, self.config.depth_noise)
        return loss + self.config.free_space_weight * free

    def _loss_of(self, metres: Float[Tensor, "frame 21 3"], breadth: float) -> Tensor:
        config, articulation = self.config, self.parameters["articulation"]
        scale = self.parameters["log_scale"].exp()
        self.joints = (metres * scale).detach()
        reach = config.acceleration_noise / self.frame_rate**2
        turn = config.turn_noise * 30 / self.frame_rate
        return (
            reprojection_loss(metres * scale, self.target, breadth)
            + config.limit_weight * limit_loss(articulation, self.model)
            + config.pose_weight * (articulation**2).sum() / len(articulation)
            + config.shape_weight * (self.parameters["shape"] ** 2).sum()
            + hand_acceleration_loss(metres) / reach**2
            + velocity_loss(articulation) / turn**2
        )

    def depth_term(self, target: DepthTarget) -> Tensor:
        """Compute the weighted depth loss."""
        hands, noise = self._hands, self.config.depth_noise
        if not (self.config.fixed_normals or self.config.gauss_newton):
            faces = torch.from_numpy(self.model.faces)
            return self.config.depth_weight * depth_loss(hands.surface(), faces, target, noise)
        vertex, normal = target.vertex, target.normal
        if vertex is None or normal is None or target.age >= REFRESH:
            vertex, normal = self._look(target)
        target.age += 1
        offset = target.point - hands.vertices(vertex)
        return self.config.depth_weight * distance_loss(offset, normal, target.weight, noise)

    @torch.no_grad()
    def _look(self, target: DepthTarget) -> tuple[Tensor, Tensor]:
        """Look for the vertices that measured points correspond to, and their normals."""
        surface = self._hands.surface()
        normal = self._hands.normals(surface)
        target.vertex, target.age = correspond(surface, normal, target), 0
        target.normal = normal.gather(1, target.vertex[..., None].expand(-1, -1, 3))
        return target.vertex, target.normal

    def solve(self, progress: Progress, checkpointer: Checkpointer) -> SolvedHand:
        """Fit to keypoints, then to keypoints and depth."""
        config = self.config
        with torch.no_grad():
            before = float(self.loss(config.doubt))
        curve: list[tuple[int, float]] = []
        total = self._first_iterations() + (self._depth_iterations() if self.depth else 0)
        loop = f"{HAND_STAGE}.{self.name}.{self.model.side}"

        def state(optimizer: Adam | DampedSteps) -> dict[str, ndarray]:
            return optimizer.state() | self._depth_state() | {"curve": _curve_array(curve)}

        resumed = checkpointer.load(loop, state(self._optimizer(0.0)), growing=("curve",))
        if resumed is not None:
            curve = [(int(iteration), loss) for iteration, loss in resumed.tensors["curve"]]
            self._restore_depth(resumed.tensors)
            made = curve[-1][0] if config.gauss_newton else resumed.iteration
            note = f"{self.model.side.capitalize()} hand. {resumed_note(made)}"
            progress.report(HAND_STAGE, made, made + total - resumed.iteration, None, note)

        def step(iteration: int, loss: Tensor, optimizer: Adam | DampedSteps | None) -> None:
            progress.check_cancelled()
            is_told, made = iteration % 10 == 0 or iteration == total, iteration
            if isinstance(optimizer, DampedSteps):
                # Its last step has the number of the last that there may be: some are left out.
                is_told, made = True, curve[-1][0] + 1 if curve else 1
            value = float(loss.detach())
            if is_told:
                curve.append((made, value))
            if optimizer is not None:  # A search is short: it begins again.
                checkpointer.offer(loop, iteration, lambda: state(optimizer))
            if is_told:
                message = f"{self.model.side.capitalize()} hand"
                progress.report(HAND_STAGE, made, made + total - iteration, value, message)
                self._show(value, progress)

        with one_thread():
            if self._searched is not None and resumed is None:
                self._search(self._searched, step)
            self._fit(step, resumed)
        motion, after = self._outcome()
        return SolvedHand(motion, before, after, curve)

    @torch.no_grad()
    def _outcome(self) -> tuple[HandMotion, float]:
        """Smooth the motion, if that is wanted, and give it with its loss."""
        after = float(self.loss(self.config.doubt))
        if not math.isfinite(after):
            raise FitError(
                f"The fit of the {self.model.side} hand did not stay finite (loss {after})."
            )
        if self.config.smooths_motion:
            with one_thread():
                self._smooth()
                after = float(self.loss(self.config.doubt))
        return self._motion(), after

    def _first_iterations(self) -> int:
        """Tell how many updates are made at most before those on keypoints and depth."""
        if self._searched:
            return self.config.search_iterations
        return self._at_most(self.config.iterations)

    def _depth_iterations(self) -> int:
        """Tell how many updates on keypoints and depth are made at most."""
        return self._at_most(self.config.depth_iterations)

    def _at_most(self, iterations: int) -> int:
        return min(iterations, _MOST_STEPS) if self.config.gauss_newton else iterations

    def _search(self, hand: SearchedHand, step: _Step) -> None:
        """Begin with what a search finds."""
        fitted = search_hand(hand, self.config, lambda number, loss: step(number, loss, None))
        with torch.no_grad():
            for name, value in fitted.items():
                self.parameters[name].copy_(value)

    def _fit(self, step: _Step, resumed: SavedState | None) -> None:
        """Descend on keypoints and place the hand by depth, or search; then descend on both."""
        depth = self.depth
        keypoints_first = self._searched is None
        if keypoints_first and (resumed is None or resumed.iteration <= self._first_iterations()):
            self._descend(None, step, resumed)
            resumed = None
            if depth is not None:
                self._place_by_depth(depth)
        if depth is not None:
            self._descend(depth, step, resumed)

    def _smooth(self) -> None:
        """Smooth the motion as far as the keypoints allow."""
        fitted, target = dict(self.parameters), self.target
        seen = float(target.weight.sum())

        def error(fingers: float, wrist: float) -> float:
            hands = PosedHands(self.model, fitted | smoothed_pose(fitted, fingers, wrist))
            point = hands.keypoints() * fitted["log_scale"].exp()
            return float(keypoint_costs(point, target, self.config.doubt).sum()) / max(seen, 1.0)

        fingers, wrist = best_strengths(error, len(fitted["translation"]), 2.0 * seen)
        for name, value in smoothed_pose(fitted, fingers, wrist).items():
            self.parameters[name].copy_(value)

    def _place_by_depth(self, target: DepthTarget) -> None:
        """Move the hand to where depth was measured, if keypoints left it out of the loss's reach.

        One view tells how far away a hand is by its size alone, which differs from hand to hand.
        """
        with torch.no_grad():
            vertex = self._hands.surface()
            normal = self._hands.normals(vertex)
            move = way_to_depth(vertex.numpy(), normal.numpy(), target, self.frame_rate)
            if np.median(np.linalg.norm(move, axis=1)) > DEPTH_DOUBT * self.config.depth_noise:
                self.parameters["translation"].add_(torch.from_numpy(move.astype(np.float32)))

    def _show(self, loss: float, progress: Progress) -> None:
        """Send the hand's current keypoints to a preview, if one is due."""
        joints = self.joints
        if joints is not None and progress.wants_preview():
            progress.preview(
                lambda: Preview(
                    stage=HAND_STAGE,
                    sequence=self.name,
                    loss=loss,
                    frame_rate=self.frame_rate,
                    points={"joints": joints.numpy()},
                )
            )

    def _descend(self, depth: DepthTarget | None, step: _Step, resumed: SavedState | None) -> None:
        """Make updates on keypoints or, with measured points, on both."""
        config = self.config
        first, count, rate = 0, self._first_iterations(), config.learning_rate
        if depth is not None:
            first, count, rate = count, self._depth_iterations(), config.depth_learning_rate
        optimizer, begin = self._optimizer(rate), 0
        if resumed is not None:
            optimizer.restore(resumed.tensors)
            begin = resumed.iteration - first
        for iteration in range(begin, count):
            number = first + iteration + 1
            breadth = config.doubt if depth is not None else self._breadth(iteration)
            loss = partial(self._loss_at, breadth, depth)
            if isinstance(optimizer, Adam):
                optimizer.zero_grad()
                value = loss()
                value.backward()
                optimizer.step(step_share(iteration, count))
                step(number, value, optimizer)
                continue
            if depth is not None:
                self._look(depth)
            value = optimizer.update(loss, partial(self._curvature, breadth, depth))
            is_last = breadth <= config.doubt and optimizer.changes_nothing
            step(first + count if is_last else number, value, optimizer)
            if is_last:
                break

    def _breadth(self, iteration: int) -> float:
        """Tell from which keypoint error on the pull falls in an update on keypoints alone."""
        narrowing = NARROWS * self.config.iterations
        if self.config.gauss_newton:
            narrowing = min(narrowing, _NARROWING_STEPS)
        return doubt_breadth(self.config.doubt, iteration, narrowing)

    def _loss_at(self, breadth: float, depth: DepthTarget | None) -> Tensor:
        return self.loss(breadth) if depth is None else self.loss_with_depth(depth)

    @torch.no_grad()
    def _curvature(self, breadth: float, depth: DepthTarget | None) -> NormalEquations:
        """Compute the curvature of the loss, or of the loss with depth."""
        config, parameters, hands = self.config, self.parameters, self._hands
        articulation, count = parameters["articulation"], len(parameters["articulation"])
        rates, scale = PoseRates(hands), parameters["log_scale"].exp()
        equations = NormalEquations(count, fits_scale=not self.metric)
        by_keypoint = rates.keypoints()
        point = by_keypoint.point
        seen = scale**2 * reprojection_curvature(point * scale, self.target, breadth)
        if depth is not None and self.space is not None:
            free = free_space_curvature(point, self.space, config.depth_noise)
            seen = seen + config.free_space_weight * free
        equations.add_points(by_keypoint, seen, is_scaled=True)
        reach = config.acceleration_noise / self.frame_rate**2
        equations.add_accelerations(by_keypoint, 1 / reach**2 / count)
        bent = config.limit_weight * limit_curvature(articulation, self.model)
        turn = config.turn_noise * 30 / self.frame_rate
        equations.add_angles(bent + 2 * config.pose_weight / count, 1 / turn**2 / count)
        equations.add_shape(2 * config.shape_weight)
        if depth is not None:
            vertex, normal = depth.vertex, depth.normal
            assert vertex is not None  # noqa: S101 - the loss came first
            assert normal is not None  # noqa: S101
            by_vertex = rates.vertices(vertex)
            offset = depth.point - by_vertex.point
            near = distance_curvature(offset, normal, depth.weight, config.depth_noise)
            equations.add_points(by_vertex, config.depth_weight * near)
        return equations

    def _optimizer(self, rate: float) -> Adam | DampedSteps:
        if self.config.gauss_newton:
            return DampedSteps(self.parameters, fits_scale=not self.metric)
        changed = dict(self.parameters)
        if self.metric:
            del changed["log_scale"]
        return hand_optimizer(changed, rate)

    def _depth_state(self) -> dict[str, ndarray]:
        """Copy which vertices measured points correspond to; the age is -1 before they do."""
        depth = self.depth
        if depth is None:
            return {}
        vertex, normal = depth.vertex, depth.normal
        vertices = (
            np.zeros(depth.weight.shape, np.int64) if vertex is None else vertex.numpy().copy()
        )
        normals = np.zeros(depth.point.shape, np.float32)
        return {
            "depth.vertex": vertices,
            "depth.normal": normals if normal is None else normal.numpy().copy(),
            "depth.age": np.array([-1 if vertex is None else depth.age]),
        }

    def _restore_depth(self, state: Mapping[str, ndarray]) -> None:
        """Return to what `_depth_state` gave."""
        depth = self.depth
        if depth is None or state["depth.age"][0] < 0:
            return
        depth.age = int(state["depth.age"][0])
        depth.vertex = torch.from_numpy(state["depth.vertex"])
        if self.config.fixed_normals:
            depth.normal = torch.from_numpy(state["depth.normal"])

    def _motion(self) -> HandMotion:
        with torch.no_grad():
            shape, rotation = self._hands.shape(), self._hands.rotation()
            scale = self.parameters["log_scale"].exp()
        turn = Rotation.from_matrix(rotation.numpy()).as_rotvec()
        return HandMotion(
            side=self.model.side,
            model=self.model.kind,
            shape=shape.numpy().astype(np.float32),
            articulation=self.parameters["articulation"].detach().numpy().copy(),
            wrist_rotation=_without_jumps(turn).astype(np.float32),
            wrist_translation=self.parameters["translation"].detach().numpy().copy(),
            scale=1.0 if self.metric else float(scale),
        )


def _curve_array(curve: list[tuple[int, float]]) -> Float[ndarray, "report 2"]:
    return np.array(curve, np.float64).reshape(-1, 2)


def _parameters(guess: WristGuess, frame_count: int) -> dict[str, Tensor]:
    return {
        "shape": torch.zeros(10),
        "articulation": _bent_articulation(frame_count),
        "rotation": torch.tensor(guess.rotation, dtype=torch.float32),
        "translation": torch.tensor(guess.translation, dtype=torch.float32),
        "log_scale": torch.tensor(math.log(guess.scale), dtype=torch.float32),
    }


def _bent_articulation(frame_count: int) -> Float[Tensor, "frame 15 3"]:
    """Bend all fingers a little, as those of a hand that holds something."""
    articulation = torch.zeros(frame_count, 15, 3)
    articulation[:, 3:, 0] = -0.3
    return articulation


def _without_jumps(vector: Float[ndarray, "frame 3"]) -> Float[ndarray, "frame 3"]:
    """Choose of a rotation's two vectors the one nearer to that of the frame before."""
    vector = vector.copy()
    for frame in range(1, len(vector)):
        angle = np.linalg.norm(vector[frame])
        other = vector[frame] * (1 - 2 * np.pi / max(angle, 1e-9))
        near, far = (np.linalg.norm(v - vector[frame - 1]) for v in (vector[frame], other))
        if far < near and angle > 1e-3:
            vector[frame] = other
    return vector
