"""Stage 3 on small rigs: gradients, known errors, and what it does when things go wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference.spring_mass import Scene, simulate
from scipy.spatial.transform import Rotation
from support.physics.hand_scene import grasping, looking_at_hand, seen_keypoints
from support.physics.refinement_world import SOFT, held_patch, moved, mpjpe
from support.physics.stopped_fits import check_resumed, write_always

from physhandi.data.checkpoint import Checkpointer
from physhandi.errors import CancelledError, SettingsError, SimulationDivergedError
from physhandi.fitting import hand_refinement
from physhandi.fitting.hand_refinement import (
    Refinement,
    RefinementConfig,
    RefinementProblem,
    refine_hands,
)
from physhandi.fitting.hands.observed import keypoint_target
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

FREE = RefinementConfig(
    prior_weight=0.0, smoothness_weight=0.0, keypoint_weight=0.0, window=None, iterations=30
)
"""Nothing but the object's motion decides."""
STILL = replace(grasping(frames=1), shape=np.zeros(10))


def standing(frames: int) -> HandMotion:
    """A hand that holds still."""
    repeated = {
        name: np.repeat(getattr(STILL, name), frames, axis=0)
        for name in ("articulation", "wrist_rotation", "wrist_translation")
    }
    return replace(STILL, **repeated)


def two_hands(frames: int) -> tuple[HandMotion, HandMotion]:
    left = moved(grasping("left", frames=frames), (0.02, 0.15, 0.01))
    return grasping("right", frames=frames), left


def disturbed(motion: HandMotion, seed: int, size: float = 0.02) -> HandMotion:
    random = np.random.default_rng(seed)
    noise = random.normal(0, size, motion.articulation.shape)
    return replace(
        moved(motion, (0.004, -0.003, 0.002)),
        articulation=(motion.articulation + noise).astype(np.float32),
    )


def oracle_loss(
    problem: RefinementProblem, offset: list[dict[str, np.ndarray]], config: RefinementConfig
) -> float:
    """Everything that is minimised, in float64 NumPy but for the skinning."""
    fitted = problem.object_.frame_count
    surfaces, total = [], 0.0
    for number, (motion, model) in enumerate(
        zip(problem.motions, problem.hand_models, strict=True)
    ):
        nothing = {name: np.zeros_like(value) for name, value in offset[number].items()}
        (vertex, joint), (before, _) = (
            posed(motion, model, o, fitted) for o in (offset[number], nothing)
        )
        gap = vertex - before
        total += config.prior_weight * (gap**2).sum(2).mean()
        total += config.smoothness_weight * (np.diff(gap, axis=0) ** 2).sum(2).mean()
        if config.keypoint_weight:
            total += config.keypoint_weight * seen_from_cameras(problem.targets[number], joint)
        surfaces.append(vertex)
    control = np.concatenate(surfaces, axis=1)
    control = control if problem.chosen is None else control[:, problem.chosen]
    model, parameters = problem.model, problem.parameters
    # Control nodes that hold nothing are left out, for speed.
    holding, end = np.unique(model.spring_nodes[model.object_spring_count :], return_inverse=True)
    is_control = holding >= model.node_count
    number_of = np.where(is_control, model.node_count + np.cumsum(is_control) - 1, holding)
    springs = model.spring_nodes.copy()
    springs[model.object_spring_count :] = number_of[end].reshape(-1, 2)
    control = control[:, holding[is_control] - model.node_count]
    scene = Scene(
        node=model.object_node.astype(float),
        velocity=model.initial_velocity.astype(float),
        springs=springs,
        rest=model.rest_length.astype(float),
        stiffness=model.stiffness.astype(float),
        damping=model.damping.astype(float),
        control=control,
        drag=parameters.drag,
        restitution=parameters.restitution,
        friction=parameters.friction,
        ground=parameters.ground_height,
        gravity=parameters.gravity,
        substeps=parameters.substeps_per_frame,
    )
    node = simulate(scene)[0]
    observed = problem.object_.track.double().numpy()
    losses = []
    for frame in range(1, fitted):
        distance = ((observed[frame][:, None] - node[frame][None]) ** 2).sum(2)
        track = ((observed[frame] - node[frame]) ** 2).sum(1).mean()
        losses.append(distance.min(axis=1).mean() + config.track_weight * track)
    return total + float(np.mean(losses))


