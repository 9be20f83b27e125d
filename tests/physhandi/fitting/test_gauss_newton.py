"""Steps of Gauss and Newton for hands against finite differences, Hessians and dense algebra."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray
from support.physics import hand_scene as scene
from torch import Tensor

from physhandi.fitting.hand_reconstruction import HandFitConfig, reconstruct_hands
from physhandi.fitting.hands import losses
from physhandi.fitting.hands.gauss_newton import (
    POSE_COUNT,
    DampedSteps,
    NormalEquations,
    PointRates,
    PoseRates,
    _moved,
)
from physhandi.fitting.hands.observed import FreeSpace, KeypointTarget
from physhandi.fitting.hands.poses import PosedHands
from physhandi.hand.loading import load_hand_model
from physhandi.hand.names import HandSide
from physhandi.hand.rotation import left_jacobian, rotation_matrix
from physhandi.progress import NullProgress

SHARED = 11


def _parameters(count: int, seed: int = 0) -> dict[str, Tensor]:
    random = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random)

    rotation = drawn(count, 4)
    return {
        "shape": drawn(10),
        "articulation": 0.4 * drawn(count, 15, 3),
        "rotation": rotation / rotation.norm(dim=-1, keepdim=True),
        "translation": drawn(count, 3),
        "log_scale": torch.tensor(0.3),
    }


def test_a_rotation_turns_on_as_the_left_jacobian_says() -> None:
    vector = torch.tensor([[0.0, 0.0, 0.0], [1e-3, 0.0, 2e-3], [0.7, -1.1, 0.4], [2.0, 1.5, -1.0]])
    vector, step = vector.double(), 1e-6
    jacobian = left_jacobian(vector)
    for component in range(3):
        further = rotation_matrix(vector + step * torch.eye(3).double()[component])
        turn = (further @ rotation_matrix(vector).transpose(-1, -2) - torch.eye(3)) / step
        found = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
        assert found.numpy() == pytest.approx(jacobian[..., component].numpy(), abs=1e-5)
        assert found.abs().max() > 0.5


@pytest.mark.parametrize("side", ["right", "left"])
def test_points_move_with_pose_and_shape_as_differences_say(side: HandSide) -> None:
    # Rates with the shape are those of the template's.
    parameters, step = _parameters(2) | {"shape": torch.zeros(10)}, 2e-3
    hands = PosedHands(load_hand_model(side), parameters)
    vertex = torch.randint(0, 1159, (2, 60), generator=torch.Generator().manual_seed(1))
    rates = PoseRates(hands)

    def differences(points: str) -> tuple[ndarray, ndarray]:
        def at(pose: Tensor, shared: Tensor) -> Tensor:
            moved = PosedHands(hands.model, _moved(parameters, pose, shared))
            return (moved.keypoints() if points == "keypoints" else moved.vertices(vertex)).flatten(
                1
            )

        still = torch.zeros(2, POSE_COUNT), torch.zeros(SHARED)
        columns = []
        for number in range(POSE_COUNT):
            unit = step * torch.eye(POSE_COUNT)[number].expand(2, -1)
            columns.append((at(unit, still[1]) - at(-unit, still[1])) / (2 * step))
        shape = [
            (at(still[0], unit) - at(still[0], -unit)) / (20 * step)
            for unit in 10 * step * torch.eye(SHARED)[:10]
        ]
        return torch.stack(columns, -1).numpy(), torch.stack(shape, -1).numpy()

    keypoints = rates.keypoints()
    for found, expected in zip(
        (keypoints.pose, keypoints.shape), differences("keypoints"), strict=True
    ):
        assert found.numpy() == pytest.approx(expected, abs=2e-4)
    assert keypoints.pose.abs().max() > 0.1
    assert keypoints.shape.abs().max() > 0.005
    vertices = rates.vertices(vertex)
    for found, expected in zip(
        (vertices.pose, vertices.shape), differences("vertices"), strict=True
    ):
        # Where several bones hold a vertex, each is taken to carry it from where it is.
        assert np.linalg.norm(found.numpy() - expected) < 0.05 * np.linalg.norm(expected)


def _rates(frames: int, points: int, seed: int) -> PointRates:
    random = np.random.default_rng(seed)

    def drawn(columns: int) -> Tensor:
        return torch.tensor(random.normal(size=(frames, 3 * points, columns)), dtype=torch.float32)

    place = torch.tensor(random.normal(size=(frames, points, 3)), dtype=torch.float32)
    return PointRates(place, drawn(POSE_COUNT), drawn(10))


@pytest.mark.parametrize("fits_scale", [False, True])
@pytest.mark.parametrize("frames", [1, 2, 3, 6])
def test_a_step_is_that_of_the_dense_equations(frames: int, fits_scale: bool) -> None:
    random = np.random.default_rng(frames)
    points, shared = 5, 10 + fits_scale
    rates, damping = _rates(frames, points, 1), 0.1
    half = torch.tensor(random.normal(size=(frames, points, 3, 3)), dtype=torch.float32)
    curvature = half @ half.transpose(-1, -2)
    place = rates.point
    angles = torch.tensor(random.uniform(0.5, 2.0, size=(frames, 15, 3)), dtype=torch.float32)
    equations = NormalEquations(frames, fits_scale=fits_scale)
    equations.add_points(rates, curvature, is_scaled=True)
    equations.add_accelerations(rates, 0.7)
    equations.add_angles(angles, 0.4)
    equations.add_shape(3.0)

    size = frames * POSE_COUNT
    dense = np.zeros((size + shared, size + shared))

    def rows(frame: int, grown: Tensor | None) -> ndarray:
        """Rates of a frame's points with everything."""
        row = np.zeros((3 * points, size + shared))
        row[:, frame * POSE_COUNT : (frame + 1) * POSE_COUNT] = rates.pose[frame]
        row[:, size : size + 10] = rates.shape[frame]
        if grown is not None and fits_scale:
            row[:, -1] = grown[frame].flatten()
        return row

    for frame in range(frames):
        for point in range(points):
            own = rows(frame, place)[3 * point : 3 * point + 3]
            dense += own.T @ curvature[frame, point].double().numpy() @ own
    for frame in range(2, frames):
        second = rows(frame, None) - 2 * rows(frame - 1, None) + rows(frame - 2, None)
        dense += 2 * 0.7 * second.T @ second
    for frame in range(frames):
        for number in range(45):
            at = frame * POSE_COUNT + number
            dense[at, at] += angles[frame].flatten()[number]
            if frame:
                change = np.zeros(size + shared)
                change[at], change[at - POSE_COUNT] = 1.0, -1.0
                dense += 2 * 0.4 * np.outer(change, change)
    dense[range(size, size + 10), range(size, size + 10)] += 3.0
    dense[np.diag_indices(len(dense))] += damping * np.diag(dense) + 1e-9

    slope = random.normal(size=size + shared)
    expected = -np.linalg.solve(dense, slope)
    found = equations.step(
        torch.from_numpy(slope[:size].reshape(frames, POSE_COUNT)),
        torch.from_numpy(slope[size:]),
        damping,
    )
    assert found is not None
    step = np.concatenate([found[0].flatten().numpy(), found[1].numpy()])
    assert step == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())


