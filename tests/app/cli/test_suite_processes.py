"""Processes that share the work on a suite: same tables, each cell once, and a clear end."""

import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.server.suite_world import order_of, table, write_told
from support.waiting import LIMIT_S

from app.cli import suite_processes
from app.cli.suite_processes import SuiteProcesses
from app.cli.suite_work import in_order, order_from_json, order_to_json, told_of
from physhandi.data.lease import locked_file
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.run import Run
from physhandi.synthetic.suite import evaluation
from physhandi.synthetic.suite.evaluation import Order, evaluate_suite, filler, list_tasks
from physhandi.synthetic.suite.methods import parse_method

METHODS = ("static", "quick", "quick+last_residual")
CELLS = 10
"""Three methods and two recordings; two of the methods once more where nothing was fitted."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence, ...]:
    root = tmp_path_factory.mktemp("recordings")
    return write_told(root / "low", 0.12), write_told(root / "high", 0.2, "wipe")


@pytest.fixture(scope="module")
def order(recordings: tuple[Sequence, ...]) -> Order:
    return order_of(recordings, at_once=2, methods=METHODS)


def children() -> list[psutil.Process]:
    """The processes of suites that are alive; others may be ending at this moment."""
    found = []
    for process in psutil.Process().children():
        with suppress(psutil.Error):
            if "app.cli.suite_processes" in process.cmdline():
                found.append(process)
    return found


class Watched(Progress):
    """Remembers what it is told, and asks to stop when some words are among it."""

    def __init__(self, stop_at: str = "") -> None:
        self.told: list[tuple[str, int, int, str]] = []
        self.stop_at = stop_at

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        self.told.append((stage, iteration, total, message))

    def check_cancelled(self) -> None:
        if self.stop_at and any(self.stop_at in message for *_, message in self.told):
            raise CancelledError("stopped")


def test_two_processes_give_the_table_of_one_tell_what_is_wrong_and_end_when_told(
    tmp_path: Path, order: Order
) -> None:
    evaluate_suite(order, tmp_path / "one")
    progress = Watched()
    with SuiteProcesses(2, progress) as workers:
        out = tmp_path / "two"
        found = evaluate_suite(order, out, progress, fill=workers.fill(order, out))
        shares = [process.cpu_affinity() for process in children()]
        assert sorted(shares) == suite_processes._shares(2)
        told = list(progress.told)
        refuse_in_their_words(workers, order, tmp_path)
        keep_what_is_finished(workers, replace(order, methods=METHODS[:2]), tmp_path, progress)
    assert (found["cells"], found["failed"], found["skipped"]) == (CELLS, 0, [])
    assert children() == []
    one, two = table(tmp_path / "one"), table(out)
    assert list(one) == list(two)
    for key, row in one.items():
        if key[1] == "runtime":
            assert float(two[key]["mean"]) > 0
        else:  # One thread or two, sums are rounded otherwise.
            assert float(two[key]["mean"]) == pytest.approx(float(row["mean"]), rel=2e-3), key
    names = [sorted(p.name for p in (tmp_path / n / "cells").iterdir()) for n in ("one", "two")]
    assert names[0] == names[1]
    assert {Run.open(out / "cells" / name).attempt for name in names[1]} == {1}
    assert told[-1][:3] == ("suite", CELLS, CELLS)
    assert any("quick, low" in message for *_, message in told)
    assert "shared by 2 cells at a time" in (out / "report.md").read_text()


def refuse_in_their_words(workers: SuiteProcesses, order: Order, folder: Path) -> None:
    """See that what a process finds wrong is told in its words, and that it works on."""
    wrong = replace(
        order,
        recordings=order.recordings[:1],
        methods=("quick@object_.search.population=1",),
        protocols=("main",),
    )
    told = r"population is 1; expected a whole number from 2"
    with pytest.raises(UsageError, match=told):
        evaluate_suite(wrong, folder / "wrong", fill=workers.fill(wrong, folder / "wrong"))
    making = {"object": "brick", "action": "lift", "seed": 0}
    with pytest.raises(UsageError, match="no object named 'brick'"):
        workers.make({folder / "brick": making})
    assert not (folder / "brick").exists()


def keep_what_is_finished(
    workers: SuiteProcesses, order: Order, folder: Path, progress: Watched
) -> None:
    """Wish to stop as soon as a second method is begun, and leave processes at work."""
    progress.stop_at = "quick, low"
    progress.told.clear()
    out = folder / "stopped"
    with pytest.raises(CancelledError):
        evaluate_suite(order, out, progress, fill=workers.fill(order, out))
    stored = json.loads((out / "cells.json").read_text())
    assert {cell["method"] for cell in stored["cells"]} >= {"static"}
    assert stored["about"]["missing"] > 0


def test_whatever_is_made_of_other_cells_comes_last(recordings: tuple[Sequence, ...]) -> None:
    methods = ("quick+last_residual", "static", "quick")
    asked = order_of(recordings, methods=methods, protocols=("unseen", "main"))
    tasks = list(list_tasks(asked, [parse_method(name) for name in methods]))
    placed = [tasks[number] for number in in_order(tasks)]
    assert sorted(map(id, placed)) == sorted(map(id, tasks))
    assert [(t.method.name, t.recording.name) for t in placed if t.protocol == "main"] == [
        *(("static", "low"), ("static", "high"), ("quick", "low"), ("quick", "high")),
        *(("quick+last_residual", "low"), ("quick+last_residual", "high")),
    ]
    assert [t.protocol for t in placed] == ["main"] * 6 + ["unseen"] * 4


class Heard(Watched):
    """Tells when it is told that a process waits."""

    def __init__(self) -> None:
        super().__init__()
        self.waits = threading.Event()

    def report(self, stage: str, *about: Any, **more: Any) -> None:
        super().report(stage, *about, **more)
        if "waits for" in stage + str(more.get("message", "")):
            self.waits.set()


def test_a_cell_that_another_process_fills_is_waited_for_and_who_does_is_told(
    tmp_path: Path, order: Order
) -> None:
    (tmp_path / "locks").mkdir()
    fill = filler(replace(order, methods=("static",)), tmp_path, NullProgress())
    fill(0)
    (name,) = (path.name for path in (tmp_path / "cells").iterdir())
    heard = Heard()
    again = filler(replace(order, methods=("static",)), tmp_path, heard)
    waiting = threading.Thread(target=lambda: again(0))
    with locked_file(tmp_path / "locks" / name):
        waiting.start()
        assert heard.waits.wait(LIMIT_S)
        assert waiting.is_alive()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()
    told = f"waits for process {os.getpid()} on "
    assert any(told in stage for stage, *_ in heard.told)
    assert Run.open(tmp_path / "cells" / name).attempt == 1


def test_what_a_process_does_is_told_in_a_few_words() -> None:
    said = {"stage": "search", "iteration": 3, "total": 8}
    assert told_of("quick, low", said) == "quick, low search 37 %"
    said = {"stage": "waits for process 7 on vm", "iteration": 0, "total": 0}
    assert told_of("quick, low", said) == "quick, low waits for process 7 on vm"


class Killer(Watched):
    """Kills the process at work on a cell, as often as told, while the cell cannot be finished."""

    def __init__(self, order: Order, out: Path, times: dict[str, int]) -> None:
        super().__init__()
        self._left = dict(times)
        self._victims: set[int] = set()
        self._held = {method: ExitStack() for method in times}
        (out / "locks").mkdir()
        for method, held in self._held.items():
            held.enter_context(locked_file(lock_of(method, order, out)))

    def check_cancelled(self) -> None:
        method = self.told[-1][3].split(",")[0] if self.told else ""
        alive = [process for process in children() if process.pid not in self._victims]
        if alive and self._left.get(method):
            self._left[method] -= 1
            self._victims.add(alive[0].pid)
            alive[0].send_signal(signal.SIGKILL)
            if not self._left[method]:
                self._held[method].close()


def lock_of(method: str, order: Order, out: Path) -> Path:
    """The lock that whoever fills the first recording's cell of a method holds."""
    work = evaluation._Work(evaluation._read(order)[0], out, NullProgress())
    cell = work.bench._folder(parse_method(method), order.recordings[0], "recording")
    return out / "locks" / cell.name


