"""Damped Gauss-Newton steps for the hands of all frames at once (Levenberg 1944, Marquardt 1963).

The curvature of a sum of squares, or of costs that grow with squares, is known from how points move
with poses. Priors tie a frame to the next two only, so the equations of a step are solved from
pair of frames to pair of frames. A dozen of such steps do what gradient descent needs hundreds for.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.fitting.hands.poses import PosedHands
from physhandi.hand.model import (
    JOINT_COUNT,
    KEYPOINT_BONE,
    PARENT_BONE,
    SHAPE_COUNT,
    HandModel,
)
from physhandi.hand.rotation import left_jacobian
from physhandi.hand.skinning import joint_turns, turn_bones

_ANGLE_COUNT = 3 * JOINT_COUNT
POSE_COUNT = _ANGLE_COUNT + 6
"""Numbers by which a hand is moved in a frame: joints' rotation vectors, then the rotation vector
of a turn about the wrist in the world's frame, then the way of the wrist."""
_REACH = 2
"""Frames over which priors tie one to another."""
_SECOND = (1.0, -2.0, 1.0)
"""Factors of a second difference."""
_DIFFERENCE = 1e-5
"""Step of a shape's component from which the rates of the unposed hand are computed."""
_FLOOR = 1e-9
"""Curvature that is added everywhere: what no term holds does not move."""
_FIRST_DAMPING = 1e-2
"""Damping of the first step, and after none lowered the loss."""
_LEAST_DAMPING = 1e-6
"""A step that lowers the loss is followed by one with a third of its damping, down to this."""
_TRIES = 5
"""Most tries of a step, each with ten times the damping, of which one must lower the loss."""
_ENOUGH = 0.005
"""A step that lowers the loss by less than this, in squares of expected errors, changes nothing."""
_PATIENCE = 4
"""Steps that may together lower the loss by less, where what it compares changes between them."""


@dataclass(frozen=True, eq=False)
class PointRates:
    """How points of posed hands move: three rows for each point, x, y and z [m]."""

    point: Float[Tensor, "frame point 3"]
    """Where they are [m]."""
    pose: Float[Tensor, "frame row pose"]
    """With the pose of their frame."""
    shape: Float[Tensor, "frame row 10"]
    """With the shape before it is bounded."""


@dataclass(frozen=True, eq=False)
class _RestRates:
    """How points of a hand that is not posed move with its bounded shape, at the template's."""

    keypoint: Float[Tensor, "21 3 10"]
    vertex: Float[Tensor, "vertex 3 10"]
    bone: Float[Tensor, "16 3 10"]
    """Where each bone begins."""


@lru_cache(maxsize=4)
@torch.no_grad()
def _rest_rates(model: HandModel) -> _RestRates:
    """Compute the rates of a model by finite differences in double precision.

    Those of other shapes differ by a tenth, which bends a step and not where it ends.
    """

    def points(shape: Float[Tensor, " 10"]) -> tuple[Tensor, Tensor, Tensor]:
        still = shape.new_zeros(1, 3)
        pose = model(shape, shape.new_zeros(1, JOINT_COUNT, 3), still, still)
        return pose.keypoint[0], pose.vertex[0], model.bone_origins(shape)

    template = points(torch.zeros(SHAPE_COUNT, dtype=torch.float64))
    moved = [points(_DIFFERENCE * unit) for unit in torch.eye(SHAPE_COUNT, dtype=torch.float64)]
    rates = (
        (torch.stack(part, -1) - still[..., None]) / _DIFFERENCE
        for part, still in zip(zip(*moved, strict=True), template, strict=True)
    )
    return _RestRates(*(rate.float() for rate in rates))


