"""Where a run is on its way, and why it stopped."""

import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.server.run_world import make_run

from app.jobs.views import explain, stage_views, stages_of
from physhandi.data.files import write_json
from physhandi.fitting.config import STAGES, planned_stages
from physhandi.run import Run

NAMES = ["hands", "observation", "search", "springs", "evaluation"]
DONE = [{"name": "hands", "seconds": 3.5, "summary": {"before": 2.0, "after": 1.0}}]


def states(state: str, latest: str | None, finished: list[dict] = DONE) -> dict[str, str]:
    return {view.name: view.state for view in stage_views(NAMES, finished, state, latest)}


def test_a_running_stage_stands_between_what_is_done_and_what_is_to_come() -> None:
    views = stage_views(NAMES, DONE, "running", "observation")
    assert [view.state for view in views] == ["done", "at-work", "to-come", "to-come", "to-come"]
    assert (views[0].seconds, views[0].before, views[0].after) == (3.5, 2.0, 1.0)
    assert views[1].seconds is None


@pytest.mark.parametrize(
    ("state", "mark"),
    [("failed", "failed"), ("cancelled", "stopped"), ("running", "at-work"), ("queued", "to-come")],
)
@pytest.mark.parametrize("latest", ["observation", "hands", None])
def test_the_stage_that_was_reached_is_marked_even_if_it_never_reported(
    state: str, mark: str, latest: str | None
) -> None:
    shown = states(state, latest)
    assert shown["observation"] == mark
    assert shown["hands"] == "done"
    assert shown["search"] == "to-come"


def test_a_stage_tells_why_it_went_no_further() -> None:
    short = [{"name": "hands", "summary": {"before": 2.0, "after": 1.0, "note": "Stopped early."}}]
    assert stage_views(NAMES, short, "running", "observation")[0].note == "Stopped early."
    assert stage_views(NAMES, DONE, "running", "observation")[0].note == ""


def test_a_stage_that_was_passed_over_is_left_out() -> None:
    late = [*DONE, {"name": "evaluation", "summary": {}}]
    assert states("succeeded", "evaluation", late) == {"hands": "done", "evaluation": "done"}
    search = [*DONE, {"name": "search", "summary": {}}]
    assert "observation" not in states("running", "springs", search)
    assert states("failed", "springs", search)["springs"] == "failed"
    assert states("succeeded", "extra", []) == {}


def test_a_run_that_was_not_begun_has_all_stages_to_come(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    shown = stages_of(run, "queued")
    assert [(stage["name"], stage["state"]) for stage in shown] == [
        (name, "to-come") for name in STAGES
    ]
    assert [stage["name"] for stage in stages_of(make_run(tmp_path / "b", kind="simulation"), "")]


def test_a_run_that_fits_a_look_has_a_stage_more(tmp_path: Path) -> None:
    look = {"profile": {"appearance": {"enabled": True}}}
    run = make_run(tmp_path / "run", config=look)
    names = [stage["name"] for stage in stages_of(run, "queued")]
    assert names == [*STAGES[:-1], "appearance", "evaluation"]
    for odd in ({"appearance": {"enabled": "yes"}}, {"appearance": 3}, ["appearance"], None):
        assert planned_stages(odd) == STAGES


def test_the_time_of_a_stage_is_measured_and_an_older_attempts_report_is_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    times = iter([100.0, 107.25, 107.5, 110.0])
    with run.begin_attempt() as attempt:
        monkeypatch.setattr(attempt, "_stage_clock", next(times))
        clock = SimpleNamespace(monotonic=lambda: next(times), time=time.time)
        monkeypatch.setattr("physhandi.data.attempt.time", clock)
        attempt.finish_stage(STAGES[0], {})
        monkeypatch.undo()
        attempt.progress().report(STAGES[3], 1, 2)
    assert run.stages()[0]["seconds"] == 7.25
    assert {s["name"]: s["state"] for s in stages_of(run, "failed")}[STAGES[3]] == "failed"
    with run.begin_attempt():
        shown = {s["name"]: s["state"] for s in stages_of(run, "running")}
        assert (shown[STAGES[0]], shown[STAGES[1]]) == ("done", "at-work")
        assert shown[STAGES[3]] == "to-come"


def test_a_run_may_be_deleted_while_its_stages_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    with run.begin_attempt() as attempt:
        attempt.finish_stage(STAGES[0], {})
        attempt.progress().report(STAGES[1], 1, 2)
    told = stages_of(run, "failed")
    assert {s["name"]: s["state"] for s in told}[STAGES[1]] == "failed"
    read = Run.stages

    def deleted_then(run: Run) -> list[dict[str, Any]]:
        stages = read(run)
        shutil.rmtree(run.folder)
        return stages

    monkeypatch.setattr(Run, "stages", deleted_then)
    assert stages_of(run, "failed") == told
    assert run.attempt is None


@pytest.mark.parametrize(
    ("kind", "error", "message", "advice"),
    [
        ("MissingInputError", "'x' lacks depth.", "'x' lacks depth.", "import it again"),
        ("SimulationDivergedError", "Node 3 is fast.", "Node 3 is fast.", "softer springs"),
        ("KeyError", "'node'", "mistake of its own (KeyError: 'node')", "not of your recording"),
        ("MemoryError", "", "not enough memory", "fewer nodes"),
        (
            "RuntimeError",
            "Failed to allocate 80000 bytes on device 'cuda:0'",
            "memory of the device ran out: Failed to allocate",
            "smaller population",
        ),
        (
            "OutOfMemoryError",
            "CUDA out of memory. Tried to allocate 2.00 GiB.",
            "memory of the device ran out: CUDA out of memory",
            "smaller population",
        ),
        ("PermissionError", "no", "no", "data folder"),
        ("", "The worker was killed.", "The worker was killed.", "Resume"),
        ("ImportFailedError", "bad", "bad", "Resume"),
    ],
)
def test_a_failure_is_told_in_words_with_what_to_do(
    tmp_path: Path, kind: str, error: str, message: str, advice: str
) -> None:
    run = make_run(tmp_path / "run")
    write_json(run.folder / "exit.json", {"state": "failed", "error": error, "error_type": kind})
    failure = explain(Run.open(run.folder), error)
    assert message in failure.message
    assert advice in failure.advice


def test_a_damaged_run_says_which_file_to_repair() -> None:
    assert explain(None, "run.yaml cannot be read.").message == "run.yaml cannot be read."


@pytest.mark.parametrize(
    ("name", "files", "state"),
    [
        ("hand_reconstruction", {"sequences/rope/meta.yaml": {}}, "passed"),
        ("hand_reconstruction", {"sequences/a/hand_left_vertex.npy": {}}, "done"),
        ("hand_refinement", {}, "passed"),
        ("observation", {}, "done"),
    ],
)
def test_a_stage_of_the_hand_that_found_no_hand_is_not_called_done(name, files, state) -> None:
    finished = [{"name": name, "seconds": 0.0, "summary": {}, "files": files}]
    assert stage_views([name], finished, "succeeded", None)[0].state == state