def posed(motion: Any, model: Any, offset: dict[str, np.ndarray], frames: int) -> tuple:
    """Vertices and joints of a corrected hand, its wrist placed by SciPy."""
    articulation = torch.from_numpy(
        motion.articulation[:frames].astype(np.float32).astype(float) + offset["articulation"]
    )
    still = torch.zeros(frames, 3, dtype=torch.float64)
    shape = torch.from_numpy(motion.shape.astype(np.float32).astype(float))
    hand = model(shape, articulation, still, still)
    turn = Rotation.from_rotvec(motion.wrist_rotation[:frames].astype(np.float32)) * (
        Rotation.from_rotvec(offset["rotation"])
    )
    place = motion.wrist_translation[:frames].astype(np.float32) + offset["translation"]
    return tuple(
        np.stack([r.apply(p) + t for r, p, t in zip(turn, points, place, strict=True)])
        for points in (hand.vertex.numpy(), hand.keypoint.numpy())
    )


def seen_from_cameras(target: Any, joint: np.ndarray) -> float:
    """Cauchy's loss of the distance to the seen keypoints, c = 3 expected errors."""
    total = 0.0
    for view, matrix in enumerate(target.projection.double().numpy()):
        image = np.concatenate([joint, np.ones_like(joint[..., :1])], -1) @ matrix.T
        gap = image[..., :2] / image[..., 2:] - target.pixel[view].double().numpy()
        squared = (gap**2).sum(-1) / float(target.noise[view]) ** 2
        total += (target.weight[view].double().numpy() * 9 * np.log1p(squared / 9)).sum()
    return total / len(joint)


def with_targets(problem: RefinementProblem, frames: int) -> RefinementProblem:
    cameras = [looking_at_hand(0.0), looking_at_hand(1.5)]
    keypoint = seen_keypoints(list(problem.motions), cameras, noise=4.0)[:, :frames]
    targets = tuple(
        keypoint_target(cameras, keypoint[:, :, hand], 0.015)
        for hand in range(len(problem.motions))
    )
    return replace(problem, targets=targets)


FALLING = SOFT.replace(gravity=9.81, ground_height=0.06)
"""The same rig with weight, above a ground that some of its nodes hit and slide on."""


@pytest.mark.parametrize(
    ("every", "parameters"),
    [(1, SOFT), (3, FALLING)],
    ids=["all vertices", "a third of them, on the ground"],
)
def test_the_gradient_agrees_with_central_differences_in_float64(
    every: int, parameters: SimulationParameters
) -> None:
    truth = two_hands(frames=5)
    seen = tuple(disturbed(motion, seed) for seed, motion in enumerate(truth))
    posed_patch = held_patch(truth, seen, fitted=4, every=every, parameters=parameters)
    problem = with_targets(posed_patch, 4)
    config = FREE.replace(prior_weight=0.3, smoothness_weight=0.7, keypoint_weight=1e-7)
    random = np.random.default_rng(3)
    refinement = Refinement(problem, config, "cpu")
    offset = []
    for hand in refinement.hands:
        size = {"articulation": 0.02, "rotation": 0.02, "translation": 0.002}
        drawn = {n: torch.tensor(random.normal(0, size[n], v.shape)) for n, v in hand.value.items()}
        hand.restore({name: value.float() for name, value in drawn.items()})
        offset.append({n: v.detach().double().numpy() for n, v in hand.value.items()})
    refinement.evaluate()
    total = 0.0
    for number, hand in enumerate(refinement.hands):
        for name, value in hand.value.items():
            assert value.grad is not None
            found = value.grad.double().numpy()
            scale = np.abs(found).max()
            frame = np.unravel_index(np.abs(found).argmax(), found.shape)
            picked = [frame, tuple(random.integers(n) for n in found.shape)]
            for index in picked:
                change = []
                for sign in (1.0, -1.0):
                    other = [
                        {n: v.copy() for n, v in hand_offset.items()} for hand_offset in offset
                    ]
                    other[number][name][index] += sign * 1e-6
                    change.append(oracle_loss(problem, other, config))
                expected = (change[0] - change[1]) / 2e-6
                assert found[index] == pytest.approx(expected, abs=1e-3 * scale), (name, index)
            total += scale
    assert total > 1e-3


def test_a_shift_of_the_whole_hand_is_found_with_its_sign_and_size() -> None:
    # Nothing else acts on the nodes, so in rest they are displaced as the hand is.
    truth, shift = standing(8), (0.006, -0.004, 0.003)
    problem = held_patch((truth,), (moved(truth, shift),), fitted=8)
    config = FREE.replace(rotation_rate=0.0, articulation_rate=0.0, iterations=40)
    result = refine_hands(problem, config, NullProgress())
    found = result.motions[0].wrist_translation - problem.motions[0].wrist_translation
    np.testing.assert_allclose(found[2:].mean(axis=0), -np.array(shift), atol=3e-4)
    rest = float(np.sum(np.square(shift)))
    # Chamfer and track term each see the whole displacement, once the nodes have followed.
    assert result.loss_before == pytest.approx(2 * rest, rel=0.35)
    assert result.loss_after < 0.05 * result.loss_before


