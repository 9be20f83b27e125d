"""How long fits still take: oracles with a known end, and recordings of real fits."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from app.jobs.effort import Extent, effort_of
from app.jobs.estimate import Plan, estimate, plan_from
from app.jobs.reference import Reference, scaled_plan
from app.jobs.timeline import Part, Timeline
from physhandi.fitting.config import apply_overrides, config_to_dict, load_profile

Report = dict[str, float | str]
STAGES = (("hands", 40, 20.0), ("search", 5, 10.0), ("springs", 30, 60.0), ("evaluation", 1, 5.0))
CLOSING_S = 3.0
TOTAL_S = 98.0


def reports(pace: Callable[[str], float], begin: float = 1000.0) -> tuple[list[Report], float]:
    """Play a fit whose stages take their times of `STAGES` times a pace, and tell its end."""
    clock, told = begin, []
    for stage, total, seconds in STAGES:
        for iteration in range(1, total + 1):
            # The second half of a stage is three times as slow as the first.
            weight = 0.5 if iteration <= total / 2 else 1.5
            weight = weight if total % 2 == 0 else 1.0
            clock += pace(stage) * weight * seconds / total
            told.append({"stage": stage, "iteration": iteration, "total": total, "time": clock})
    return told, clock + CLOSING_S


def timeline_of(told: list[Report], begin: float = 1000.0, until: float = 1e9) -> Timeline:
    return Timeline(begin).add_all(report for report in told if report["time"] <= until)


def plan(kind: str = "same") -> Plan:
    told, end = reports(lambda _: 1.0)
    return plan_from([(timeline_of(told), end)], kind)


def relative_error(of: Plan, told: list[Report], end: float, share: float) -> float:
    now = 1000.0 + share * (end - 1000.0)
    left = estimate(of, timeline_of(told, until=now), now).left_s
    return left / (end - now) - 1.0


def test_a_plan_adds_up_to_the_time_that_was_measured() -> None:
    assert plan().seconds == pytest.approx(TOTAL_S)
    assert [part.seconds for part in plan().parts] == pytest.approx([20.0, 10.0, 60.0, 5.0])
    # A quarter of the time of a stage has passed in the middle of its iterations.
    assert plan().parts[0].time_at(0.5) == pytest.approx(5.0)
    assert plan().parts[0].time_at(0.75) == pytest.approx(12.5)
    slow, end = reports(lambda _: 3.0)
    fast, first_end = reports(lambda _: 1.0)
    fits = [(timeline_of(slow), end), *[(timeline_of(fast), first_end)] * 2]
    assert plan_from(fits, "same").seconds == pytest.approx(TOTAL_S)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 0.9])
def test_a_fit_like_an_earlier_one_takes_as_long(share: float) -> None:
    told, end = reports(lambda _: 1.0)
    assert relative_error(plan(), told, end, share) == pytest.approx(0.0, abs=0.02)
    found = estimate(plan(), timeline_of(told, until=1000 + share * TOTAL_S), 1000 + share * 98)
    assert found.share == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("pace", [0.7, 1.5])
def test_a_machine_of_another_speed_is_noticed_within_the_first_tenth(pace: float) -> None:
    told, end = reports(lambda _: pace)
    assert 0.1 < abs(relative_error(plan(), told, end, 0.01)) < 0.5
    assert abs(relative_error(plan(), told, end, 0.1)) < 0.3
    assert abs(relative_error(plan(), told, end, 0.5)) < 0.1
    # On a machine that was never measured nothing speaks against what is seen.
    assert abs(relative_error(plan("scaled"), told, end, 0.1)) < 0.1
    assert abs(relative_error(plan("scaled"), told, end, 0.01)) > 0.1


def test_uneven_load_is_averaged_out() -> None:
    noise = random.Random(3)  # noqa: S311  # a test's dice
    told, end = reports(lambda _: noise.uniform(0.5, 1.5))
    for share in (0.1, 0.25, 0.5, 0.75):
        assert abs(relative_error(plan(), told, end, share)) < 0.3


def test_a_stage_that_is_slower_than_it_was_is_measured_by_itself() -> None:
    told, end = reports(lambda stage: 2.0 if stage == "springs" else 1.0)
    middle = (30.0 + 60.0) / (end - 1000.0)
    assert abs(relative_error(plan(), told, end, middle)) < 0.25
    now = 1000.0 + 30.0 + 60.0
    found = estimate(plan(), timeline_of(told, until=now), now)
    assert found.stage_left_s == pytest.approx(60.0, rel=0.3)
    assert found.stage_left_s < found.left_s


def test_time_goes_on_between_reports_and_stands_when_the_next_one_is_late() -> None:
    told, _ = reports(lambda _: 1.0)
    known = timeline_of(told, until=1021.0)  # one of five iterations of the search is next
    lefts = [estimate(plan(), known, 1020.0 + late).left_s for late in (0.0, 1.0, 2.0, 30.0)]
    assert lefts == pytest.approx([78.0, 77.0, 76.0, 76.0], abs=0.01)
    middle = timeline_of(told, until=1022.0)
    lefts = [estimate(plan(), middle, 1022.0 + late).left_s for late in (0.0, 1.0, 30.0)]
    assert lefts == pytest.approx([76.0, 75.0, 74.0], abs=0.01)
    # Before the first report there is only the plan, until that report is due.
    assert estimate(plan(), Timeline(1000.0), 1000.1).left_s == pytest.approx(97.9)
    assert estimate(plan(), Timeline(1000.0), 2000.0).left_s == pytest.approx(97.75)


def test_a_resumed_fit_has_only_what_is_left_before_it() -> None:
    told, end = reports(lambda _: 1.0)
    late = [report for report in told if report["stage"] in {"springs", "evaluation"}]
    begin = 1030.0
    now = begin + 30.0
    found = estimate(plan(), timeline_of(late, begin, now), now)
    assert found.left_s == pytest.approx(end - now, rel=0.05)
    assert found.share == pytest.approx(30.0 / 68.0, abs=0.02)


def test_a_stage_that_starts_over_is_another_part_and_one_that_is_new_is_extrapolated() -> None:
    told = [
        {"stage": stage, "iteration": iteration, "total": 4, "time": 1000.0 + second}
        for second, (stage, iteration) in enumerate(
            [("hands", 1), ("hands", 4), ("hands", 2), ("hands", 4), ("new", 1), ("new", 2)], 1
        )
    ]
    timeline = timeline_of(told)
    assert [(part.stage, part.visit) for part in timeline.parts] == [
        ("hands", 0),
        ("hands", 1),
        ("new", 0),
    ]
    assert [part.seconds for part in timeline.parts] == [2.0, 2.0, 2.0]
    assert estimate(plan(), timeline, 1006.0).stage_left_s == pytest.approx(2.0)
    assert Timeline(0.0).add_all([{"stage": "x"}, {"stage": "x", "total": "y"}]).parts == []


def test_a_part_keeps_its_set_up_when_it_is_stretched_and_bends_where_its_loops_meet() -> None:
    part = Part(stage="hands", visit=0, shares=[0.0, 0.1, 0.5, 1.0], times=[0.0, 2.0, 6.0, 26.0])
    assert part.stretched(3.0).times == [0.0, 6.0, 18.0, 78.0]
    late = Part(stage="hands", visit=0, shares=[0.0, 0.1, 0.5, 1.0], times=[0.0, 5.0, 13.0, 23.0])
    # At 2 s a tenth the first tenth took 2 s, so 3 s went before.
    assert late.stretched(3.0, set_up=1.0).times == pytest.approx([0.0, 9.0, 33.0, 63.0])
    bent = part.bent(0.5, 0.8, (2.0, 0.1))
    assert bent.seconds == pytest.approx(14.0)
    assert bent.time_at(0.8) == pytest.approx(12.0)
    assert bent.time_at(0.9) == pytest.approx(13.0)
    assert bent.time_at(0.16) == pytest.approx(4.0)


def test_effort_follows_the_settings_that_make_work() -> None:
    quick = config_to_dict(load_profile("quick"))
    base = effort_of(quick, Extent(60, 1))
    twice = effort_of(quick, Extent(120, 1))
    assert {stage: twice[stage] / base[stage] for stage in base} == dict.fromkeys(base, 2.0)
    search = quick["object_"]["search"] | {"generations": 12}
    more = effort_of(quick | {"object_": quick["object_"] | {"search": search}}, Extent(60, 1))
    assert more["zeroth_order"] / base["zeroth_order"] == pytest.approx(97 / 49)
    assert more["first_order"] == base["first_order"]
    paper = effort_of(config_to_dict(load_profile("paper")), Extent(60, 1))
    assert paper["zeroth_order"] > 100 * base["zeroth_order"]
    assert effort_of({"nonsense": 1}, Extent(60, 1)) == {}


RECORDINGS = json.loads(Path(__file__).with_name("fit_recordings.json").read_text())
"""Quick fits of the bundled sequence on two shared cores: three alone, two beside each other, and
one with other settings. The reports as stage, iteration, total and second."""
QUIET = ("quick1", "quick2", "quick3")


def recorded(name: str, until: float = 1e9) -> tuple[Timeline, float]:
    found = RECORDINGS[name]
    told = [
        {"stage": found["stages"][stage], "iteration": i, "total": total, "time": second}
        for stage, i, total, second in found["reports"]
        if second <= until
    ]
    return Timeline(0.0).add_all(told), found["end"]


def recorded_error(of: Plan, name: str, share: float) -> float:
    end = RECORDINGS[name]["end"]
    left = estimate(of, recorded(name, share * end)[0], share * end).left_s
    return left / (end - share * end) - 1.0


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_real_fits_are_foreseen_within_a_third_after_the_first_tenth(share: float) -> None:
    for name in QUIET:
        others = [recorded(other) for other in QUIET if other != name]
        assert abs(recorded_error(plan_from(others, "same"), name, share)) < 0.3
        assert abs(recorded_error(plan_from(others, "scaled"), name, share)) < 0.3
    for name, other in (("beside1", "beside2"), ("beside2", "beside1")):
        assert abs(recorded_error(plan_from([recorded(other)], "same"), name, share)) < 0.3
        # Two fits side by side take half as long again as one that was alone: it is noticed late.
        alone = plan_from([recorded(quiet) for quiet in QUIET], "same")
        assert abs(recorded_error(alone, name, share)) < 0.45


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_a_real_fit_with_other_settings_is_foreseen_from_one_of_the_profile(share: float) -> None:
    quick = load_profile("quick")
    overrides = {
        "hand.iterations": 300,
        "object_.search.generations": 14,
        "object_.first_order.iterations": 30,
        "refinement.iterations": 0,
    }
    changed = config_to_dict(apply_overrides(quick, overrides))
    extent, machine = Extent(60, 1), ("cpu", "", 2)
    timeline, end = recorded("quick1")
    reference = Reference(config_to_dict(quick), extent, machine, timeline, end)
    of = scaled_plan([reference], changed, extent, machine)
    assert of.seconds == pytest.approx(RECORDINGS["changed"]["end"], rel=0.3)
    longer = {p.stage: p.seconds / q.seconds for p, q in zip(of.parts, timeline.parts, strict=True)}
    assert 0.5 < longer["hand_reconstruction"] < 1.0
    assert 2.0 < longer["zeroth_order"] < 2.4
    assert longer["hand_refinement"] < 0.2
    assert abs(recorded_error(of, "changed", share)) < 0.35
