"""What a fit shows of itself is what it simulated: its loss can be computed from it again."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support.physics.hand_scene import grasping, looking_at_hand, seen_keypoints, write_scene
from support.physics.refinement_world import held_patch, moved

from physhandi.data.observation import ObjectObservation
from physhandi.errors import SimulationDivergedError
from physhandi.fitting import object_reconstruction
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig, SearchConfig, SearchVariable
from physhandi.fitting.hand_reconstruction import HandFitConfig, reconstruct_hands
from physhandi.fitting.hand_refinement import RefinementConfig, refine_hands
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.object_reconstruction import search_object
from physhandi.fitting.spring_optimisation import optimise_springs
from physhandi.hand.loading import load_hand_model
from physhandi.progress import NullProgress, Preview, Progress
from physhandi.simulation.parameters import SimulationParameters

PARAMETERS = SimulationParameters(
    connection_radius=0.16,
    max_neighbors=8,
    virtual_connection_radius=0.03,
    virtual_max_neighbors=1,
    stiffness=2000.0,
    virtual_stiffness=3000.0,
    damping=5.0,
    ground_height=None,
    substeps_per_frame=40,
)
FRAMES = 6


class Watching(Progress):
    """Takes every preview that it is offered, every `nth` time that it is asked."""

    def __init__(self, nth: int = 1) -> None:
        self.nth = nth
        self.asked = 0
        self.shown: list[Preview] = []

    def wants_preview(self) -> bool:
        self.asked += 1
        return self.asked % self.nth == 0

    def preview(self, make: Callable[[], Preview]) -> None:
        self.shown.append(make())


def lifted_sheet() -> ObjectProblem:
    """Sixteen nodes that rise by 2 cm a frame while their two held corners rise by 3 cm."""
    axis = np.arange(4) * 0.1
    node = np.stack([*np.meshgrid(axis, axis, indexing="ij"), np.zeros((4, 4))], -1).reshape(-1, 3)
    rise = np.arange(FRAMES)[:, None, None] * np.array([0.0, 0.0, 1.0])
    is_seen = np.ones((FRAMES, 16), bool)
    return build_problem(
        name="sheet",
        observation=ObjectObservation(
            point=(node[None] + 0.02 * rise).astype(np.float32),
            is_visible=is_seen,
            is_motion_valid=is_seen,
        ),
        object_node=node,
        rest_node=node,
        control=(node[[0, 3]] + [0.0, 0.0, 0.01] + 0.03 * rise).astype(np.float32),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=None,
        gravity=9.81,
    )


def settings() -> ObjectFitConfig:
    variables = {"stiffness": SearchVariable(low=50.0, high=2000.0, scale="log")}
    return ObjectFitConfig(
        search=SearchConfig(generations=3, population=5, variables=variables),
        first_order=FirstOrderConfig(iterations=4, learning_rate=0.1),
    )


def loss_of(shown: Preview, problem: ObjectProblem) -> float:
    node = torch.from_numpy(np.array(shown.points["object"]))
    return float(problem.frame_losses(node[1:]).mean())


def test_the_search_shows_its_best_candidates_as_they_moved() -> None:
    problem, progress = lifted_sheet(), Watching()
    result = search_object([problem], PARAMETERS, settings(), progress)
    losses = [shown.loss for shown in progress.shown]
    assert len(losses) >= 2
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] == pytest.approx(result.loss_after, rel=1e-4)
    for shown in progress.shown:
        assert shown.stage == "zeroth_order"
        assert loss_of(shown, problem) == pytest.approx(shown.loss, rel=1e-4)
    first = progress.shown[0].points
    assert first["object"].shape == (FRAMES, 16, 3)
    np.testing.assert_array_equal(first["control"], problem.control)
    assert np.nanmax(first["seen"][3, :, 2]) == pytest.approx(0.06, abs=1e-6)


def test_a_candidate_that_diverges_when_it_is_simulated_to_be_shown_stops_no_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # As of one that holds in a batch, whose sums are rounded otherwise, and not alone.
    problem, watching, calls = lifted_sheet(), Watching(), []

    def diverges(*arguments: object) -> object:
        calls.append(arguments)
        raise SimulationDivergedError("Too fast.", frame=18, substep=4, node=562)

    expected = search_object([problem], PARAMETERS, settings(), NullProgress())
    monkeypatch.setattr(object_reconstruction, "simulate_problem", diverges)
    result = search_object([problem], PARAMETERS, settings(), watching)
    assert result.parameters == expected.parameters
    assert len(calls) >= 2
    assert watching.shown == []


def test_every_iteration_can_be_shown_and_none_is_made_for_nobody() -> None:
    problem, progress = lifted_sheet(), Watching()
    soft = PARAMETERS.replace(stiffness=300.0)
    result = optimise_springs([problem], soft, settings(), progress)
    curve = [loss for _, loss in result.curve[1:]]
    assert [shown.loss for shown in progress.shown] == curve
    for shown in progress.shown:
        assert loss_of(shown, problem) == pytest.approx(shown.loss, rel=1e-5)
    seldom = Watching(nth=3)
    optimise_springs([problem], soft, settings(), seldom)
    assert [shown.loss for shown in seldom.shown] == curve[2:3]


def test_refinement_shows_the_hand_that_it_moves() -> None:
    truth = grasping("right", frames=6)
    problem = held_patch((truth,), (moved(truth, (0.004, 0.0, 0.0)),), fitted=5, every=4)
    progress = Watching()
    refine_hands(problem, RefinementConfig(iterations=2), progress)
    assert len(progress.shown) == 3
    for shown in progress.shown:
        assert loss_of(shown, problem.object_) == pytest.approx(shown.loss, rel=1e-5)
    first, last = progress.shown[0].points, progress.shown[-1].points
    fitted = problem.object_.control[: problem.object_.frame_count]
    assert np.abs(first["control"] - fitted).max() < 1e-4
    assert np.abs(last["control"] - fitted).max() > 1e-4


def test_stage_one_shows_joints_where_the_hand_is(tmp_path: Path) -> None:
    truth = grasping("right", frames=5)
    cameras = [looking_at_hand(azimuth) for azimuth in (0.0, 1.5)]
    sequence = write_scene(tmp_path / "a", [truth], cameras, seen_keypoints([truth], cameras))
    progress = Watching()
    fit = reconstruct_hands(sequence, HandFitConfig(), progress)
    shown = progress.shown[-1].points["joints"]
    assert len(progress.shown) == len(fit.curve) > 5
    assert shown.shape == (5, 21, 3)
    fitted = fit.motions[0].keypoints(load_hand_model("right"))
    assert np.linalg.norm(shown - fitted, axis=-1).max() < 0.003
    assert np.linalg.norm(shown[:, 1:] - shown[:, :1], axis=-1).max() > 0.05
