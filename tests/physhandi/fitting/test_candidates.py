"""The judge of the search against simulating and comparing each candidate with torch."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from support.waiting import LIMIT_S

from physhandi.data.observation import ObjectObservation
from physhandi.errors import CancelledError, FitError, SimulationDivergedError
from physhandi.fitting import object_reconstruction
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig, SearchConfig, SearchVariable
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    build_problem_model,
    mean_loss,
)
from physhandi.fitting.object_reconstruction import CandidateEvaluator, search_object
from physhandi.fitting.search import SearchResult
from physhandi.progress import NullProgress, Preview, Progress
from physhandi.simulation.engines.batch import BatchSimulator, shared_out
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters

PARAMETERS = SimulationParameters(
    connection_radius=0.16,
    max_neighbors=8,
    virtual_connection_radius=0.03,
    virtual_max_neighbors=1,
    stiffness=300.0,
    virtual_stiffness=3000.0,
    damping=5.0,
    drag=1.0,
    substeps_per_frame=40,
)
FRAMES = 5
AXIS = np.arange(4) * 0.1
NODE = np.stack([*np.meshgrid(AXIS, AXIS, indexing="ij"), np.zeros((4, 4))], axis=-1).reshape(-1, 3)
# Of neighbors that are equally far, each topology may choose its own.
NODE = NODE + np.random.default_rng(6).normal(0, 0.003, NODE.shape)


def sheet(name: str, lift: float, gravity: float = 9.81, **more: object) -> ObjectProblem:
    """A sheet that two risen corners pull, seen as noise about where it lay: nothing fits it."""
    rng = np.random.default_rng(len(name))
    corner = NODE[[0, 3]] + [0.0, 0.0, 0.01]
    rise = np.linspace(0, 1, FRAMES + 2)[:, None, None] * np.array([0.0, 0.0, lift])
    point = np.repeat(NODE[None, :6], FRAMES + 2, axis=0) + rng.normal(0, 0.02, (FRAMES + 2, 6, 3))
    visible = rng.uniform(size=point.shape[:2]) < 0.7
    visible[0] = True
    valid = visible.copy()
    valid[0] = False
    clouds = tuple(rng.uniform(0, 0.3, (7 + 3 * frame, 3)) for frame in range(FRAMES + 2))
    observation = ObjectObservation(
        point=point.astype(np.float32), is_visible=visible, is_motion_valid=valid, cloud=clouds
    )
    settings = {
        "name": name,
        "observation": observation,
        "object_node": NODE,
        "rest_node": NODE,
        "control": (corner[None] + rise).astype(np.float32),
        "hand_face": np.zeros((0, 3), np.int32),
        "frame_count": FRAMES,
        "frame_rate": 30.0,
        "ground_height": None,
        "gravity": gravity,
    }
    return build_problem(**(settings | more))


def drawn(count: int) -> list[SimulationParameters]:
    rng = np.random.default_rng(7)
    return [
        PARAMETERS.replace(
            connection_radius=rng.uniform(0.11, 0.2),
            max_neighbors=int(rng.integers(2, 8)),
            stiffness=rng.uniform(100, 600),
            drag=rng.uniform(0, 8),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    ("config", "more"),
    [
        (ObjectFitConfig(), {}),
        (ObjectFitConfig(track_weight=1 / 6, freezes_counts=True), {"surface_count": 9}),
        (ObjectFitConfig(acceleration_weight=0.01), {"gravity": 3.0}),
        (ObjectFitConfig(automatic_substeps=True), {}),
    ],
)
def test_a_judgement_is_the_mean_loss_of_all_sequences(
    device: str, config: ObjectFitConfig, more: dict[str, object]
) -> None:
    problems = [sheet("slow", 0.05, **more), sheet("quicker", 0.2, **more)]
    candidates = drawn(4)
    judged = CandidateEvaluator(problems, config, NullProgress(), device=device)(candidates)
    assert [p.stiffness for p, _ in judged] == [p.stiffness for p in candidates]
    if device != "cpu":  # There all take the substeps of the one that needs most.
        most = max(p.substeps_per_frame for p, _ in judged)
        judged = [(p.replace(substeps_per_frame=most), loss) for p, loss in judged]
    for parameters, loss in judged:
        assert (parameters.substeps_per_frame == 40) != config.automatic_substeps
        models = {p.name: build_problem_model(p, parameters) for p in problems}
        wanted = mean_loss(
            problems,
            models,
            parameters,
            config,
            device,
            acceleration_weight=config.acceleration_weight,
        )
        assert wanted > 1e-3
        assert loss == pytest.approx(wanted, rel=2e-5)
    assert len({loss for _, loss in judged}) == 4


@pytest.mark.gpu
@pytest.mark.skipif(wp.get_cuda_device_count() < 2, reason="needs two CUDA devices")
def test_two_gpus_share_a_batch_and_judge_alike_every_time() -> None:
    problems = [sheet("slow", 0.05), sheet("quicker", 0.2)]
    candidates, config = drawn(7), ObjectFitConfig()

    def judged(*more_devices: str) -> list[float]:
        evaluate = CandidateEvaluator(
            problems, config, NullProgress(), device="cuda:0", more_devices=more_devices
        )
        return [loss for _, loss in evaluate(candidates)]

    alone, shared = judged(), judged("cuda:1")
    assert len(set(shared)) == 7
    assert shared == pytest.approx(alone, rel=2e-5)
    assert judged("cuda:1") == shared
    ((_, single),) = CandidateEvaluator(
        problems, config, NullProgress(), device="cuda:0", more_devices=("cuda:1",)
    )(candidates[:1])
    assert single == pytest.approx(alone[0], rel=2e-5)


@pytest.mark.parametrize(
    ("count", "parts"),
    [(5, [[10, 11, 12], [13, 14]]), (4, [[10, 11], [12, 13]]), (1, [[10]])],
)
def test_a_batch_is_shared_out_evenly_and_nobody_gets_nothing(
    count: int, parts: list[list[int]]
) -> None:
    assert shared_out(range(10, 10 + count), 2) == parts


def test_what_cannot_be_simulated_is_infinitely_bad_and_harms_nobody(device: str) -> None:
    problems = [sheet("slow", 0.05)]
    good = drawn(2)
    bare = good[0].replace(connection_radius=1e-3, virtual_connection_radius=1e-3)
    wild = good[0].replace(stiffness=1e8)
    config = ObjectFitConfig()
    alone = [
        loss
        for _, loss in CandidateEvaluator(problems, config, NullProgress(), device=device)(good)
    ]
    mixed = CandidateEvaluator(problems, config, NullProgress(), device=device)(
        [good[0], bare, wild, good[1]]
    )
    losses = [loss for _, loss in mixed]
    assert losses[1:3] == [math.inf, math.inf]
    assert [losses[0], losses[3]] == pytest.approx(alone, rel=1e-6)
    frugal = config.replace(automatic_substeps=True, most_substeps=300)
    ((greedy, loss),) = CandidateEvaluator(problems, frugal, NullProgress(), device=device)([wild])
    assert greedy.substeps_per_frame > 300
    assert loss == math.inf


def test_colliding_candidates_are_judged_with_their_collisions(device: str) -> None:
    problem = sheet("slow", 0.05, gravity=0.0)
    free = drawn(1)[0]
    crowded = free.replace(
        self_collision=True, collision_distance=0.12, collides_rest_neighbors=True
    )
    config = ObjectFitConfig()
    (_, apart), (_, loss) = CandidateEvaluator([problem], config, NullProgress(), device=device)(
        [free, crowded]
    )
    models = {"slow": build_problem_model(problem, crowded)}
    assert loss == pytest.approx(mean_loss([problem], models, crowded, config, device), rel=1e-6)
    assert abs(loss - apart) > 1e-8


def test_the_best_motion_is_shown_once_to_whoever_watches() -> None:
    class Watcher(Progress):
        def __init__(self) -> None:
            self.shown: list[Preview] = []

        def wants_preview(self) -> bool:
            return True

        def preview(self, make: Callable[[], Preview]) -> None:
            self.shown.append(make())

    watcher, problem = Watcher(), sheet("slow", 0.05)
    judge = CandidateEvaluator([problem], ObjectFitConfig(), watcher)
    judged = judge(drawn(3))
    best, loss = min(judged, key=lambda pair: pair[1])
    judge(drawn(1))
    (shown,) = watcher.shown
    assert shown.loss == loss
    models = {"slow": build_problem_model(problem, best)}
    assert mean_loss([problem], models, best, ObjectFitConfig(), "cpu") == pytest.approx(loss)
    assert shown.points["object"].shape == (FRAMES, 16, 3)
    assert np.abs(shown.points["object"][-1] - NODE).max() > 1e-3


def test_judging_stops_between_candidates() -> None:
    class Impatient(Progress):
        asked = 0

        def check_cancelled(self) -> None:
            self.asked += 1
            if self.asked == 3:
                raise CancelledError

    problems, progress = [sheet("slow", 0.05)], Impatient()
    with pytest.raises(CancelledError):
        CandidateEvaluator(problems, ObjectFitConfig(), progress, threads=1)(drawn(4))
    assert progress.asked == 3
    progress = Impatient()
    with pytest.raises(CancelledError):
        CandidateEvaluator(problems, ObjectFitConfig(), progress, threads=2)(drawn(4))


def test_candidates_are_simulated_at_once_with_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problems, candidates = [sheet("a", 0.2), sheet("bc", 0.3)], drawn(6)
    alone = CandidateEvaluator(problems, ObjectFitConfig(), NullProgress(), threads=1)(candidates)
    assert len({loss for _, loss in alone}) == 6
    # Nobody leaves before another one has come.
    pairs = threading.Barrier(2, timeout=LIMIT_S)
    losses = BatchSimulator.losses

    def met(simulator: BatchSimulator, *arguments: Any) -> Any:
        pairs.wait()
        return losses(simulator, *arguments)

    evaluate = CandidateEvaluator(problems, ObjectFitConfig(), NullProgress(), threads=2)
    assert evaluate(candidates[:1]) == alone[:1]
    monkeypatch.setattr(BatchSimulator, "losses", met)
    assert evaluate(candidates) == alone


def test_the_first_candidate_loads_the_kernels_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a stopped search goes on, its first candidates come several at once."""
    events: list[str] = []
    losses = BatchSimulator.losses

    def noted(simulator: BatchSimulator, *arguments: Any) -> Any:
        events.append("begins")
        result = losses(simulator, *arguments)
        events.append("ends")
        return result

    monkeypatch.setattr(BatchSimulator, "losses", noted)
    evaluate = CandidateEvaluator([sheet("a", 0.2)], ObjectFitConfig(), NullProgress(), threads=2)
    judged = evaluate(drawn(5))
    assert all(np.isfinite(loss) for _, loss in judged)
    assert events[:2] == ["begins", "ends"]
    assert events.count("ends") == 5