def test_hands_that_explain_everything_are_left_alone() -> None:
    truth = two_hands(frames=6)
    problem = held_patch(truth, truth, fitted=5)
    result = refine_hands(problem, FREE.replace(iterations=6), NullProgress())
    assert result.loss_before < 1e-12
    for before, after in zip(problem.motions, result.motions, strict=True):
        np.testing.assert_allclose(after.wrist_translation, before.wrist_translation, atol=1e-7)
        np.testing.assert_allclose(after.articulation, before.articulation, atol=1e-6)
    np.testing.assert_allclose(result.control, problem.object_.control, atol=1e-6)


def test_the_result_is_simulated_from_what_is_returned() -> None:
    truth = (grasping(frames=8),)
    problem = held_patch(truth, (moved(truth[0], (0.005, 0.0, 0.0)),), fitted=6, every=2)
    result = refine_hands(problem, FREE, NullProgress())
    assert result.loss_after < 0.5 * result.loss_before
    assert [row[0] for row in result.curve] == list(range(31))
    control = control_trajectory(result.motions, problem.hand_models)[:, ::2]
    np.testing.assert_array_equal(result.control, control)
    node = Simulator(problem.model, problem.parameters).rollout(control).position[:6]
    losses = problem.object_.frame_losses(torch.from_numpy(node)[1:])
    assert float(losses.mean()) == pytest.approx(result.loss_after, rel=1e-6)


def test_frames_that_are_not_fitted_fade_to_stage_1() -> None:
    truth = (grasping(frames=10),)
    problem = held_patch(truth, (moved(truth[0], (0.005, 0.0, 0.0)),), fitted=6)
    config = FREE.replace(carry_time=0.1, iterations=15)
    after = refine_hands(problem, config, NullProgress()).motions[0]
    found = after.wrist_translation - problem.motions[0].wrist_translation
    assert np.linalg.norm(found[5]) > 1e-3
    # 0.1 s are three frames.
    expected = found[5] * np.exp(-np.arange(5) / 3)[:, None]
    np.testing.assert_allclose(found[5:], expected, atol=2e-7)


def test_later_frames_of_the_hands_do_not_change_earlier_corrections() -> None:
    truth = (grasping(frames=10),)
    seen = moved(truth[0], (0.005, 0.0, 0.0))
    later = seen.wrist_translation.copy()
    later[6:] += 0.003
    results = [
        refine_hands(
            held_patch(truth, (replace(seen, wrist_translation=place),), fitted=6),
            FREE.replace(iterations=4),
            NullProgress(),
        )
        for place in (seen.wrist_translation, later)
    ]
    one, other = (result.motions[0] for result in results)
    np.testing.assert_array_equal(one.wrist_translation[:6], other.wrist_translation[:6])
    np.testing.assert_array_equal(one.articulation[:6], other.articulation[:6])
    assert results[0].curve == results[1].curve


def test_keypoints_keep_a_hand_in_the_images() -> None:
    truth = (grasping(frames=6),)
    wrong_object = (moved(truth[0], (0.0, 0.006, 0.0)),)
    problem = with_targets(held_patch(wrong_object, truth, fitted=6), 6)
    config = FREE.replace(iterations=15)
    free = refine_hands(problem, config, NullProgress())
    held = refine_hands(problem, config.replace(keypoint_weight=1e-5), NullProgress())
    assert mpjpe(free.motions[0], truth[0]) > 2 * mpjpe(held.motions[0], truth[0])
    assert mpjpe(free.motions[0], truth[0]) > 0.003


class Listener(Progress):
    """Remembers what it was told."""

    def __init__(self, patience: int = 1000) -> None:
        self.told: list[tuple[int, str]] = []
        self.patience = patience

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        assert stage == "hand_refinement"
        self.told.append((iteration, message))

    def check_cancelled(self) -> None:
        if len(self.told) >= self.patience:
            raise CancelledError


def diverges(*, at: set[int], real: Any) -> Any:
    """Call the real function, but for the calls that are to diverge."""
    count = iter(range(10_000))

    def call(*args: Any, **more: Any) -> Any:
        if next(count) in at:
            raise SimulationDivergedError("node 3 ran away", frame=2, substep=1, node=3)
        return real(*args, **more)

    return call