class PoseRates:
    """How points of hands move with their poses and shape, to first order.

    With poses that is exact for keypoints of the open hand; where several bones hold a vertex, or a
    model bulges with its pose, it is off by some hundredths.
    """

    @torch.no_grad()
    def __init__(self, hands: PosedHands) -> None:
        """Prepare for the hands as they are now.

        Args:
            hands: The hands; their parameters do not change while this is used.
        """
        self._hands, self._rest = hands, _rest_rates(hands.model)
        articulation, shape = hands.parameters["articulation"], hands.shape()
        joint, joint_rate = hands.model.bone_origins(shape), self._rest.bone
        axes = torch.as_tensor(hands.model.joint_axes).to(shape)
        offset, moved = turn_bones(joint_turns(articulation, axes), joint)
        self._bone = offset + torch.eye(3)
        self._origin = (joint + moved)[:, 1:]
        self._axis = self._bone[:, PARENT_BONE] @ axes @ left_jacobian(articulation)
        origin_rate = [torch.zeros(len(articulation), 3, SHAPE_COUNT)]
        for bone, parent in enumerate(PARENT_BONE, start=1):
            arm = joint_rate[bone] - joint_rate[parent]
            origin_rate.append(origin_rate[parent] + self._bone[:, parent] @ arm)
        self._bone_rate = torch.stack(origin_rate, 1) - self._bone @ joint_rate

    @torch.no_grad()
    def keypoints(self) -> PointRates:
        """Compute how the keypoints move."""
        weight = torch.eye(JOINT_COUNT + 1)[KEYPOINT_BONE]
        return self._rates(self._hands.keypoints(), weight, self._rest.keypoint)

    @torch.no_grad()
    def vertices(self, index: Int[Tensor, "frame point"]) -> PointRates:
        """Compute how some vertices of each frame's surface move."""
        weight = torch.as_tensor(self._hands.model.weight, dtype=torch.float32)
        return self._rates(self._hands.vertices(index), weight[index], self._rest.vertex[index])

    def _rates(
        self,
        point: Float[Tensor, "frame point 3"],
        weight: Float[Tensor, "*frame point 16"],
        rate: Float[Tensor, "*frame point 3 10"],
    ) -> PointRates:
        """Compute how posed points move, of which bones hold shares."""
        wrist = self._hands.rotation()[:, None]
        place = self._hands.parameters["translation"]
        # A joint turns what its bone and those beyond it hold.
        fingers = weight[..., 1:].unflatten(-1, (5, 3))
        beyond = fingers.flip(-1).cumsum(-1).flip(-1).flatten(-2)
        axis = wrist[:, None] @ self._axis[:, None]
        arm = (
            point[:, :, None]
            - (self._origin[:, None] @ wrist.transpose(-1, -2))
            - place[:, None, None]
        )
        turned = torch.linalg.cross(axis, arm[..., None], dim=-2) * beyond[..., None, None]
        arm = point - place[:, None]
        identity = torch.eye(3).expand(*arm.shape, 3)
        turned_wrist = torch.linalg.cross(identity, arm[..., None].expand_as(identity), dim=-2)
        blended = (weight @ self._bone.flatten(2)).unflatten(-1, (3, 3))
        change = blended @ rate + (weight @ self._bone_rate.flatten(2)).unflatten(
            -1, (3, SHAPE_COUNT)
        )
        bound = 1 - (self._hands.shape() / 3) ** 2
        return PointRates(
            point,
            torch.cat([turned.movedim(2, 3).flatten(3), turned_wrist, identity], -1).flatten(1, 2),
            (wrist @ change * bound).flatten(1, 2),
        )


