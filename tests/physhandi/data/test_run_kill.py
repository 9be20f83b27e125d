"""A worker that is killed in the middle of writing leaves nothing corrupt."""

import json
import multiprocessing
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import yaml
from safetensors.numpy import load_file
from support.waiting import until

from physhandi.data.run_folder import attempt_numbers, read_events
from physhandi.run import Run

KILLS = 30
MOST_WRITTEN = 40
"""Files that are written between start and kill, at most."""
FILE_CALLS = {"open", "write", "tofile", "flush", "fsync", "close", "replace", "unlink", "mkdir"}
CALLS_APART = 11
"""Calls to the file system by which each death of a child's own is later than the one before."""


def die_before(last: int) -> None:
    """Let this process be gone before it makes its `last`-th call to the file system."""
    made = 0

    def count(frame: FrameType, event: str, function: Any) -> None:
        nonlocal made
        if event == "c_call" and getattr(function, "__name__", "") in FILE_CALLS:
            made += 1
            if made >= last:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(count)


def write_for_ever(folder: Path, written: Any, last: int | None) -> None:
    run = Run.open(folder)
    if last is not None:
        die_before(last)
    attempt = run.begin_attempt()
    progress = attempt.progress()
    if not attempt.stage_done("first"):
        attempt.save_json("first.json", [1])
        attempt.finish_stage("first")
    checkpointer = attempt.checkpointer({"settings": "any"})
    state = checkpointer.load("state", {"x": np.full(20_000, 0)})
    number = 0 if state is None else state.iteration
    while True:
        number += 1
        for write in (
            lambda n: attempt.save_array("array.npy", np.full(50_000, n)),
            lambda n: attempt.save_tensors("tensors.safetensors", {"x": np.full(20_000, n)}),
            lambda n: attempt.save_json("data.json", [n] * 100),
            lambda n: attempt.save_yaml("data.yaml", {"number": n}),
            lambda n: checkpointer.write("state", n, {"x": np.full(20_000, n)}),
            lambda n: progress.report("write", n, 10**9, float(n)),
        ):
            write(number)
            written.value += 1


def holder_of(folder: Path) -> int | None:
    path = folder / "lease.json"
    return json.loads(path.read_text())["pid"] if path.exists() else None


def kept_number(run: Run) -> int:
    """Number of the latest checkpoint that the next attempt would go on from; 0 without one."""
    numbers = attempt_numbers(run.folder)
    folder = run.folder / "attempts" / str(numbers[-1] if numbers else 0) / "ckpt"
    return max((int(load_file(path)["x"][0]) for path in folder.glob("[!.]*")), default=0)


def check_whole(run: Run) -> int:
    """Read every file in the way a reader does; return how many there were."""
    count = 0
    for path in run.folder.rglob("*"):
        if path.name.startswith(".") or not path.is_file():
            continue
        count += 1
        if path.suffix == ".npy":
            assert len(set(np.load(path).tolist())) == 1
        elif path.suffix == ".safetensors":
            assert len(set(load_file(path)["x"].tolist())) == 1
        elif path.suffix == ".json":
            assert json.loads(path.read_text()) is not None
        elif path.suffix == ".yaml":
            assert isinstance(yaml.safe_load(path.read_text()), dict)
    events, _ = read_events(run.folder)
    assert [event["seq"] for event in events] == list(range(len(events)))
    return count


def kill_after(count: int, child: Any, written: Any, run: Run) -> None:
    """Kill a child that holds the run and has written so many files."""

    def has_written() -> bool:
        assert child.is_alive()
        return holder_of(run.folder) == child.pid and written.value >= count

    until(has_written, interval=0.001)
    os.kill(child.pid, signal.SIGKILL)


def test_kills_in_the_middle_of_writing(tmp_path: Path) -> None:
    run = Run.create(
        tmp_path / "fit",
        name="fit",
        kind="reconstruction",
        sequences=["/data/sheet"],
        config={"a": 1},
    )
    context = multiprocessing.get_context("fork")
    chance = np.random.default_rng(7)
    files, leftovers, states, furthest = 0, 0, set(), 0
    for kill in range(KILLS):
        written = context.Value("i", 0, lock=False)
        # Every second child dies by itself, since what another process's kill hits is chance.
        last = 1 + CALLS_APART * (kill // 2) if kill % 2 else None
        child = context.Process(
            target=write_for_ever, args=(run.folder, written, last), daemon=True
        )
        child.start()
        if last is None:
            # Not after so much time, in which a busy machine gets nothing written.
            kill_after(int(chance.integers(0, MOST_WRITTEN)), child, written, run)
        child.join()
        assert child.exitcode == -signal.SIGKILL
        files += check_whole(run)
        leftovers += last is not None and any(run.folder.rglob(".*.tmp"))
        states.add(run.state)
        kept = kept_number(run)
        assert kept >= furthest  # A crash, also one at the very start, loses no earlier work.
        furthest = kept
    assert states <= {"failed", "queued"}
    assert "failed" in states
    assert files > 5 * KILLS
    assert furthest > 0
    assert leftovers > 2  # Otherwise no death came within a write, and the test shows nothing.
    with run.begin_attempt() as attempt:
        assert list(run.folder.rglob(".*.tmp")) == []
        assert kept_number(run) == furthest
        attempt.publish()
    run.verify()
    assert list(run.folder.glob("attempts/*/ckpt")) == []
    assert run.state == "succeeded"
    assert len(list((run.folder / "attempts").iterdir())) <= 3