def test_a_candidate_that_fails_in_its_thread_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> Any:
        raise MemoryError("no room")

    monkeypatch.setattr(BatchSimulator, "losses", broken)
    evaluate = CandidateEvaluator([sheet("a", 0.2)], ObjectFitConfig(), NullProgress(), threads=2)
    with pytest.raises(MemoryError, match="no room"):
        evaluate(drawn(3))


def test_the_best_of_a_search_must_hold_alone_too(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate = CandidateEvaluator(
        [sheet("slow", 0.05)], ObjectFitConfig(), NullProgress(), device=device
    )
    best, second, *_ = sorted(evaluate(drawn(4)), key=lambda each: each[1])
    found = SearchResult(
        parameters=best[0], loss_before=1.0, loss_after=best[1], curve=[[1.0, 1.0]], widened=("x",)
    )
    assert evaluate.best_that_holds(found) == found
    alone = object_reconstruction.simulate_problem
    falling = {best[0].stiffness}

    def diverging(problem, model, parameters, device):
        if parameters.stiffness in falling:
            raise SimulationDivergedError("too fast", frame=1, substep=0, node=0)
        return alone(problem, model, parameters, device)

    monkeypatch.setattr(object_reconstruction, "simulate_problem", diverging)
    assert evaluate.best_that_holds(found) == replace(
        found, parameters=second[0], loss_after=second[1]
    )
    falling |= {parameters.stiffness for parameters, _ in evaluate(drawn(4))}
    with pytest.raises(FitError, match=r"All \d+ candidates .* do so alone"):
        evaluate.best_that_holds(found)


def test_runners_up_connect_other_nodes_and_are_little_worse() -> None:
    evaluate = CandidateEvaluator([sheet("slow", 0.05)], ObjectFitConfig(), NullProgress())
    radii = [0.16, 0.17, 0.2, 0.21, 0.14, 0.12, 0.3]
    evaluate._judged = [
        (loss, PARAMETERS.replace(connection_radius=radius))
        for loss, radius in zip((1.0, 1.05, 1.1, 1.12, 1.15, 1.2, 1.3), radii, strict=True)
    ][::-1]
    best = SearchResult(parameters=PARAMETERS, loss_before=9.0, loss_after=1.0, curve=[])

    def radii_of(most: int) -> list[float]:
        return [each.connection_radius for each in evaluate.runners_up(best, most)]

    # 0.17 and 0.21 m are within a tenth of better ones, and the loss of 0.3 m is 30 % higher.
    assert radii_of(5) == [0.2, 0.14, 0.12]
    assert radii_of(2) == [0.2, 0.14]
    assert radii_of(0) == []


def test_a_search_gives_as_many_runners_up_as_springs_may_start_from() -> None:
    radius = SearchVariable(low=0.11, high=0.3, scale="log")
    search = SearchConfig(generations=2, population=6, variables={"connection_radius": radius})
    problem, settings = sheet("slow", 0.05), ObjectFitConfig(search=search)
    assert search_object([problem], PARAMETERS, settings, NullProgress()).runners_up == ()
    settings = settings.replace(first_order=FirstOrderConfig(most_starts=3))
    result = search_object([problem], PARAMETERS, settings, NullProgress())
    assert len(result.runners_up) == 2
    losses = [
        mean_loss([problem], {"slow": build_problem_model(problem, p)}, p, settings, "cpu")
        for p in (result.parameters, *result.runners_up)
    ]
    assert losses[0] == pytest.approx(result.loss_after, rel=1e-4)
    assert losses == sorted(losses)
    assert losses[-1] <= 1.25 * losses[0]


def test_a_batch_gets_substeps_that_are_enough_for_each_of_its_sequences() -> None:
    problems = [sheet("flat", 0.05), sheet("stiff", 0.2, rest_node=0.5 * NODE)]
    candidates = [p.replace(stiffness=100.0 * p.stiffness) for p in drawn(4)]
    config = ObjectFitConfig(automatic_substeps=True)
    evaluate = CandidateEvaluator(problems, config, NullProgress())
    masters = [
        MasterTopology.of(p.object_node, p.control[0], candidates, rest_node=p.rest_node)
        for p in problems
    ]
    exact, bound = (
        [p.substeps_per_frame for p in settle(masters, candidates)]
        for settle in (evaluate._settle, evaluate._settle_batch)
    )
    alone = [
        [p.substeps_per_frame for p in evaluate._settle_batch([m], candidates)] for m in masters
    ]
    assert bound == [max(both) for both in zip(*alone, strict=True)]
    assert alone[1] > alone[0] > [0] * 4  # Springs half as long are twice as stiff, and more.
    assert all(more >= least and more % 10 == 0 for more, least in zip(bound, exact, strict=True))
    fixed = CandidateEvaluator(problems, ObjectFitConfig(), NullProgress())
    assert fixed._settle_batch(masters, candidates) == candidates