def test_equations_that_cannot_be_solved_have_no_step() -> None:
    equations = NormalEquations(4, fits_scale=False)
    equations.add_shape(-1.0)
    assert equations.step(torch.ones(4, POSE_COUNT).double(), torch.ones(10).double(), 0.0) is None
    equations.add_shape(3.0)
    equations.add_angles(torch.full((4, 15, 3), -1.0), 0.0)
    assert equations.step(torch.ones(4, POSE_COUNT).double(), torch.ones(10).double(), 0.0) is None


def _hessians(loss: Callable[[Tensor], Tensor], point: Tensor) -> ndarray:
    """Second derivatives of a loss in the place of each point, by automatic differentiation."""
    found = np.zeros((*point.shape, 3))
    for frame, number in np.ndindex(*point.shape[:2]):

        def moved(way: Tensor, at: tuple[int, int] = (frame, number)) -> Tensor:
            shifted = point.clone()
            shifted[at] = shifted[at] + way
            return loss(shifted)

        found[frame, number] = torch.autograd.functional.hessian(moved, torch.zeros(3).to(point))
    return found


def _target(point: Tensor, off: float) -> KeypointTarget:
    """Keypoints that two views see, wrong by so many pixels."""
    cameras = [scene.looking_at_hand(angle) for angle in (0.0, 1.2)]
    projection = torch.tensor(np.stack([c.K @ c.T_camera_world[:3] for c in cameras])).float()
    seen = losses._projected(point, projection)
    weight = torch.linspace(0.2, 1.0, seen[..., 0].numel()).reshape(seen.shape[:-1])
    pixel = seen[..., :2] / seen[..., 2:] + torch.tensor([off, -0.5 * off])
    return KeypointTarget(pixel, weight, torch.tensor([2.0, 3.0]), projection)