@pytest.fixture
def small(recordings: tuple[Sequence, ...]) -> Order:
    return order_of(recordings[:1], methods=("static", "rigid_follow"), protocols=("main",))


def test_a_cell_is_computed_once_more_by_a_new_process_and_fails_if_that_is_lost_too(
    tmp_path: Path, small: Order, caplog: pytest.LogCaptureFixture
) -> None:
    killer = Killer(small, tmp_path, {"static": 1, "rigid_follow": 2})
    with SuiteProcesses(1, killer) as workers:
        found = evaluate_suite(small, tmp_path, killer, fill=workers.fill(small, tmp_path))
    assert children() == []
    assert (found["cells"], found["failed"], found["skipped"]) == (2, 1, [])
    told = r"The process that worked on it ended, 2 times (exit code -9). If memory ran out, take"
    assert f"rigid_follow, low, main: {told}" in caplog.text
    (cell,) = (c for c in json.loads((tmp_path / "cells.json").read_text())["cells"] if c["error"])
    assert (cell["method"], cell["case"]) == ("rigid_follow", "low")
    assert cell["error"].startswith(told)
    scored = table(tmp_path)
    key = ("future", "track_error")
    # As any method without output, it counts as the static object.
    assert scored["rigid_follow", *key]["mean"] == scored["static", *key]["mean"]
    found = evaluate_suite(small, tmp_path)
    assert (found["cells"], found["failed"]) == (2, 0)
    assert table(tmp_path)["rigid_follow", *key]["mean"] != scored["static", *key]["mean"]


def test_a_lost_cell_without_which_nothing_can_be_scored_is_left_out_and_says_so(
    tmp_path: Path, small: Order
) -> None:
    def lose(tasks: object) -> Iterator[tuple[int, str]]:
        yield from ((number, "It was lost.") for number in range(2))

    found = evaluate_suite(small, tmp_path, fill=lose)
    assert (found["cells"], found["failed"]) == (0, 0)
    assert found["skipped"] == [f"{m}, low, main: It was lost." for m in small.methods]
    assert not list((tmp_path / "cells").glob("*")) if (tmp_path / "cells").exists() else True


def test_an_order_survives_being_told_to_another_process(order: Order) -> None:
    again = order_from_json(json.loads(json.dumps(order_to_json(order))))
    assert [r.fingerprint() for r in again.recordings] == [
        r.fingerprint() for r in order.recordings
    ]
    assert replace(again, recordings=()) == replace(order, recordings=())
    assert again.methods == METHODS


@pytest.mark.parametrize(
    ("processors", "count", "shares"),
    [
        ({0, 1}, 2, [[0], [1]]),
        ({0, 1, 2, 3, 4}, 2, [[0, 1], [2, 3, 4]]),
        ({3}, 2, [[3], [3]]),
        ({2, 5}, 3, [[2], [2], [5]]),
    ],
)
def test_processors_are_shared_out(
    monkeypatch: pytest.MonkeyPatch, processors: set[int], count: int, shares: list[list[int]]
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: processors)
    assert suite_processes._shares(count) == shares
