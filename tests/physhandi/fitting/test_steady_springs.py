"""Springs whose motion hangs on rounding: how that is measured, and what is fitted instead."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.stopped_fits import check_resumed, same_bits, write_always

from physhandi.data.checkpoint import Checkpointer
from physhandi.data.observation import ObjectObservation
from physhandi.errors import FitError
from physhandi.fitting import spring_optimisation
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.spring_optimisation import (
    STEADY,
    FirstOrderResult,
    fit_steady_springs,
    motion_sway,
    optimise_springs,
)
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.parameters import SimulationParameters

FRAMES, LENGTH, REST = 5, 0.14, 0.08
SOFT = SimulationParameters(
    connection_radius=0.2,
    max_neighbors=2,
    stiffness=100.0,
    damping=0.0,
    drag=0.0,
    ground_height=None,
    substeps_per_frame=400,
)
STIFF = SOFT.replace(stiffness=1e5)
"""Nothing damps it, and after 200 radians 1 % of stiffness is a radian."""


def stretched_pair() -> ObjectProblem:
    """Two nodes that a stretched spring pulls together, seen as if they stayed where they are."""
    node = np.array([[0.0, 0.0, 0.0], [0.0, LENGTH, 0.0]], np.float32)
    seen = np.ones((FRAMES, 2), bool)
    return build_problem(
        name="pair",
        observation=ObjectObservation(
            point=np.repeat(node[None], FRAMES, axis=0),
            is_visible=seen,
            is_motion_valid=seen,
            node_of_track=np.arange(2, dtype=np.int32),
        ),
        object_node=node,
        rest_node=node * (REST / LENGTH),
        control=np.zeros((FRAMES, 0, 3), np.float32),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=None,
        gravity=0.0,
        starts_at_rest=True,
    )


def config(iterations: int = 0, most_starts: int = 3) -> ObjectFitConfig:
    settings = {"iterations": iterations, "most_starts": most_starts, "is_annealed": False}
    return ObjectFitConfig(first_order=FirstOrderConfig(**settings))


def fitted(
    *starts: SimulationParameters, progress: Progress | None = None, **settings: Any
) -> FirstOrderResult:
    problems, chosen = [stretched_pair()], config(**settings)
    return fit_steady_springs(problems, starts, chosen, progress or NullProgress())


def length(stiffness: float) -> np.ndarray:
    """Distance of the nodes in each frame: of 1 kg each, with a force of k (l / r - 1)."""
    time = np.arange(FRAMES) / 30.0
    return REST + (LENGTH - REST) * np.cos(math.sqrt(2.0 * stiffness / REST) * time)


def test_sway_is_how_far_a_hundredth_of_stiffness_moves_the_nodes() -> None:
    result = optimise_springs([stretched_pair()], SOFT, config(), NullProgress())
    assert result.sway == 0.0
    # Each node makes half of the way, and the typical distance of two nodes is that at rest.
    shifts = [
        np.abs(length(100.0 * factor) - length(100.0)).mean() / 2.0 for factor in (0.99, 1.01)
    ]
    expected = max(shifts) / REST
    assert expected > 2e-3
    assert motion_sway([stretched_pair()], result, "cpu") == pytest.approx(expected, rel=0.01)


def test_sway_is_infinite_where_a_little_more_stiffness_is_too_fast() -> None:
    result = optimise_springs([stretched_pair()], SOFT, config(), NullProgress())
    # Each node is at most half as fast as the length changes, which is ω times its amplitude.
    fastest = math.sqrt(2.0 * 100.0 / REST) * (LENGTH - REST) / 2.0
    for limit, is_finite in ((1.01 * fastest, True), (1.003 * fastest, False)):
        parameters = result.parameters.replace(speed_limit=limit)
        tried = replace(result, parameters=parameters)
        assert math.isfinite(motion_sway([stretched_pair()], tried, "cpu")) == is_finite


def test_the_next_candidate_has_its_turn_where_the_best_is_unsteady() -> None:
    alone = fitted(STIFF, SOFT, most_starts=1)
    assert (alone.start, alone.is_steady, alone.note) == (0, False, "")
    assert alone.sway > 2 * STEADY
    result = fitted(STIFF, SOFT)
    assert (result.start, result.is_steady) == (1, True)
    assert result.parameters.stiffness == 100.0
    assert "Began from candidate 2 of the search" in result.note
    steady = fitted(SOFT, STIFF)
    assert (steady.start, steady.note) == (0, "")
    same_bits(replace(result, start=0), steady)


def test_of_unsteady_candidates_the_one_with_the_least_loss_stays() -> None:
    starts = [STIFF.replace(stiffness=k) for k in (1e5, 0.8e5, 0.6e5)]
    losses = [fitted(start).loss_after for start in starts]
    assert len(set(losses)) == 3
    result = fitted(*starts)
    assert not result.is_steady
    assert (result.start, result.loss_after) == (int(np.argmin(losses)), min(losses))


def test_one_that_diverges_with_a_little_more_stiffness_stays_only_if_all_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    starts = [STIFF.replace(stiffness=k) for k in (1e5, 0.8e5, 0.6e5)]
    losses = [fitted(start).loss_after for start in starts]
    for sways, expected in (
        # The least loss is not it: what hardly holds would diverge in the rollout.
        ([math.inf if loss == min(losses) else 0.2 for loss in losses], sorted(losses)[1]),
        ([math.inf] * 3, min(losses)),
    ):
        told = iter(sways)
        with monkeypatch.context() as patch:
            patch.setattr(spring_optimisation, "motion_sway", lambda *_, of=told: next(of))
            assert fitted(*starts).loss_after == expected


def test_a_candidate_that_fails_is_passed_over() -> None:
    coarse = STIFF.replace(substeps_per_frame=1)
    assert fitted(STIFF, coarse, SOFT).start == 2
    first = fitted(coarse, SOFT)
    assert (first.start, first.is_steady) == (1, True)
    assert "Began from candidate 2 of the search" in first.note
    with pytest.raises(FitError, match="diverge"):
        fitted(coarse, coarse)


@pytest.mark.parametrize(
    ("sway", "said"),
    [
        (None, "moves nodes by"),
        (0.123, "moves nodes by 12% of their distance (5% "),
        (math.inf, "lets it diverge"),
    ],
)
def test_iterations_of_a_later_start_count_on_and_say_why(
    sway: float | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports: list[tuple[int, int, str]] = []
    if sway is not None:
        sways = iter([sway, 0.0])
        monkeypatch.setattr(spring_optimisation, "motion_sway", lambda *_: next(sways))

    class Heard(NullProgress):
        def report(
            self,
            stage: str,
            iteration: int,
            total: int,
            loss: float | None = None,
            message: str = "",
        ) -> None:
            assert stage == "first_order"
            reports.append((iteration, total, message))

    fitted(STIFF, SOFT, progress=Heard(), iterations=2)
    assert [report[:2] for report in reports] == [(1, 2), (2, 2), (3, 4), (4, 4)]
    assert f"unsteady: 1% more or less stiffness {said}" in reports[2][2]
    assert [report[2] for report in reports[:2]] == ["", ""]


def test_a_later_start_that_was_stopped_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    # Any motion is called unsteady, so that the first start, too, can be told from the second.
    monkeypatch.setattr(spring_optimisation, "STEADY", 0.0)
    starts = [SOFT, SOFT.replace(stiffness=200.0)]

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> Any:
        return fit_steady_springs(
            [stretched_pair()], starts, config(iterations=3), progress, checkpointer=checkpointer
        )

    reports = check_resumed(fit, tmp_path, (2, 4))
    assert [report[1] for report in reports] == [3, 5, 6]