def test_curvatures_of_what_is_met_are_the_hessians() -> None:
    random = np.random.default_rng(5)
    point = torch.tensor(random.normal(scale=0.05, size=(2, 21, 3)), dtype=torch.float32)
    target = _target(point, 0.0)
    expected = _hessians(lambda p: losses.reprojection_loss(p, target, 3.0), point)
    found = losses.reprojection_curvature(point, target, 3.0).numpy()
    assert found == pytest.approx(expected, rel=2e-3, abs=1e-3 * np.abs(expected).max())
    assert np.abs(expected).max() > 1e4

    normal = torch.nn.functional.normalize(torch.tensor(random.normal(size=(2, 21, 3))), dim=-1)
    weight = torch.full((2, 21), 1 / 21).double()
    weight[1] = 0.0  # A frame without measured points.
    still = torch.zeros(2, 21, 3).double()
    expected = _hessians(
        lambda offset: losses.distance_loss(offset, normal, weight, 0.004), still + 1e-9
    )
    found = losses.distance_curvature(still, normal, weight, 0.004).numpy()
    assert found == pytest.approx(expected, rel=1e-3, abs=1.0)
    assert expected[0, 0].max() > 1e3

    model = load_hand_model("left")
    bent = torch.tensor(random.normal(size=(3, 15, 3)), dtype=torch.float32)
    expected = torch.autograd.functional.hessian(lambda a: losses.limit_loss(a, model), bent)
    own = expected.reshape(135, 135).diagonal().reshape(3, 15, 3)
    assert losses.limit_curvature(bent, model).numpy() == pytest.approx(own.numpy())
    assert 0 < (own > 0).sum() < own.numel()


def test_what_is_far_off_bends_the_loss_less() -> None:
    point = torch.zeros(1, 21, 3)
    met = losses.reprojection_curvature(point, _target(point, 0.0), 3.0)
    off = losses.reprojection_curvature(point, _target(point, 12.0), 3.0)
    # Of Cauchy's loss, of 12 px to the right and 6 px up in two views that err by 2 and 3 px.
    factors = [1 / (1 + 12.0**2 * 1.25 / noise**2 / 9.0) for noise in (2.0, 3.0)]
    ratio = float(off[0, 3].trace() / met[0, 3].trace())
    assert min(factors) < ratio < max(factors)

    depth = torch.full((1, 1, 8, 8), 0.5)
    space = FreeSpace(
        depth=depth,
        corner=torch.tensor([[[-4.0, -4.0]]]),
        step=torch.ones(1, 1),
        projection=torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]]),
    )
    before = torch.zeros(1, 21, 3)
    before[..., 2] = torch.linspace(0.48, 0.52, 21)
    curvature = losses.free_space_curvature(before, space, 0.004)[0]
    # A keypoint 3 mm under the surface is where it may be.
    way = 0.503 - before[0, :, 2]
    expected = torch.where(way > 0, 2 / 0.004**2 / (1 + (way / 0.012) ** 2), 0.0)
    assert curvature[:, 2, 2].numpy() == pytest.approx(expected.numpy(), rel=1e-4)
    assert curvature[:, :2].abs().max() == 0.0
    assert float(losses.free_space_loss(before, space, 0.004)) > 0.0


