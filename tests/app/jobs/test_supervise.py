"""When a process is taken to hang, what a kill is put down to, and who is started again."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.server.run_world import make_run

from app.jobs.supervise import count_memory_kills
from app.jobs.ticket import (
    QUEUED,
    STARTED,
    Ticket,
    is_lost,
    note_end,
    note_start,
    put_in_line,
    read_ticket,
    start_again_or_end,
)
from app.jobs.vigil import Vigil
from physhandi.data.run_folder import EXIT

LIMIT_S = 120.0


def judge(vigil: Vigil, start: float, seconds: float, share: float, beat: int | None) -> str | None:
    """Look as often as is due; the process computes for that share of the time."""
    for number in range(round(seconds / vigil.interval_s)):
        if beat is not None:
            vigil.hear(beat)
        passed = (number + 1) * vigil.interval_s
        if (told := vigil.look(start + passed, share * (start + passed))) is not None:
            return f"after {passed:g} s: {told}"
    return None


@pytest.mark.parametrize(
    ("share", "beat", "told"),
    [
        (0.0, None, "after 120 s: Its process hung: it gave no sign of life for 120 s and did"),
        (0.5, None, "after 2400 s: Its process hung: it gave no sign of life for 40 min."),
        (0.001, 0, "after 4800 s: Its process hung: it got no further for 80 min and did nothing."),
        (0.5, 0, "None"),
    ],
    ids=["stopped", "in a library", "deadlocked", "at work"],
)
def test_a_process_hangs_if_it_neither_speaks_nor_computes(
    share: float, beat: int | None, told: str
) -> None:
    vigil = Vigil(LIMIT_S, now=0.0)
    assert str(judge(vigil, 0.0, 20_000.0, share, beat)).startswith(told)


def test_a_process_that_gets_on_never_hangs() -> None:
    vigil = Vigil(LIMIT_S, now=0.0)
    # One step in 4,000 s, as of a fit that waits for a graphics card.
    for number in range(5):
        assert judge(vigil, 4_000.0 * number, 4_000.0, 0.0, number) is None


def test_nobody_hangs_because_the_machine_slept() -> None:
    vigil = Vigil(LIMIT_S, now=0.0)
    assert judge(vigil, 0.0, 100.0, 0.0, None) is None
    # Watcher and worker wake up after hours; the worker has as long to speak as it had left.
    assert vigil.look(40_000.0, 0.0) is None
    assert judge(vigil, 40_000.0, 5.0, 0.0, 1) is None
    assert judge(vigil, 40_005.0, 115.0, 0.0, None) is None
    assert judge(vigil, 40_120.0, 10.0, 0.0, None) is not None


@pytest.mark.parametrize(
    ("groups", "file"),
    [
        ("0::/jobs", "sys/fs/cgroup/jobs/memory.events"),
        ("4:cpu,memory:/jobs\n0::/", "sys/fs/cgroup/memory/jobs/memory.oom_control"),
        ("4:memory:/hidden\n0::/", "sys/fs/cgroup/memory/memory.oom_control"),
        ("0::/", "proc/vmstat"),
    ],
)
def test_kills_for_want_of_memory_are_counted(tmp_path: Path, groups: str, file: str) -> None:
    assert count_memory_kills(tmp_path) == 0
    for name, text in (("proc/self/cgroup", groups), (file, "low 0\noom 3\noom_kill 2\nmax 1\n")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert count_memory_kills(tmp_path) == 2


def test_a_lost_run_gets_its_old_place_once(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "fit").folder
    put_in_line(folder, Ticket(time=5.0))
    note_start(folder, "cuda:1")
    (folder / QUEUED).unlink()
    assert is_lost(folder)
    start_again_or_end(folder, "It hung.")
    assert not is_lost(folder)
    again = Ticket(time=5.0, starts=1, why="It hung.", device="cuda:1")
    assert read_ticket(folder / QUEUED) == again
    note_start(folder, "cpu")
    started = read_ticket(folder / STARTED)
    assert started is not None
    assert started.device == "cpu"
    assert started.remark == "It hung. It was started again (2 of 2)."
    (folder / QUEUED).unlink()
    start_again_or_end(folder, "It hung.")
    assert not (folder / QUEUED).exists()
    assert "That happened twice" in (folder / EXIT).read_text()
    assert not (folder / STARTED).exists()


@pytest.mark.parametrize("end", ["CANCEL", EXIT])
def test_a_lost_run_that_was_to_end_or_had_ended_is_not_started_again(
    tmp_path: Path, end: str
) -> None:
    run = make_run(tmp_path / "fit")
    note_start(run.folder, "cpu")
    if end == EXIT:
        note_end(run.folder, "It failed.")
        note_start(run.folder, "cpu")
    else:
        run.request_cancel()
    start_again_or_end(run.folder, "It hung.")
    assert run.state == ("failed" if end == EXIT else "cancelled")
    assert not (run.folder / QUEUED).exists()
    assert not (run.folder / STARTED).exists()


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_a_run_whose_results_are_published_has_succeeded_however_its_process_ended(
    tmp_path: Path, is_cancelled: bool
) -> None:
    run = make_run(tmp_path / "fit")
    with run.begin_attempt() as attempt:
        attempt.publish()
    note_start(run.folder, "cpu")
    (run.folder / EXIT).unlink()  # The disk was full when it was to be noted.
    if is_cancelled:
        run.request_cancel()
    assert is_lost(run.folder)
    start_again_or_end(run.folder, "It lost its process.")
    assert json.loads((run.folder / EXIT).read_text())["state"] == "succeeded"
    assert run.state == "succeeded"
    assert not (run.folder / QUEUED).exists()
    assert not (run.folder / STARTED).exists()


@pytest.mark.parametrize("content", ["[" * 3000, "{}", '{"time": NaN}', '{"time": [1]}', "{torn"])
def test_a_damaged_ticket_is_as_a_new_one(tmp_path: Path, content: str) -> None:
    (tmp_path / QUEUED).write_text(content)
    assert read_ticket(tmp_path / QUEUED) == Ticket()
    assert read_ticket(tmp_path / STARTED) is None


def test_each_damaged_field_of_a_ticket_is_as_in_a_new_one(tmp_path: Path) -> None:
    whole = {"time": 5, "starts": 1, "why": "Lost.", "device": "cpu", "engine": "", "who": "me"}
    (tmp_path / QUEUED).write_text(json.dumps(whole))
    ticket = Ticket(5.0, 1, "Lost.", "cpu", who="me")
    assert read_ticket(tmp_path / QUEUED) == ticket
    for name, value in (("starts", True), ("starts", -1), ("device", "a\0b"), ("who", "a\0b")):
        (tmp_path / QUEUED).write_text(json.dumps(whole | {name: value}))
        expected = replace(ticket, **{name: getattr(Ticket(), name)})
        # Python takes true for 1.
        assert repr(read_ticket(tmp_path / QUEUED)) == repr(expected), name


def test_supervising_a_run_loads_no_numpy(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "sys.modules['numpy'] = None\n"
        "import app.jobs.supervise\n"
        "from app.jobs.ticket import note_end, note_start\n"
        "note_start(Path(sys.argv[1]), 'cpu')\n"
        "note_end(Path(sys.argv[1]), 'It failed.')\n"
    )
    command = [sys.executable, "-c", code, str(run.folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert run.state == "failed"
