"""Stage 1: reconstructs the hands of a sequence from keypoints and depth (paper, 3.2).

`reconstruct_hands` fits one hand after the other: `guess_wrist` places the palm in every frame,
then `HandProblem` refines pose and shape by gradient descent, first on the keypoints, then on
keypoints and depth.
"""

import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import median_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from physhandi.adam import Adam
from physhandi.data.camera import PinholeCamera, triangulate
from physhandi.data.checkpoint import Checkpointer, SavedState, resumed_note
from physhandi.data.observation import evenly
from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, MissingInputError
from physhandi.fitting.checks.readiness import LEAST_PALM_POINTS, PALM, REMEDIES, missing_for_hands
from physhandi.fitting.config import HandFitConfig
from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import HandSide
from physhandi.hand.rotation import quaternion_matrix
from physhandi.one_thread import one_thread
from physhandi.perception.keypoints import detect_sequence
from physhandi.perception.lifting import HAND_LABEL, surface_points
from physhandi.perception.segmentation import draw_hand
from physhandi.progress import NullProgress, Preview, Progress

_PALM_BONES = ((0, 5), (0, 9), (0, 13), (0, 17), (5, 17))
"""Pairs of palm keypoints whose distances give the scale."""
_KNUCKLE = ((-1.7, 0.6), (-0.4, 0.4), (-0.25, 0.25))
_MIDDLE = ((-2.0, 0.2), (-0.08, 0.08), (-0.08, 0.08))
_LAST = ((-1.5, 0.4), (-0.08, 0.08), (-0.08, 0.08))
_THUMB = (
    ((-0.9, 0.9), (-0.9, 0.9), (-0.6, 0.6)),
    ((-1.2, 0.6), (-0.4, 0.4), (-0.3, 0.3)),
    ((-1.6, 0.6), (-0.15, 0.15), (-0.15, 0.15)),
)
JOINT_LIMIT = np.array([*_THUMB, *([_KNUCKLE, _MIDDLE, _LAST] * 4)])
"""Lower and upper bound of each joint's rotation vector, for a right hand [rad]."""
_CANDIDATES = 8
"""Nearest vertices among which a measured point looks for one that faces the camera."""
_REFRESH = 10
"""Evaluations of the depth loss between two searches for corresponding vertices."""
_DOUBT = 3.0
"""Depth errors beyond this many standard deviations lose their pull (Cauchy's loss)."""
_LEAST_POINTS = 8
"""Measured points that tell how far away a hand is."""
_BESIDE = 0.01
"""Distance at which a line of sight still meets a vertex [m]."""
_STEADY = 0.3
"""Time over which the median of the way to the measured depth is taken [s]."""
_TURN = 0.3
"""Turn of a hand from frame to frame that costs 1 when poses are told from mirrored ones [rad]."""
_MISSED = 0.06
"""Error of keypoints that costs 1, as a share of the palm's size in the image."""
_FAR = 0.005
"""Distance of measured points from the hand's surface that costs 1 [m]."""
_UNLIKE = 9.0
"""Most that this costs: of two poses that are both unlike what was measured, neither is better."""
_MOST_COST = 20.0
"""Most that any of these costs."""
_HALF_HAND = 0.07
"""Distance of a hand's pixels from their median, along the view [m]."""
HAND_STAGE = "hand_reconstruction"
"""Name of the stage in progress reports."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandFit:
    """The result of stage 1."""

    motions: tuple[HandMotion, ...]
    """Motion of each hand that was found, in the order of the sequence's hands."""
    keypoint: Float[ndarray, "view frame hand 21 3"]
    """Keypoints that the hands were fitted to; NaN where not seen [px]."""
    loss_before: float
    """Loss of the first guess, without depth."""
    loss_after: float
    """Loss of the result, without depth."""
    curve: list[tuple[int, float]] = field(default_factory=list)
    """Loss of every tenth iteration, summed over the hands."""
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
        progress: Receives a report every tenth iteration.
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
    fits: list[SolvedHand] = []
    left_out: dict[HandSide, str] = {}
    for hand, side in enumerate(sequence.hands):
        model = load_hand_model(side, config.model)
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
    losses = zip(*(fit.curve for fit in fits), strict=False)
    curve = [(at[0][0], float(sum(loss for _, loss in at))) for at in losses]
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
        found = detect_sequence(sequence, progress, views=searched)
        keypoint |= {view.name: one for view, one in zip(searched, found, strict=True)}
    return np.stack([blank if one is None else one for one in keypoint.values()])