class NormalEquations:
    """The curvature of a loss in the poses of all frames and in what they share, and its steps.

    What they share is the shape before it is bounded and, if it is fitted, the logarithm of the
    scale.
    """

    def __init__(self, frame_count: int, *, fits_scale: bool) -> None:
        """Begin without curvature."""
        shared = SHAPE_COUNT + fits_scale
        # Blocks of each frame with itself and with those that follow it.
        self._pose = torch.zeros(_REACH + 1, frame_count, POSE_COUNT, POSE_COUNT)
        self._mixed = torch.zeros(frame_count, POSE_COUNT, shared)
        self._shared = torch.zeros(shared, shared)

    def add_points(
        self,
        rates: PointRates,
        curvature: Float[Tensor, "frame point 3 3"],
        *,
        is_scaled: bool = False,
    ) -> None:
        """Add a term of points, each by itself.

        Args:
            rates: How the points move.
            curvature: Second derivatives of the term in the place of each point [1/m²].
            is_scaled: Whether the term sees the points scaled: if the scale is fitted, they move
                with its logarithm.
        """
        shared = self._shared_rates(rates, is_scaled=is_scaled)
        bent_pose, bent_shared = (
            (curvature @ rate.unflatten(1, (-1, 3))).flatten(1, 2) for rate in (rates.pose, shared)
        )
        turned = rates.pose.transpose(1, 2)
        self._pose[0] += turned @ bent_pose
        self._mixed += turned @ bent_shared
        self._shared += (shared.transpose(1, 2) @ bent_shared).sum(0)

    def add_accelerations(self, rates: PointRates, weight: float) -> None:
        """Add a term that sums the squared second differences of points over time.

        Args:
            rates: How the points move.
            weight: Factor of the sum [1/m²].
        """
        frame_count = len(rates.pose)
        if frame_count <= _REACH:
            return
        shared = self._shared_rates(rates, is_scaled=False)
        # The transpose of a second difference is that of what zeros surround.
        around = torch.zeros_like(shared[:_REACH])
        second = torch.cat([around, torch.diff(shared, _REACH, dim=0), around])
        bent = 2 * weight * torch.diff(second, _REACH, dim=0)
        self._mixed += rates.pose.transpose(1, 2) @ bent
        self._shared += (shared.transpose(1, 2) @ bent).sum(0)
        for after in range(_REACH + 1):
            first, second = rates.pose[: frame_count - after], rates.pose[after:]
            tie = torch.zeros(frame_count - after)
            for at in range(_REACH + 1 - after):
                tie[at : at + frame_count - _REACH] += _SECOND[at] * _SECOND[at + after]
            block = 2 * weight * tie[:, None, None] * (first.transpose(1, 2) @ second)
            self._pose[after, : frame_count - after] += block

    def add_angles(self, curvature: Float[Tensor, "frame 15 3"], tie: float) -> None:
        """Add a term of the joints' rotation vectors, and one of their differences over time.

        Args:
            curvature: Second derivatives of the one in each number [1/rad²].
            tie: Factor of the squared differences from frame to frame, summed [1/rad²].
        """
        neighbors = torch.full((len(curvature), 1), 2.0)
        neighbors[0] -= 1
        neighbors[-1] -= 1
        own = self._pose[0].diagonal(dim1=1, dim2=2)[:, :_ANGLE_COUNT]
        own += curvature.flatten(1) + 2 * tie * neighbors
        self._pose[1, :-1].diagonal(dim1=1, dim2=2)[:, :_ANGLE_COUNT] -= 2 * tie

    def add_shape(self, curvature: float) -> None:
        """Add a term of the shape's components before they are bounded, alike for each."""
        self._shared.diagonal()[:SHAPE_COUNT] += curvature

    def step(
        self,
        slope: Float[Tensor, "frame pose"],
        shared_slope: Float[Tensor, " shared"],
        damping: float,
    ) -> tuple[Float[Tensor, "frame pose"], Float[Tensor, " shared"]] | None:
        """Solve for the step that is downhill and as long as the damped curvature allows.

        Args:
            slope: Derivatives of the loss in the poses.
            shared_slope: In what all frames share.
            damping: Share by which the curvature of each number is taken to be larger.

        Returns:
            The step, or None if rounding left nothing that can be solved.
        """
        pose, shared = self._pose.double(), self._shared.double()
        for matrix in (pose[0], shared):
            diagonal = matrix.diagonal(dim1=-2, dim2=-1)
            diagonal += damping * diagonal + _FLOOR
        mixed = self._mixed.double()
        solved = _solve_blocks(pose, torch.cat([-slope[..., None], mixed], -1))
        if solved is None:
            return None
        alone, coupled = solved[..., 0], solved[..., 1:]
        reduced = shared - torch.einsum("fpi,fpj->ij", mixed, coupled)
        factor, failed = torch.linalg.cholesky_ex(reduced)
        if failed:
            return None
        wanted = -shared_slope - torch.einsum("fpi,fp->i", mixed, alone)
        shared_step = torch.cholesky_solve(wanted[:, None], factor)[:, 0]
        return (alone - coupled @ shared_step).float(), shared_step.float()

    def _shared_rates(
        self, rates: PointRates, *, is_scaled: bool
    ) -> Float[Tensor, "frame row shared"]:
        if len(self._shared) == SHAPE_COUNT:
            return rates.shape
        grown = rates.point if is_scaled else torch.zeros_like(rates.point)
        return torch.cat([rates.shape, grown.flatten(1)[..., None]], -1)