def test_slopes_are_those_of_the_way_in_which_a_step_goes() -> None:
    parameters = _parameters(3, seed=4)
    hands = PosedHands(load_hand_model("right"), parameters)
    towards = torch.randn(3, 21, 3, generator=torch.Generator().manual_seed(9))

    def loss(given: PosedHands = hands) -> Tensor:
        scale = given.parameters["log_scale"].exp()
        return (given.keypoints() * scale * towards).sum() + (given.parameters["shape"] ** 2).sum()

    steps = DampedSteps(parameters, fits_scale=True)
    value, (slope, shared_slope) = steps._slopes(loss)
    assert value == loss()
    random = torch.Generator().manual_seed(2)
    for _ in range(3):
        way = torch.randn(3, POSE_COUNT, generator=random), torch.randn(SHARED, generator=random)

        def at(length: float, way: tuple[Tensor, Tensor] = way) -> float:
            moved = _moved(parameters, length * way[0], length * way[1])
            return float(loss(PosedHands(hands.model, moved)))

        expected = (at(1e-3) - at(-1e-3)) / 2e-3
        found = float((slope * way[0]).sum() + (shared_slope * way[1]).sum())
        assert found == pytest.approx(expected, rel=5e-3, abs=0.05)
        assert abs(expected) > 1.0


def test_no_step_is_made_where_none_lowers_the_loss() -> None:
    parameters = _parameters(2)
    before = {name: value.clone() for name, value in parameters.items()}
    values = iter([1.0, *[2.0] * 100])

    def loss() -> Tensor:
        return sum(value.sum() for value in parameters.values()) * 0.0 + next(values)

    def curvature() -> NormalEquations:
        equations = NormalEquations(2, fits_scale=True)
        equations.add_angles(torch.ones(2, 15, 3), 0.0)
        return equations

    steps = DampedSteps(parameters, fits_scale=True)
    assert float(steps.update(loss, curvature)) == 1.0
    assert steps.changes_nothing
    for name, value in parameters.items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize("metric", [True, False])
def test_a_dozen_steps_come_nearer_than_hundreds_of_updates_of_gradient_descent(
    tmp_path: Path, metric: bool
) -> None:
    scale = 1.0 if metric else 20.0
    truth = scene.grasping(frames=5, scale=scale)
    cameras = []
    for camera in (scene.looking_at_hand(angle) for angle in (0.0, 1.2, 2.6)):
        pose = camera.T_world_camera.copy()
        pose[:3, 3] *= scale
        fields = {**camera.to_dict(), "T_world_camera": pose.tolist()}
        cameras.append(type(camera).from_dict(fields))
    keypoint = scene.seen_keypoints([truth], cameras)
    keypoint[..., :2] += np.random.default_rng(3).normal(size=keypoint[..., :2].shape)
    sequence = scene.write_scene(tmp_path / "a", [truth], cameras, keypoint, metric=metric)
    told: list[tuple[int, int]] = []

    class Heard(NullProgress):
        def report(
            self,
            stage: str,
            iteration: int,
            total: int,
            loss: float | None = None,
            message: str = "",
        ) -> None:
            told.append((iteration, total))

    steps = reconstruct_hands(sequence, HandFitConfig(), Heard())
    # Steps are counted as they are made, and in the end there are no more.
    count = len(steps.curve)
    assert told == [*((number, 40) for number in range(1, count)), (count, count)]
    descent = reconstruct_hands(sequence, HandFitConfig(gauss_newton=False, iterations=300))
    assert steps.loss_after < descent.loss_after
    assert steps.curve[-1][0] == len(steps.curve) < 30