def test_a_step_into_divergence_is_taken_back_and_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = (grasping(frames=6),)
    problem = held_patch(truth, (moved(truth[0], (0.005, 0.0, 0.0)),), fitted=6)
    rollout = hand_refinement.differentiable.rollout
    seen: list[np.ndarray] = []

    def watched(*args: Any, **more: Any) -> Any:
        seen.append(args[2].detach().numpy().copy())
        return rollout(*args, **more)

    broken = diverges(at={1}, real=watched)
    monkeypatch.setattr(hand_refinement.differentiable, "rollout", broken)
    listener = Listener()
    result = refine_hands(problem, FREE.replace(iterations=5), listener)
    assert [iteration for iteration, _ in listener.told] == list(range(6))
    assert [n for n, (_, message) in enumerate(listener.told) if "ran away" in message] == [1]
    # The second evaluation that came to an end is that of the unrefined hands again.
    np.testing.assert_array_equal(seen[0], seen[1])
    halved = np.abs(seen[2] - seen[0]).max()
    monkeypatch.setattr(hand_refinement.differentiable, "rollout", watched)
    seen.clear()
    refine_hands(problem, FREE.replace(iterations=1), NullProgress())
    whole = np.abs(seen[1] - seen[0]).max()
    assert halved == pytest.approx(0.5 * FREE.decay * whole, rel=0.02)
    assert result.loss_after < result.loss_before


def test_hands_that_diverge_from_the_start_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = (grasping(frames=4),)
    problem = held_patch(truth, truth, fitted=4)
    broken = diverges(at={0}, real=hand_refinement.differentiable.rollout)
    monkeypatch.setattr(hand_refinement.differentiable, "rollout", broken)
    with pytest.raises(SimulationDivergedError, match="ran away"):
        refine_hands(problem, FREE, NullProgress())


@pytest.mark.parametrize(("failures", "share"), [(2, 0.25), (4, 0.0)])
def test_a_correction_that_diverges_later_is_halved_and_at_last_dropped(
    monkeypatch: pytest.MonkeyPatch, failures: int, share: float
) -> None:
    truth = (grasping(frames=8),)
    problem = held_patch(truth, (moved(truth[0], (0.005, 0.0, 0.0)),), fitted=5)
    config = FREE.replace(iterations=8)
    whole = refine_hands(problem, config, NullProgress()).motions[0]
    broken = diverges(at=set(range(failures)), real=Simulator.rollout)
    monkeypatch.setattr(Simulator, "rollout", broken)
    listener = Listener()
    part = refine_hands(problem, config, listener).motions[0]
    before = problem.motions[0].wrist_translation
    moved_by = share * (whole.wrist_translation - before)
    np.testing.assert_allclose(part.wrist_translation - before, moved_by, atol=1e-7)
    assert sum("halved" in message for _, message in listener.told) == failures
    assert np.abs(whole.wrist_translation - before).max() > 1e-3


def test_it_stops_between_iterations() -> None:
    truth = (grasping(frames=4),)
    listener = Listener(patience=2)
    with pytest.raises(CancelledError):
        refine_hands(held_patch(truth, truth, fitted=4), FREE, listener)
    assert [iteration for iteration, _ in listener.told] == [0, 1]


def test_a_gradient_that_grows_with_its_reach_reaches_less_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = (grasping(frames=8),)
    problem = held_patch(truth, (moved(truth[0], (0.005, 0.0, 0.0)),), fitted=8)
    rollout = hand_refinement.differentiable.rollout
    reaches: list[int] = []

    def steep(model: Any, parameters: Any, control: Any, *, window: int, device: str) -> Any:
        reaches.append(window)
        node, velocity = rollout(model, parameters, control, window=window, device=device)
        return node + (1e6 if window > 2 else 0.0) * (control - control.detach()).sum(), velocity

    monkeypatch.setattr(hand_refinement.differentiable, "rollout", steep)
    result = refine_hands(problem, FREE.replace(iterations=2), NullProgress())
    assert reaches == [8, 4, 2, 2, 2]
    assert result.loss_after < result.loss_before


@pytest.mark.parametrize(
    "wrong", [{"iterations": -1}, {"window": 0}, {"decay": 0.0}, {"translation_rate": -1.0}]
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=r" is .*; expected "):
        RefinementConfig(**wrong)


def test_the_rig_is_damped_enough_to_have_useful_gradients() -> None:
    truth = standing(12)
    problem = held_patch((truth,), (moved(truth, (0.005, 0.0, 0.0)),), fitted=12)
    control = problem.object_.control
    node = Simulator(problem.model, SOFT).rollout(control).position
    assert np.abs(node[-1] - node[-2]).max() < 3e-4


def test_a_stopped_refinement_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    truth = two_hands(frames=5)
    seen = tuple(moved(motion, (0.005, 0.0, 0.0)) for motion in truth)
    problem = held_patch(truth, seen, fitted=4, every=4)

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> Any:
        return refine_hands(
            problem, FREE.replace(iterations=6), progress, checkpointer=checkpointer
        )

    reports = check_resumed(fit, tmp_path, (4, 3))
    assert [report[1] for report in reports] == [4, 4, 5, 6]
