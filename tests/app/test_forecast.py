"""What run folders tell about the time that a fit still takes."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from server_world import World

from app.jobs.forecast import Forecast
from physhandi.data.run_folder import read_mapping
from physhandi.run import Run

ENVIRONMENT = "attempts/1/out/environment.json"


def times(run: Run) -> tuple[float, float]:
    """Begin and end of a finished run."""
    begin = read_mapping(run.folder / ENVIRONMENT)["started"]
    end = read_mapping(run.folder / "exit.json")["time"]
    return datetime.fromisoformat(begin).timestamp(), datetime.fromisoformat(end).timestamp()


def change(path: Path, **values: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.fixture(autouse=True)
def _steady(world: World) -> None:
    """Let the finished run have reported once a second, however busy this machine was."""
    run = world.catalog.run("fitted")
    begin, _ = times(run)
    lines = (run.folder / "events.jsonl").read_text().splitlines()
    events = [json.loads(line) | {"time": begin + i} for i, line in enumerate(lines, start=1)]
    (run.folder / "events.jsonl").write_text("".join(f"{json.dumps(e)}\n" for e in events))
    end = datetime.fromtimestamp(begin + len(lines) + 1, UTC)
    change(run.folder / "exit.json", time=end.isoformat())


@pytest.fixture
def interrupted(world: World) -> Callable[..., Run]:
    """Copy the finished run as it was when a share of its time had passed."""

    def make(name: str, share: float = 1.0) -> Run:
        finished = world.catalog.run("fitted")
        begin, end = times(finished)
        folder = world.settings.run_dir / name
        shutil.copytree(finished.folder, folder)
        for file in ("current", "exit.json"):
            (folder / file).unlink()
        lines = (folder / "events.jsonl").read_text().splitlines()
        until = begin + share * (end - begin)
        kept = [line for line in lines if json.loads(line)["time"] <= until]
        (folder / "events.jsonl").write_text("".join(f"{line}\n" for line in kept))
        return Run.open(folder)

    return make


def forecast(world: World) -> Forecast:
    return Forecast(world.catalog, "cpu")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_fit_that_repeats_an_earlier_one_takes_as_long(
    world: World, interrupted: Callable[..., Run], share: float
) -> None:
    run = interrupted("again", share)
    begin, end = times(world.catalog.run("fitted"))
    now = begin + share * (end - begin)
    found = forecast(world).of_run(run, now)
    assert found is not None
    assert found.basis == "from an earlier fit with these settings"
    assert found.left_s == pytest.approx(end - now, abs=0.02 * (end - begin))
    assert found.share == pytest.approx(share, abs=0.02)


def test_reports_that_come_are_taken_in_and_those_of_an_earlier_attempt_are_not(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run = interrupted("again", 0.5)
    begin, end = times(world.catalog.run("fitted"))
    of = forecast(world)
    half = of.of_run(run, (begin + end) / 2)
    path = run.folder / "events.jsonl"
    known = path.read_text()
    stale = json.loads(known.splitlines()[-1]) | {"attempt": 0, "stage": "evaluation"}
    path.write_text(known + "no json\n" + json.dumps(stale) + "\n")
    assert of.of_run(run, (begin + end) / 2) == half
    shutil.copy(world.catalog.run("fitted").folder / "events.jsonl", path)
    done = forecast(world).of_run(run, end)
    assert half is not None
    assert done is not None
    assert done.left_s < 0.2 * half.left_s


def test_another_machine_or_other_settings_are_told_to_be_rough(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run = interrupted("again", 0.5)
    begin, end = times(world.catalog.run("fitted"))
    now = (begin + end) / 2
    change(run.folder / ENVIRONMENT, device_name="another processor")
    elsewhere = forecast(world).of_run(run, now)
    assert elsewhere is not None
    assert elsewhere.basis.startswith("roughly")
    assert elsewhere.left_s == pytest.approx(end - now, rel=0.1)
    job = yaml.safe_load((run.folder / "job.yaml").read_text())
    job["config"]["profile"]["object_"]["first_order"]["iterations"] *= 400
    (run.folder / "job.yaml").write_text(yaml.safe_dump(job))
    longer = forecast(world).of_run(Run.open(run.folder), now)
    assert longer is not None
    assert longer.left_s > 1.5 * elsewhere.left_s


def test_nothing_is_told_where_nothing_is_known(
    world: World, interrupted: Callable[..., Run]
) -> None:
    run = interrupted("again", 0.5)
    bundled = world.catalog.run("towel_fold_quick")
    assert forecast(world).of_waiting(run) is not None
    fresh = Run.create(
        world.settings.run_dir / "fresh",
        name="new",
        kind="reconstruction",
        sequences=run.sequences,
        config=run.config,
    )
    assert forecast(world).of_run(fresh) is None
    assert forecast(world).of_waiting(fresh) is not None
    simulated = Run.create(
        world.settings.run_dir / "simulated",
        name="s",
        kind="simulation",
        sequences=run.sequences,
        config={"source": str(bundled.folder), "parameters": {}},
    )
    assert forecast(world).of_waiting(simulated) is None
    (run.folder / ENVIRONMENT).write_text("{")
    assert forecast(world).of_run(run) is None
    shutil.rmtree(world.settings.sequence_dir / "sheet")
    assert forecast(world).of_waiting(fresh) is None


def test_more_frames_take_longer_and_damaged_runs_teach_nothing(world: World) -> None:
    profile = world.catalog.run("fitted").config["profile"]
    of = forecast(world)
    short, long = of.of_order(profile, [10]), of.of_order(profile, [1000])
    assert short is not None
    assert long is not None
    assert short.kind == "same"
    assert long.kind == "scaled"
    assert long.seconds > 50 * short.seconds
    begin, end = times(world.catalog.run("fitted"))
    assert short.seconds == pytest.approx(end - begin, rel=0.01)
    (world.catalog.run("fitted").folder / "exit.json").write_text("[")
    only_bundled = forecast(world).of_order(profile, [10])
    assert only_bundled is not None
    assert only_bundled.kind == "scaled"


def test_the_newest_of_equal_fits_give_the_median(world: World, tmp_path: Path) -> None:
    fitted = world.catalog.run("fitted")
    begin, end = times(fitted)
    for number, factor in enumerate((3.0, 1.0), start=1):
        folder = world.settings.run_dir / f"copy{number}"
        shutil.copytree(fitted.folder, folder)
        events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
        stretched = [event | {"time": begin + factor * (event["time"] - begin)} for event in events]
        (folder / "events.jsonl").write_text("".join(f"{json.dumps(e)}\n" for e in stretched))
        stop = datetime.fromtimestamp(begin + factor * (end - begin)).astimezone()
        change(folder / "exit.json", time=stop.isoformat())
    plan = forecast(world).of_order(fitted.config["profile"], [10])
    assert plan is not None
    assert plan.count == 3
    assert plan.seconds == pytest.approx(end - begin, rel=0.05)
    assert replace(plan, count=1).basis != plan.basis