def _solve_blocks(
    pose: Float[Tensor, "3 frame pose pose"], right: Float[Tensor, "frame pose column"]
) -> Float[Tensor, "frame pose column"] | None:
    """Solve equations that tie each frame to the next two, by Cholesky's method.

    Two frames make a block, which is tied to the next block alone.
    """
    frame_count, size, columns = right.shape
    if frame_count % 2:  # One more frame, which stays.
        pose = torch.cat([pose, torch.zeros_like(pose[:, :1])], 1)
        pose[0, -1] = torch.eye(size)
        right = torch.cat([right, torch.zeros_like(right[:1])])
    near, far = pose[1], pose[2]
    own = torch.cat(
        [
            torch.cat([pose[0, ::2], near[::2]], -1),
            torch.cat([near[::2].transpose(1, 2), pose[0, 1::2]], -1),
        ],
        1,
    )
    nothing = torch.zeros_like(far[::2])
    tie = torch.cat([torch.cat([far[::2], nothing], -1), torch.cat([near[1::2], far[1::2]], -1)], 1)
    wanted = right.reshape(len(own), 2 * size, columns)
    factors, ties, halves = [], [], []
    for block in range(len(own)):
        left, value = own[block], wanted[block]
        if block:
            left = left - ties[-1].T @ ties[-1]
            value = value - ties[-1].T @ halves[-1]
        factor, failed = torch.linalg.cholesky_ex(left)
        if failed:
            return None
        half = torch.linalg.solve_triangular(
            factor, torch.cat([value, tie[block]], -1), upper=False
        )
        factors.append(factor)
        halves.append(half[:, :columns])
        ties.append(half[:, columns:])
    solved = [torch.linalg.solve_triangular(factors[-1].T, halves[-1], upper=True)]
    for block in reversed(range(len(own) - 1)):
        value = halves[block] - ties[block] @ solved[-1]
        solved.append(torch.linalg.solve_triangular(factors[block].T, value, upper=True))
    return torch.stack(solved[::-1]).reshape(-1, size, columns)[:frame_count]


