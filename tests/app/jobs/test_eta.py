"""How long fits still take: closed forms, recordings of real fits, and what run folders tell."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.server.server_world import World

from app.jobs.eta import (
    Expectation,
    Extent,
    FinishedFit,
    Forecast,
    Position,
    expect,
    time_left,
    work_of,
)
from physhandi.fitting.config import (
    APPEARANCE,
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SPRINGS,
    PipelineConfig,
    apply_overrides,
    load_profile,
)
from physhandi.run import Run

QUICK = load_profile("quick")
TOWEL = Extent(frames=60, hand_frames=60, sequences=1, has_object=True)
MACHINE = ("cpu", "two cores", 2)
ENVIRONMENT = "attempts/1/out/environment.json"
BEGIN = 1_000_000.0


def finished(
    seconds: dict[str, float], config: PipelineConfig = QUICK, machine: tuple[Any, ...] = MACHINE
) -> FinishedFit:
    settings = config.to_dict()
    values = {key: v for key, v in settings.items() if key not in {"profile", "description"}}
    text = json.dumps(values, sort_keys=True, default=str)
    return FinishedFit(text, config.profile, machine, work_of(config, TOWEL), seconds, 0.0)


def stages(**seconds: float) -> dict[str, float]:
    names = (HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION)
    return dict.fromkeys(names, 1.0) | seconds


def expected(fits: list[FinishedFit], config: PipelineConfig = QUICK, frames: int = 60) -> Any:
    work = work_of(config, replace(TOWEL, frames=frames, hand_frames=frames))
    return expect(fits, config.to_dict(), MACHINE, work)


def test_work_grows_with_frames_and_iterations_and_is_none_where_nothing_is_to_be_done() -> None:
    base = work_of(QUICK, TOWEL)
    twice = work_of(QUICK, replace(TOWEL, frames=120, hand_frames=120))
    assert twice == {stage: 2.0 * work for stage, work in base.items()}
    more = work_of(apply_overrides(QUICK, {"object_.search.generations": 12}), TOWEL)
    assert more[SEARCH] / base[SEARCH] == pytest.approx(97 / 49)
    assert {s: w for s, w in more.items() if s != SEARCH} == {
        s: w for s, w in base.items() if s != SEARCH
    }
    assert work_of(load_profile("paper"), TOWEL)[SEARCH] > 100 * base[SEARCH]
    assert list(work_of(QUICK, replace(TOWEL, has_object=False))) == [HANDS, EVALUATION]
    without_hands = work_of(QUICK, replace(TOWEL, hand_frames=0))
    assert (without_hands[HANDS], without_hands[REFINEMENT]) == (0.0, 0.0)


def test_a_look_that_is_asked_for_is_counted_and_drawing_it_too() -> None:
    asked = apply_overrides(QUICK, {"appearance.enabled": True, "appearance.iterations": 100})
    base, work = work_of(QUICK, TOWEL), work_of(asked, replace(TOWEL, has_look=True))
    assert list(work) == [*list(base)[:-1], APPEARANCE, EVALUATION]
    longer = apply_overrides(asked, {"appearance.iterations": 300})
    assert work_of(longer, replace(TOWEL, has_look=True))[APPEARANCE] == 3 * work[APPEARANCE] > 0
    assert work[EVALUATION] > 3 * base[EVALUATION]
    dark = work_of(asked, TOWEL)
    assert (dark[APPEARANCE], dark[EVALUATION]) == (0.0, base[EVALUATION])
    # No earlier fit had the stage: a typical time stands in, and the whole is a rough guess.
    fits = [finished(stages())]
    found = expect(fits, asked.to_dict(), MACHINE, work)
    assert found is not None
    assert 1.0 < found.seconds[APPEARANCE] < 1000.0
    assert found.fit_count == 0
    own = replace(fits[0], work=work, seconds=stages(**{APPEARANCE: 7.0}))
    found = expect([own], asked.to_dict(), MACHINE, work)
    assert found is not None
    assert found.seconds[APPEARANCE] == pytest.approx(7.0)


def test_fits_that_were_made_before_a_setting_existed_had_its_default() -> None:
    settings = {name: v for name, v in QUICK.to_dict().items() if name != "appearance"}
    (fit,) = [finished(stages())]
    work = work_of(QUICK, TOWEL)
    found = expect([fit], settings, MACHINE, work)
    assert found is not None
    assert found.basis == "from an earlier fit with these settings"


def test_the_median_of_the_newest_five_fits_counts_stage_by_stage() -> None:
    fits = [finished(stages(**{HANDS: s})) for s in (3.0, 9.0, 4.0, 5.0, 1.0, 100.0, 100.0)]
    found = expected(fits)
    assert found.seconds == pytest.approx(stages(**{HANDS: 4.0}))
    assert found.total_s == pytest.approx(9.0)
    assert found.basis == "from 5 earlier fits with these settings"
    assert expected(fits[:1]).basis == "from an earlier fit with these settings"
    assert expected(fits, frames=600).seconds == pytest.approx(
        stages(**{HANDS: 4.0})
        and {stage: 10.0 * seconds for stage, seconds in stages(**{HANDS: 4.0}).items()}
    )


def test_fits_of_other_settings_or_machines_count_only_where_there_is_none_of_the_same() -> None:
    longer = apply_overrides(QUICK, {"object_.search.generations": 12})
    other_settings = finished(stages(**{SEARCH: 97.0}), longer)
    elsewhere = finished(stages(**{SEARCH: 1000.0}), machine=("cuda:0", "fast", 16))
    assert expected([elsewhere, other_settings]).seconds[SEARCH] == pytest.approx(49.0)
    assert expected([elsewhere, other_settings]).basis.startswith("roughly")
    assert expected([elsewhere]).seconds[SEARCH] == pytest.approx(1000.0)
    same = finished(stages(**{SEARCH: 7.0}))
    assert expected([elsewhere, other_settings, same]).seconds[SEARCH] == pytest.approx(7.0)
    # A stage that the fits with these settings lack makes the whole a rough one.
    partly = finished({stage: s for stage, s in stages().items() if stage != SEARCH})
    assert expected([partly, other_settings]).fit_count == 0
    assert expected([partly]) is None
    assert expected([]) is None


PLAN = Expectation({"a": 20.0, "b": 60.0, "c": 20.0}, 1)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_a_fit_as_slow_as_its_finished_stages_ends_as_they_say(speed: float) -> None:
    plan = replace(PLAN, fit_count=0)
    half = Position({"a": 20.0 * speed}, "b", 0.5, 30.0 * speed, 30.0 * speed)
    left, stage_left = time_left(plan, half)
    # 2 % of the plan stand for "as fast as the others".
    pace = (20.0 * speed + 2.0) / (20.0 + 2.0)
    assert stage_left == pytest.approx(0.5 * (0.5 * pace * 60.0 + 30.0 * speed))
    assert left == pytest.approx(stage_left + pace * 20.0)
    if speed == 1.0:
        assert (left, stage_left) == (pytest.approx(50.0), pytest.approx(30.0))


def test_time_goes_on_between_reports_and_never_below_what_is_to_come() -> None:
    def left(share: float | None, now_s: float) -> tuple[float, float]:
        return time_left(PLAN, Position({}, "a", share, 10.0, now_s))

    assert left(0.5, 10.0) == pytest.approx((90.0, 10.0))
    assert left(0.5, 13.0) == pytest.approx((87.0, 7.0))
    assert left(0.5, 1000.0) == pytest.approx((80.0, 0.0))
    assert left(None, 5.0) == pytest.approx((95.0, 15.0))
    assert time_left(PLAN, Position({}, "", None, 0.0, 0.0)) == pytest.approx((100.0, 0.0))
    assert time_left(PLAN, Position({}, "unknown", 0.5, 4.0, 4.0))[1] == pytest.approx(2.0)


def test_stages_that_an_earlier_attempt_finished_do_not_show_a_pace() -> None:
    resumed = Position({"a": 0.0}, "b", None, 0.0, 0.0)
    assert time_left(PLAN, resumed) == pytest.approx((80.0, 60.0))


RECORDINGS = json.loads(Path(__file__).with_name("fit_recordings.json").read_text())
"""Quick fits of the bundled sequence on two shared cores: three alone, two beside each other, and
one with other settings. The reports as stage, iteration, total and second; hands descended then."""
RECORDED = apply_overrides(QUICK, {"hand.gauss_newton": False})
QUIET = ("quick1", "quick2", "quick3")
CHANGED = apply_overrides(
    RECORDED,
    {
        "hand.iterations": 300,
        "object_.search.generations": 14,
        "object_.first_order.iterations": 30,
        "refinement.iterations": 0,
    },
)


def recorded_stages(name: str, until: float = 1e9) -> dict[str, float]:
    """Time of each stage that had ended by then; rollouts belong to the evaluation."""
    found, ends = RECORDINGS[name], dict[str, float]()
    for number, _, _, second in found["reports"]:
        ends[found["stages"][number].replace("rollout", EVALUATION)] = second
    ends[EVALUATION] = found["end"]
    begins = [0.0, *ends.values()]
    return {
        stage: end - begin
        for (stage, end), begin in zip(ends.items(), begins, strict=False)
        if end <= until
    }


def recorded_error(of: Expectation, name: str, share: float, config: PipelineConfig) -> float:
    found = RECORDINGS[name]
    now = share * found["end"]
    done = recorded_stages(name, now)
    stage = next(s for s in of.seconds if s not in done and of.seconds[s] > 0)
    begin = sum(done.values())
    said = [r for r in found["reports"] if r[3] <= now and found["stages"][r[0]] == stage]
    _, iteration, total, second = said[-1] if said else (0, 0, 1, begin)
    part = iteration / total
    if stage == HANDS:
        late = config.hand.iterations
        part = (iteration + 14 * max(0, iteration - late)) / (total + 14 * (total - late))
    left, _ = time_left(of, Position(done, stage, part, second - begin, now - begin))
    return left / (found["end"] - now) - 1.0


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_real_fits_are_foreseen(share: float) -> None:
    def error(name: str, others: tuple[str, ...], config: PipelineConfig = RECORDED) -> float:
        fits = [finished(recorded_stages(other), RECORDED) for other in others]
        of = expected(fits, config)
        return abs(recorded_error(of, name, share, config))

    for name in QUIET:
        assert error(name, tuple(other for other in QUIET if other != name)) < 0.35
    assert error("beside1", ("beside2",)) < 0.3
    assert error("beside2", ("beside1",)) < 0.3
    # Two fits side by side take half as long again as one that was alone: it is noticed late.
    assert error("beside1", QUIET) < 0.45
    assert error("beside2", QUIET) < 0.45
    assert error("changed", ("quick1",), CHANGED) < 0.35


@pytest.fixture
def interrupted(world: World) -> Callable[..., Run]:
    """Copy the finished run as it was at half of its search.

    It began at `BEGIN` and has no hands; each of its four other stages took ten seconds.
    """
    fitted = world.catalog.run("fitted").folder

    def moment(seconds: float) -> str:
        return datetime.fromtimestamp(BEGIN + seconds, UTC).isoformat()

    listed = json.loads((fitted / "attempts/1/stages.json").read_text())
    end = 0.0
    for stage in listed:
        seconds = 0.0 if stage["name"] in {HANDS, REFINEMENT} else 10.0
        end += seconds
        stage |= {"seconds": seconds, "time": moment(end)}
    (fitted / "attempts/1/stages.json").write_text(json.dumps(listed))
    change(fitted / ENVIRONMENT, started=moment(0.0))
    change(fitted / "exit.json", time=moment(end))

    def make(name: str = "again") -> Run:
        folder = world.settings.run_dir / name
        shutil.copytree(fitted, folder)
        for file in ("current", "exit.json", "attempts/1/MANIFEST.json"):
            (folder / file).unlink()
        (folder / "attempts/1/stages.json").write_text(json.dumps(listed[:2]))
        report = {"stage": SEARCH, "iteration": 1, "total": 2, "attempt": 1, "time": BEGIN + 15.0}
        (folder / "progress.json").write_text(json.dumps(report))
        return Run.open(folder)

    return make


def change(path: Path, **values: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_a_run_that_repeats_an_earlier_one_takes_as_long(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run = interrupted()
    found = Forecast(world.catalog, "cpu").of_running(run, BEGIN + 16.0)
    assert found == {
        "left_s": 24.0,
        "stage_left_s": 4.0,
        "share": 0.4,
        "basis": "from an earlier fit with these settings",
    }
    change(run.folder / "progress.json", attempt=0)  # A report of the attempt before.
    assert Forecast(world.catalog, "cpu").of_running(run, BEGIN + 16.0) == found
    change(run.folder / ENVIRONMENT, device_name="another processor")
    elsewhere = Forecast(world.catalog, "cpu").of_running(run, BEGIN + 16.0)
    assert elsewhere is not None
    assert elsewhere["basis"].startswith("roughly")


def test_runs_in_line_begin_when_those_before_them_have_ended(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run, ahead = interrupted(), interrupted("ahead")
    forecast = Forecast(world.catalog, "cpu")
    assert forecast.of_waiting(run, [], [], 1) == {
        "starts_in_s": 0.0,
        "left_s": 40.0,
        "basis": "from an earlier fit with these settings",
    }
    found = forecast.of_waiting(run, [ahead, ahead, ahead], [], 2)
    assert found is not None
    assert (found["starts_in_s"], found["left_s"]) == (40.0, 80.0)
    # Also if nothing was ever fitted here, as on the first start with the bundled run.
    change(world.catalog.run("fitted").folder / ENVIRONMENT, device_name="another processor")
    foreign = Forecast(world.catalog, "cpu").of_waiting(run, [], [], 1)
    assert foreign is not None
    assert foreign["basis"].startswith("roughly")


def test_nothing_is_told_where_nothing_is_known(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run = interrupted()
    forecast = Forecast(world.catalog, "cpu")
    fields: dict[str, Any] = {"name": "new", "sequences": run.sequences}
    fresh = Run.create(
        world.settings.run_dir / "fresh", kind="reconstruction", config=run.config, **fields
    )
    assert forecast.of_running(fresh) is None
    simulated = Run.create(
        world.settings.run_dir / "simulated", kind="simulation", config={"source": "x"}, **fields
    )
    assert forecast.of_waiting(simulated, [], [], 1) is None
    assert forecast.of_waiting(run, [simulated], [], 1) is None
    assert forecast.of_waiting(run, [], [], 0) is None  # A cluster was not asked yet.
    (run.folder / "attempts/1/stages.json").write_text("{")
    assert forecast.of_running(run) is None
    shutil.rmtree(world.settings.sequence_dir / "sheet")
    assert Forecast(world.catalog, "cpu").of_waiting(fresh, [], [], 1) is None


def test_a_damaged_fit_teaches_nothing(world: World, interrupted: Callable[..., Run]) -> None:
    run = interrupted()
    sequence = world.catalog.sequence("sheet")
    profile = run.config["profile"]
    known = Forecast(world.catalog, "cpu").of_order(profile, [sequence])
    assert known == {"seconds": 40.0, "basis": "from an earlier fit with these settings"}
    twice = Forecast(world.catalog, "cpu").of_order(profile, [sequence, sequence])
    assert twice is not None
    assert twice["seconds"] == 80.0
    job = yaml.safe_load((world.catalog.run("fitted").folder / "job.yaml").read_text())
    job["config"]["profile"]["unheard_of"] = 1
    (world.catalog.run("fitted").folder / "job.yaml").write_text(yaml.safe_dump(job))
    only_bundled = Forecast(world.catalog, "cpu").of_order(profile, [sequence])
    assert only_bundled is not None
    assert only_bundled["basis"].startswith("roughly")
    assert Forecast(world.catalog, "cpu").of_order(profile, []) is None