@dataclass(frozen=True)
class WristGuess:
    """First guess of the wrist's pose in every frame."""

    rotation: Float[ndarray, "frame 4"]
    """Unit quaternion (x, y, z, w) of the hand; its sign is continuous over frames."""
    translation: Float[ndarray, "frame 3"]
    """Position of the wrist [m, before scale]."""
    scale: float
    """Length units of the sequence per metre."""


@dataclass(frozen=True)
class KeypointTarget:
    """Undistorted keypoints of one hand in all views."""

    pixel: Float[Tensor, "view frame 21 2"]
    """Position in the image; zero where not seen [px]."""
    weight: Float[Tensor, "view frame 21"]
    """Confidence; zero where not seen."""
    noise: Float[Tensor, " view"]
    """Expected keypoint error of each view [px]."""
    projection: Float[Tensor, "view 3 4"]
    """Maps homogeneous world points to pixels without lens distortion."""


@dataclass(eq=False)
class DepthTarget:
    """Measured surface points of one hand, and the vertices they correspond to."""

    point: Float[Tensor, "frame point 3"]
    """Measured points; zero where a frame has fewer [m]."""
    towards_camera: Float[Tensor, "frame point 3"]
    """Unit vector from each point to the camera that measured it."""
    weight: Float[Tensor, "frame point"]
    """One over the frame's number of points; zero on padding."""
    vertex: Tensor | None = None
    """Vertex that each point corresponds to; None before the first evaluation."""
    normal: Float[Tensor, "frame point 3"] | None = None
    """Normal of the surface there when `vertex` was found, if normals are held fixed."""
    age: int = 0
    """Evaluations since `vertex` was last updated."""


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
            depth=self.depth if config.starts_at_depth else None,
        )
        self.frame_rate = sequence.frame_rate
        self.parameters = _parameters(guess, len(keypoint[0]))
        self.name = sequence.name
        self.joints: Tensor | None = None
        """The 21 keypoints of every frame in the latest evaluation, for previews."""
        if self.depth is not None and config.starts_at_depth:
            self._place_by_depth(self.depth)

    def hand(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Shape, wrist rotation, wrist position [m] and scale."""
        p = self.parameters
        rotation = quaternion_matrix(p["rotation"])
        return 3 * torch.tanh(p["shape"] / 3), rotation, p["translation"], p["log_scale"].exp()

    def loss(self, breadth: float) -> Tensor:
        """Compute the keypoint loss and the priors; depth is not in it."""
        config, articulation = self.config, self.parameters["articulation"]
        shape, rotation, translation, scale = self.hand()
        still = torch.zeros_like(translation)
        local = self.model.keypoints(shape, articulation, still, still)
        metres = local @ rotation.transpose(-1, -2) + translation[:, None]
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
        faces, noise = torch.from_numpy(self.model.faces), self.config.depth_noise
        if not self.config.fixed_normals:
            return self.config.depth_weight * depth_loss(self.surface(), faces, target, noise)
        if target.vertex is None or target.normal is None or target.age >= _REFRESH:
            with torch.no_grad():
                surface = self.surface()
                normal = vertex_normals_torch(surface, faces)
                target.vertex, target.age = _correspond(surface, normal, target), 0
                index = target.vertex[..., None].expand(-1, -1, 3)
                target.normal = normal.gather(1, index)
        target.age += 1
        shape, rotation, translation, _ = self.hand()
        local = self.model.chosen_vertices(target.vertex, shape, self.parameters["articulation"])
        vertex = local @ rotation.transpose(-1, -2) + translation[:, None]
        loss = distance_loss(target.point - vertex, target.normal, target.weight, noise)
        return self.config.depth_weight * loss

    def surface(self) -> Float[Tensor, "frame vertex 3"]:
        """Pose the hand's vertices in every frame [m, before scale]."""
        shape, rotation, translation, _ = self.hand()
        still = torch.zeros_like(translation)
        local = self.model(shape, self.parameters["articulation"], still, still).vertex
        return local @ rotation.transpose(-1, -2) + translation[:, None]

    def solve(self, progress: Progress, checkpointer: Checkpointer) -> SolvedHand:
        """Fit to keypoints, then to keypoints and depth."""
        config = self.config
        with torch.no_grad():
            before = float(self.loss(config.doubt))
        curve: list[tuple[int, float]] = []
        total = config.iterations + (config.depth_iterations if self.depth else 0)
        loop = f"{HAND_STAGE}.{self.name}.{self.model.side}"

        def state(optimizer: Adam) -> dict[str, ndarray]:
            return optimizer.state() | self._depth_state() | {"curve": _curve_array(curve)}

        resumed = checkpointer.load(loop, state(self._optimizer(0.0)), growing=("curve",))
        if resumed is not None:
            curve = [(int(iteration), loss) for iteration, loss in resumed.tensors["curve"]]
            self._restore_depth(resumed.tensors)
            note = f"{self.model.side.capitalize()} hand. {resumed_note(resumed.iteration)}"
            progress.report(HAND_STAGE, resumed.iteration, total, None, note)

        def step(iteration: int, loss: Tensor, optimizer: Adam) -> None:
            progress.check_cancelled()
            is_told, value = iteration % 10 == 0 or iteration == total, float(loss.detach())
            if is_told:
                curve.append((iteration, value))
            checkpointer.offer(loop, iteration, lambda: state(optimizer))
            if is_told:
                message = f"{self.model.side.capitalize()} hand"
                progress.report(HAND_STAGE, iteration, total, value, message)
                self._show(value, progress)

        with one_thread():
            self._fit(step, resumed)
        with torch.no_grad():
            after = float(self.loss(config.doubt))
        if not math.isfinite(after):
            raise FitError(
                f"The fit of the {self.model.side} hand did not stay finite (loss {after})."
            )
        return SolvedHand(self._motion(), before, after, curve)

    def _fit(self, step: Callable[[int, Tensor, Adam], None], resumed: SavedState | None) -> None:
        """Descend on keypoints, place the hand by depth, and descend on both."""
        config, depth = self.config, self.depth

        def widening(iteration: int) -> float:
            share = min(iteration / (0.6 * config.iterations), 1.0)
            return config.doubt * 10 ** (1 - share)

        if resumed is None or resumed.iteration <= config.iterations:
            self._descend(
                config.iterations,
                config.learning_rate,
                lambda iteration: self.loss(widening(iteration)),
                step,
                first=0,
                resumed=resumed,
            )
            resumed = None
            if depth is not None:
                self._place_by_depth(depth)
        if depth is not None:
            self._descend(
                config.depth_iterations,
                config.depth_learning_rate,
                lambda _: self.loss(config.doubt) + self.depth_term(depth),
                step,
                first=config.iterations,
                resumed=resumed,
            )

    def _place_by_depth(self, target: DepthTarget) -> None:
        """Move the hand to where depth was measured, if keypoints left it out of the loss's reach.

        One view tells how far away a hand is by its size alone, which differs from hand to hand.
        """
        with torch.no_grad():
            vertex = self.surface()
            normal = vertex_normals_torch(vertex, torch.from_numpy(self.model.faces))
            move = way_to_depth(vertex.numpy(), normal.numpy(), target, self.frame_rate)
            if np.median(np.linalg.norm(move, axis=1)) > _DOUBT * self.config.depth_noise:
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

    def _descend(
        self,
        iterations: int,
        rate: float,
        loss_at: Callable[[int], Tensor],
        step: Callable[[int, Tensor, Adam], None],
        *,
        first: int,
        resumed: SavedState | None,
    ) -> None:
        optimizer, begin = self._optimizer(rate), 0
        if resumed is not None:
            optimizer.restore(resumed.tensors)
            begin = resumed.iteration - first
        for iteration in range(begin, iterations):
            optimizer.zero_grad()
            loss = loss_at(iteration)
            loss.backward()
            optimizer.step(0.05 + 0.475 * (1 + math.cos(math.pi * iteration / iterations)))
            step(first + iteration + 1, loss, optimizer)

    def _optimizer(self, rate: float) -> Adam:
        share = {
            "shape": 2.0,
            "articulation": 1.0,
            "rotation": 0.3,
            "translation": 0.1,
            "log_scale": 0.1,
        }
        return Adam(
            [
                (value.requires_grad_(), rate * share[name])
                for name, value in self.parameters.items()
                if not (self.metric and name == "log_scale")
            ],
            betas=(0.9, 0.99),
        )

    def _depth_state(self) -> dict[str, ndarray]:
        """Copy which vertices measured points correspond to; the age is -1 before they do."""
        depth = self.depth
        if depth is None:
            return {}
        vertex, normal = depth.vertex, depth.normal
        known = np.zeros(depth.weight.shape, np.int64) if vertex is None else vertex.numpy().copy()
        normals = np.zeros(depth.point.shape, np.float32)
        return {
            "depth.vertex": known,
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
            shape, rotation, translation, scale = self.hand()
        turn = Rotation.from_matrix(rotation.numpy()).as_rotvec()
        return HandMotion(
            side=self.model.side,
            model=self.model.kind,
            shape=shape.numpy().astype(np.float32),
            articulation=self.parameters["articulation"].detach().numpy().copy(),
            wrist_rotation=_without_jumps(turn).astype(np.float32),
            wrist_translation=translation.detach().numpy().copy(),
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


def guess_wrist(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    model: HandModel,
    *,
    metric: bool,
    tolerance: float,
    depth: DepthTarget | None = None,
) -> WristGuess:
    """Align the template's palm with the triangulated palm; interpolate frames that lack one.

    A palm is flat: one view alone shows it about as well mirrored in depth, 60 to 90 degrees away.
    Where depth is given, the measured points and the frames before and after tell which it is.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        model: Model of the hand.
        metric: Whether lengths are metres; otherwise the scale is estimated too.
        tolerance: Largest reprojection error at which views agree about a keypoint [px].
        depth: Measured points of the hand, to start from.

    Raises:
        FitError: If no frame shows enough of the palm.
    """
    template = _template(model)
    view_count, frame_count = keypoint.shape[:2]
    flat = keypoint.reshape(view_count, -1, 3)
    weight = np.nan_to_num(flat[..., 2])
    point = triangulate(cameras, flat[..., :2], weight, tolerance).reshape(frame_count, 21, 3)
    scale = 1.0 if metric else _scale(point, template)
    palm = list(PALM)
    rotation, translation = np.zeros((frame_count, 4)), np.zeros((frame_count, 3))
    is_known = np.zeros(frame_count, dtype=bool)
    for frame in range(frame_count):
        is_seen = np.isfinite(point[frame, palm]).all(-1)
        if is_seen.sum() >= LEAST_PALM_POINTS:
            pose = _align(template[palm][is_seen], point[frame, palm][is_seen] / scale)
            rotation[frame], translation[frame] = pose[0].as_quat(), pose[1]
            is_known[frame] = True
    if not is_known.any():
        guesses = [
            _guess_from_one_view(cameras, keypoint[:, frame, palm], template[palm] * scale)
            for frame in range(frame_count)
        ]
        if depth is not None:
            guesses = _told_from_mirrored(cameras, keypoint[:, :, palm], model, guesses, depth)
        for frame, pose in enumerate(guesses):
            if pose is not None:
                rotation[frame], translation[frame] = pose[0].as_quat(), pose[1] / scale
                is_known[frame] = True
    if not is_known.any():
        raise FitError(
            f"The {model.side} hand cannot be placed: no frame shows "
            f"{LEAST_PALM_POINTS} keypoints of its palm apart from each other. Check the keypoints "
            "and the calibration."
        )
    rotation, translation = _bridge(rotation, translation, is_known)
    return WristGuess(rotation, translation, scale)


def _template(model: HandModel) -> Float[ndarray, "21 3"]:
    zero = torch.zeros(1, 3, dtype=torch.float64)
    keypoint = model.keypoints(zero.new_zeros(10), zero.new_zeros(1, 15, 3), zero, zero)
    return keypoint[0].numpy()


def _scale(point: Float[ndarray, "frame 21 3"], template: Float[ndarray, "21 3"]) -> float:
    """Compare the palm's lengths, medians over frames, with the template's."""
    ratio = [
        np.linalg.norm(point[:, i] - point[:, j], axis=-1)
        / np.linalg.norm(template[i] - template[j])
        for i, j in _PALM_BONES
    ]
    ratios = np.array(ratio)
    return float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 1.0


def _align(
    source: Float[ndarray, "point 3"], target: Float[ndarray, "point 3"]
) -> tuple[Rotation, Float[ndarray, " 3"]]:
    """Find the rigid motion that takes one set of points closest to another (Kabsch)."""
    covariance = (target - target.mean(0)).T @ (source - source.mean(0))
    left, _, right = np.linalg.svd(covariance)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = Rotation.from_matrix(left @ flip @ right)
    return rotation, target.mean(0) - rotation.apply(source.mean(0))


def _guess_from_one_view(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view point 3"],
    template: Float[ndarray, "point 3"],
) -> tuple[Rotation, Float[ndarray, " 3"]] | None:
    """Solve perspective-n-point in the view with the most confident palm keypoints."""
    is_seen, view = np.asarray(np.isfinite(keypoint).all(-1)), _clearest_view(keypoint)
    if is_seen[view].sum() < LEAST_PALM_POINTS or np.nansum(keypoint[view, :, 2]) <= 0:
        return None
    camera, indices = cameras[view], np.flatnonzero(is_seen[view, :])
    pixel = camera.undistort(keypoint[view, indices, :2].astype(np.float64))
    try:
        is_solved, vector, offset = cv2.solvePnP(
            template[indices], pixel, camera.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # The keypoints are all in one place.
        return None
    if not is_solved:
        return None
    pose = camera.T_world_camera
    rotation = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_rotvec(vector[:, 0])
    return rotation, pose[:3, :3] @ offset[:, 0] + pose[:3, 3]


_Pose = tuple[Rotation, Float[ndarray, " 3"]]


def _told_from_mirrored(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame point 3"],
    model: HandModel,
    guesses: Many[_Pose | None],
    depth: DepthTarget,
) -> list[_Pose | None]:
    """Choose in every frame between a pose and its mirror image, all frames at once (Viterbi).

    What a pose costs: keypoints that it misses, measured points that are far from the posed
    template's surface, and its turn from the pose before.
    """
    palm = _template(model)[list(PALM)]
    still, bent = torch.zeros(1, 3), _bent_articulation(1)
    with torch.no_grad():
        surface = model(torch.zeros(10), bent, still, still).vertex
        normal = vertex_normals_torch(surface, torch.from_numpy(model.faces))[0].numpy()
    vertex = surface[0].numpy().astype(np.float64)
    chain: list[tuple[int, list[_Pose], ndarray]] = []
    best, source = np.zeros(0), []
    for frame, guess in enumerate(guesses):
        if guess is None:
            continue
        poses = [guess, *_mirrored(cameras, keypoint[:, frame], palm, guess)]
        count = int((depth.weight[frame] > 0).sum())
        point, ray = (
            part[frame, :count].numpy().astype(np.float64)
            for part in (depth.point, depth.towards_camera)
        )
        cost = np.array([_misfit(pose, vertex, normal, point, ray) for pose in poses])
        cost += [_missed(cameras, keypoint[:, frame], palm, pose) for pose in poses]
        if chain:
            before = chain[-1][1]
            turn = np.array([[(a[0] * b[0].inv()).magnitude() for b in before] for a in poses])
            ways = best + np.minimum((turn / _TURN) ** 2, _MOST_COST)
            source.append(ways.argmin(axis=1))
            cost = cost + ways.min(axis=1)
        best = cost
        chain.append((frame, poses, cost))
    result: list[_Pose | None] = [None] * len(guesses)
    choice = int(best.argmin()) if chain else 0
    for number in range(len(chain) - 1, -1, -1):
        frame, poses, _ = chain[number]
        result[frame] = poses[choice]
        choice = int(source[number - 1][choice]) if number else 0
    return result


def _mirrored(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view point 3"],
    palm: Float[ndarray, "point 3"],
    pose: _Pose,
) -> list[_Pose]:
    """Find the other pose in which a palm looks about the same, as it is and laid on keypoints."""
    view = _clearest_view(keypoint)
    camera, is_seen = cameras[view], np.isfinite(keypoint[view]).all(-1)
    point = pose[0].apply(palm) + pose[1]
    way = point.mean(axis=0) - camera.T_world_camera[:3, 3]
    way /= np.linalg.norm(way)
    rotation, offset = _align(palm, point - 2 * ((point - point.mean(axis=0)) @ way)[:, None] * way)
    pixel = camera.undistort(keypoint[view, is_seen, :2].astype(np.float64))
    to_camera = Rotation.from_matrix(camera.T_camera_world[:3, :3])
    vector = (to_camera * rotation).as_rotvec()[:, None]
    shift = (to_camera.apply(offset) + camera.T_camera_world[:3, 3])[:, None]
    vector, shift = cv2.solvePnPRefineLM(palm[is_seen], pixel, camera.K, np.zeros(5), vector, shift)
    mirrored: list[_Pose] = [(rotation, offset)]
    # Perspective makes it differ a little from the mirror image, or even turn back.
    if np.isfinite(vector).all() and np.isfinite(shift).all() and shift[2, 0] > 0:
        laid = to_camera.inv().apply(shift[:, 0]) + camera.T_world_camera[:3, 3]
        mirrored.append((to_camera.inv() * Rotation.from_rotvec(vector[:, 0]), laid))
    return mirrored


def _missed(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view point 3"],
    palm: Float[ndarray, "point 3"],
    pose: _Pose,
) -> float:
    """Compute what a pose costs by the keypoints of the palm that it misses."""
    view = _clearest_view(keypoint)
    missed = cameras[view].project(pose[0].apply(palm) + pose[1]) - keypoint[view, :, :2]
    is_seen = np.isfinite(keypoint[view, :, 0])
    size = max(float(np.ptp(keypoint[view, is_seen, :2], axis=0).max()), 1.0)
    return min(float(np.nanmean((missed**2).sum(-1))) / (_MISSED * size) ** 2, _MOST_COST)


def _misfit(
    pose: _Pose,
    vertex: Float[ndarray, "vertex 3"],
    normal: Float[ndarray, "vertex 3"],
    point: Float[ndarray, "point 3"],
    ray: Float[ndarray, "point 3"],
) -> float:
    """Compute what a pose costs by the measured points that are far from the hand's surface.

    How far away the hand is does not count, since the size of the hand is not known yet.
    """
    if len(point) < _LEAST_POINTS:
        return 0.0
    surface, way = pose[0].apply(vertex) + pose[1], ray.mean(axis=0)
    way /= np.linalg.norm(way)
    shown = surface[pose[0].apply(normal) @ way > 0]
    if not len(shown):
        return _UNLIKE
    shown = shown + (np.median(point @ way) - np.median(shown @ way)) * way
    far = np.asarray(KDTree(shown).query(point)[0])
    return min(float(np.mean(np.minimum(far / _FAR, 5.0) ** 2)), _UNLIKE)


def _clearest_view(keypoint: Float[ndarray, "view point 3"]) -> int:
    """Choose the view with the most confident keypoints, of those that show enough of them."""
    is_seen = np.asarray(np.isfinite(keypoint).all(-1))
    usable = np.where(is_seen.sum(1) >= LEAST_PALM_POINTS, np.nansum(keypoint[..., 2], 1), 0.0)
    return int(np.argmax(usable))


def _bridge(
    rotation: Float[ndarray, "frame 4"],
    translation: Float[ndarray, "frame 3"],
    is_known: Bool[ndarray, " frame"],
) -> tuple[Float[ndarray, "frame 4"], Float[ndarray, "frame 3"]]:
    """Interpolate unknown frames; before the first and after the last known one, hold the pose."""
    frame, known_frame = np.arange(len(is_known)), np.flatnonzero(is_known)
    if len(known_frame) > 1:
        between = np.clip(frame, known_frame[0], known_frame[-1])
        rotation = Slerp(known_frame, Rotation.from_quat(rotation[known_frame]))(between).as_quat()
    else:
        rotation = np.repeat(rotation[known_frame], len(frame), axis=0)
    for t in range(1, len(frame)):
        if rotation[t] @ rotation[t - 1] < 0:
            rotation[t] = -rotation[t]
    columns = [np.interp(frame, known_frame, translation[known_frame, axis]) for axis in range(3)]
    return rotation, np.stack(columns, axis=1)


def keypoint_target(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    relative_noise: float,
) -> KeypointTarget:
    """Undistort keypoints for `reprojection_loss`.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        relative_noise: Expected error as a share of the hand's size in the image.
    """
    is_seen = np.isfinite(keypoint).all(-1) & (keypoint[..., 2] > 0)
    filled = np.where(is_seen[..., None], keypoint, 0.0).astype(np.float64)
    pixel = np.stack([c.undistort(k[..., :2]) for c, k in zip(cameras, filled, strict=True)])
    projection = np.stack([camera.K @ camera.T_camera_world[:3] for camera in cameras])
    noise = np.maximum(relative_noise * np.array([_hand_size(view) for view in keypoint]), 0.5)
    return KeypointTarget(
        pixel=torch.tensor(pixel, dtype=torch.float32),
        weight=torch.tensor(filled[..., 2] * is_seen, dtype=torch.float32),
        noise=torch.tensor(noise, dtype=torch.float32),
        projection=torch.tensor(projection, dtype=torch.float32),
    )


def _hand_size(keypoint: Float[ndarray, "frame 21 3"]) -> float:
    """Compute the median diagonal of the keypoints' bounding box in one view [px]."""
    is_whole = np.isfinite(keypoint).all(-1).sum(1) >= 15
    if not is_whole.any():
        return 100.0
    pixel = keypoint[is_whole, :, :2]
    diagonal = np.linalg.norm(np.nanmax(pixel, 1) - np.nanmin(pixel, 1), axis=-1)
    return float(np.median(diagonal))


def reprojection_loss(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget, breadth: float
) -> Float[Tensor, ""]:
    """Compare projected with observed keypoints: sum over keypoints, mean over frames.

    Cauchy's robust loss ``c² log(1 + (r / c)²)`` of the distance ``r`` in units of the expected
    noise, so that gross outliers have almost no gradient.

    Args:
        point: Keypoints in the world frame.
        target: Observed keypoints.
        breadth: ``c``, in units of noise.
    """
    frame_count = point.shape[0]
    homogeneous = torch.cat([point, torch.ones_like(point[..., :1])], -1)
    projected = torch.einsum("vij,fkj->vfki", target.projection, homogeneous)
    depth = projected[..., 2:]
    nearest = 1e-3 * depth.detach().abs().median()
    pixel = projected[..., :2] / depth.clamp(min=float(nearest) + 1e-9)
    squared = ((pixel - target.pixel) ** 2).sum(-1) / target.noise[:, None, None] ** 2
    robust = breadth**2 * torch.log1p(squared / breadth**2)
    return (target.weight * robust).sum() / frame_count


def limit_loss(articulation: Float[Tensor, "frame 15 3"], model: HandModel) -> Float[Tensor, ""]:
    """Sum the squared violations of the joint limits, averaged over frames [rad²]."""
    mirror = torch.tensor([1.0, -1.0, -1.0] if model.side == "left" else [1.0, 1.0, 1.0])
    limit = torch.tensor(JOINT_LIMIT, dtype=articulation.dtype)
    turned = articulation * mirror
    beyond = (limit[..., 0] - turned).relu() + (turned - limit[..., 1]).relu()
    return (beyond**2).sum() / articulation.shape[0]


def hand_acceleration_loss(point: Float[Tensor, "frame 21 3"]) -> Float[Tensor, ""]:
    """Sum the squared second differences of the keypoints over time, averaged over frames."""
    if point.shape[0] < 3:
        return point.sum() * 0
    second = point[2:] - 2 * point[1:-1] + point[:-2]
    return (second**2).sum() / point.shape[0]


def velocity_loss(point: Float[Tensor, "frame joint 3"]) -> Float[Tensor, ""]:
    """Sum the squared differences from frame to frame, averaged over frames."""
    return ((point[1:] - point[:-1]) ** 2).sum() / point.shape[0]


def depth_target(
    sequence: Sequence,
    side: HandSide,
    point_count: int,
    keypoint: Float[ndarray, "view frame 21 3"] | None = None,
) -> DepthTarget | None:
    """Collect one hand's depth points of all views, at most `point_count` a frame.

    Args:
        sequence: The recording.
        side: Which hand.
        point_count: Most points of a frame.
        keypoint: Keypoints of this hand, around which it is looked for in views without masks.

    Returns:
        The points; None if no view has depth and either masks or keypoints of this hand.
    """
    numbers = [
        number
        for number, view in enumerate(sequence.views)
        if view.has_depth and (view.has_mask or keypoint is not None)
    ]
    frames = []
    for frame in range(sequence.frame_count):
        point, camera = np.zeros((0, 3)), np.zeros((0, 3))
        for number in numbers:
            view = sequence.views[number]
            depth = view.depth(frame)
            if view.has_mask:
                is_hand = view.mask(frame) == HAND_LABEL[side]
            else:
                assert keypoint is not None  # noqa: S101 - numbers hold no such view otherwise
                is_hand = _at_keypoints(keypoint[number, frame, :, :2], depth)
            measured = surface_points(view, depth, is_hand)
            point = np.concatenate([point, measured])
            camera = np.concatenate([camera, view.camera.T_world_camera[:3, 3] - measured])
        chosen = evenly(len(point), point_count)
        frames.append((point[chosen], camera[chosen]))
    if not any(len(point) for point, _ in frames):
        return None
    shape = (len(frames), point_count, 3)
    point, ray, weight = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    for frame, (measured, camera) in enumerate(frames):
        count = len(measured)
        if count:
            point[frame, :count] = measured
            ray[frame, :count] = camera / np.linalg.norm(camera, axis=1, keepdims=True)
            weight[frame, :count] = 1 / count
    return DepthTarget(
        point=torch.tensor(point, dtype=torch.float32),
        towards_camera=torch.tensor(ray, dtype=torch.float32),
        weight=torch.tensor(weight, dtype=torch.float32),
    )


def _at_keypoints(
    keypoint: Float[ndarray, "21 2"], depth: Float[ndarray, "row column"]
) -> Bool[ndarray, "row column"]:
    """Choose the pixels on bones and palm of a hand, without what is far before or behind it.

    Things that hide the hand are before it, and what shows between fingers is behind: half of the
    pixels must be the hand's.
    """
    core = draw_hand(keypoint, depth.shape)
    if core is None:
        return np.zeros(depth.shape, dtype=bool)
    measured = (core > 0) & (depth > 0)
    if not measured.any():
        return measured
    return measured & (np.abs(depth - np.median(depth[measured])) < _HALF_HAND)


def way_to_depth(
    vertex: Float[ndarray, "frame vertex 3"],
    normal: Float[ndarray, "frame vertex 3"],
    target: DepthTarget,
    frame_rate: float,
) -> Float[ndarray, "frame 3"]:
    """Find how far each frame's hand lies from the depth that was measured of it [m].

    A point is compared with the vertex that its line of sight passes nearest to, of those that face
    the camera; how far the hand is off aside is left to the keypoints.
    """
    known, move = [], []
    for frame in range(len(vertex)):
        count = int((target.weight[frame] > 0).sum())
        if count < _LEAST_POINTS:
            continue
        ray = target.towards_camera[frame, :count].numpy().astype(np.float64)
        point = target.point[frame, :count].numpy().astype(np.float64)
        offset = point[:, None] - vertex[frame].astype(np.float64)
        along = (offset * ray[:, None]).sum(axis=2)
        aside = np.linalg.norm(offset - along[..., None] * ray[:, None], axis=2)
        aside[ray @ normal[frame].T <= 0.0] = np.inf
        nearest = aside.argmin(axis=1)
        rows = np.arange(count)
        is_hit = aside[rows, nearest] < _BESIDE
        if is_hit.sum() < _LEAST_POINTS:
            continue
        direction = ray[is_hit].mean(axis=0)
        direction /= np.linalg.norm(direction)
        known.append(frame)
        move.append(np.median(along[rows, nearest][is_hit]) * direction)
    if not known:
        return np.zeros((len(vertex), 3))
    window = min(len(known), 2 * round(_STEADY * frame_rate / 2) + 1)
    steady = median_filter(np.array(move), size=(window, 1), mode="nearest")
    frames = np.arange(len(vertex))
    return np.stack([np.interp(frames, known, steady[:, axis]) for axis in range(3)], axis=1)


def depth_loss(
    vertex: Float[Tensor, "frame vertex 3"],
    faces: Tensor,
    target: DepthTarget,
    noise: float,
) -> Float[Tensor, ""]:
    """Measure how far points lie from the surface, mostly along its normal (Cauchy's loss).

    Args:
        vertex: The hand's surface in the world frame [m].
        faces: Its triangles.
        target: Measured points; every tenth call updates the vertices they correspond to.
        noise: Expected error of a measurement [m].

    Returns:
        Mean over points, then frames, in units of the noise, squared.
    """
    normal = vertex_normals_torch(vertex, faces)
    if target.vertex is None or target.age >= _REFRESH:
        target.vertex, target.age = _correspond(vertex.detach(), normal.detach(), target), 0
    target.age += 1
    index = target.vertex[..., None].expand(-1, -1, 3)
    offset = target.point - vertex.gather(1, index)
    return distance_loss(offset, normal.gather(1, index), target.weight, noise)


def distance_loss(
    offset: Float[Tensor, "frame point 3"],
    normal: Float[Tensor, "frame point 3"],
    weight: Float[Tensor, "frame point"],
    noise: float,
) -> Float[Tensor, ""]:
    """Measure distances from a surface, mostly along its normal (Cauchy's loss).

    Args:
        offset: Way from the surface to each point [m].
        normal: Normal of the surface there.
        weight: Share of each point in its frame; zero on padding.
        noise: Expected error of a point [m].

    Returns:
        Mean over points, then frames, in units of the noise, squared.
    """
    along = (offset * normal).sum(-1)
    aside = ((offset**2).sum(-1) - along**2).clamp(min=0)
    squared = (along**2 + 0.1 * aside) / noise**2
    robust = _DOUBT**2 * torch.log1p(squared / _DOUBT**2)
    return (weight * robust).sum() / max(int((weight.sum(1) > 0).sum()), 1)


def vertex_normals_torch(
    vertex: Float[Tensor, "frame vertex 3"], faces: Tensor
) -> Float[Tensor, "frame vertex 3"]:
    """Compute unit normals of vertices, the area-weighted mean of their triangles'."""
    a, b, c = (vertex.index_select(1, faces[:, corner]) for corner in range(3))
    normal = torch.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertex)
    for corner in range(3):
        total = total.index_add(1, faces[:, corner], normal)
    return total / total.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def _correspond(vertex: Tensor, normal: Tensor, target: DepthTarget) -> Tensor:
    """Find for each point the nearest vertex among its neighbours that faces the camera."""
    chosen = torch.zeros(target.weight.shape, dtype=torch.int64)
    for frame in range(len(vertex)):
        count = int((target.weight[frame] > 0).sum())
        if not count:
            continue
        tree = KDTree(vertex[frame].numpy())
        near = np.asarray(tree.query(target.point[frame, :count].numpy(), k=_CANDIDATES)[1])
        facing = normal[frame][near] * target.towards_camera[frame, :count, None]
        first = (facing.sum(-1) > 0).numpy().argmax(axis=1)
        chosen[frame, :count] = torch.from_numpy(
            np.take_along_axis(near, first[:, None], axis=1)[:, 0]
        )
    return chosen