class DampedSteps:
    """Steps that each lower a loss, and what the next one depends on."""

    def __init__(self, parameters: Mapping[str, Tensor], *, fits_scale: bool) -> None:
        """Begin with little damping.

        Args:
            parameters: Of hands, as `PosedHands` has them, and ``log_scale``; they are changed.
            fits_scale: Whether the scale is fitted, too.
        """
        self._parameters, self._fits_scale = parameters, fits_scale
        self._damping = _FIRST_DAMPING
        self._losses = np.full(_PATIENCE + 1, np.inf)
        self._is_idle = False

    @property
    def changes_nothing(self) -> bool:
        """Whether another step is not worth its time."""
        return self._is_idle or bool(self._losses[1:].min() > self._losses[0] - _ENOUGH)

    def update(
        self, loss: Callable[[], Tensor], curvature: Callable[[], NormalEquations]
    ) -> Tensor:
        """Make a step, if one is found that lowers the loss.

        Args:
            loss: Computes the loss of the parameters as they are.
            curvature: Computes its curvature.

        Returns:
            The loss after it.
        """
        with torch.no_grad():
            rotation = self._parameters["rotation"]
            rotation /= rotation.norm(dim=-1, keepdim=True)
        before, slopes = self._slopes(loss)
        after = self._lowered(before, slopes, curvature(), loss)
        self._is_idle = bool(before - after < _ENOUGH)
        self._losses = np.append(self._losses[1:], float(after))
        return after

    def _lowered(
        self,
        before: Tensor,
        slopes: tuple[Tensor, Tensor],
        equations: NormalEquations,
        loss: Callable[[], Tensor],
    ) -> Tensor:
        """Make the first step that lowers the loss, with more and more damping; give the loss."""
        start = {name: value.clone() for name, value in self._parameters.items()}
        for _ in range(_TRIES):
            step = equations.step(*slopes, self._damping)
            if step is not None:
                self._set(_moved(start, *step))
                with torch.no_grad():
                    after = loss()
                if after < before:
                    self._damping = max(self._damping / 3, _LEAST_DAMPING)
                    return after
            self._damping *= 10
        self._set(start)
        self._damping = _FIRST_DAMPING
        return before

    def state(self) -> dict[str, ndarray]:
        """Copy everything that the next steps depend on, the parameters included."""
        state = {f"step.{name}": value.numpy().copy() for name, value in self._parameters.items()}
        return state | {"step.damping": np.array([self._damping]), "step.losses": self._losses}

    def restore(self, state: Mapping[str, ndarray]) -> None:
        """Return to what `state` gave."""
        self._set({name: torch.from_numpy(state[f"step.{name}"]) for name in self._parameters})
        self._damping = float(state["step.damping"][0])
        self._losses = state["step.losses"]

    def _set(self, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            self._parameters[name].copy_(value)

    def _slopes(self, loss: Callable[[], Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Compute the loss, and its derivatives in the poses and in what all frames share."""
        for value in self._parameters.values():
            value.requires_grad_()
            value.grad = None
        value = loss()
        value.backward()
        gradient: dict[str, Tensor] = {}
        for name, parameter in self._parameters.items():
            assert parameter.grad is not None  # noqa: S101 - every loss depends on all of them
            gradient[name] = parameter.grad
            parameter.grad = None
            parameter.requires_grad_(False)
        x, y, z, w = self._parameters["rotation"].unbind(-1)
        turns = ((w, -z, y, -x), (z, w, -x, -y), (-y, x, w, -z))
        turn = [(gradient["rotation"] * torch.stack(half, -1)).sum(-1) / 2 for half in turns]
        pose = [gradient["articulation"].flatten(1), torch.stack(turn, -1), gradient["translation"]]
        shared = [gradient["shape"], gradient["log_scale"][None]][: 1 + self._fits_scale]
        return value.detach(), (torch.cat(pose, -1).double(), torch.cat(shared).double())


def _moved(
    parameters: Mapping[str, Tensor],
    step: Float[Tensor, "frame pose"],
    shared_step: Float[Tensor, " shared"],
) -> dict[str, Tensor]:
    """Make a step of hands: new parameters, quaternions of length 1."""
    angles, turn, way = step.split([_ANGLE_COUNT, 3, 3], dim=1)
    rotation = Rotation.from_quat(parameters["rotation"].numpy())
    turned = (Rotation.from_rotvec(turn.numpy()) * rotation).as_quat()
    return {
        "shape": parameters["shape"] + shared_step[:SHAPE_COUNT],
        "articulation": parameters["articulation"] + angles.unflatten(1, (JOINT_COUNT, 3)),
        "rotation": torch.tensor(turned, dtype=torch.float32),
        "translation": parameters["translation"] + way,
        "log_scale": parameters["log_scale"] + shared_step[SHAPE_COUNT:].sum(),
    }
