"""A worker for tests of the queue: the run's name tells what it does.

One whose name begins with ``real`` is fitted, as by the worker of the server.
"""

import json
import os
import signal
import subprocess
import sys
import time

from app.jobs.worker import fill_run
from physhandi.child import Channel, run_child
from physhandi.data.attempt import Attempt
from physhandi.errors import MissingInputError
from physhandi.run import Run

STEP_S = 0.02


def publish(run: Run, attempt: Attempt) -> None:
    progress = attempt.progress()
    if not attempt.stage_done("first"):
        progress.report("first", 1, 1, 2.0)
        attempt.save_json("first.json", {"attempt": attempt.number})
        attempt.finish_stage("first", {"before": 2.0, "after": 1.0})
    progress.report("second", 1, 1, 0.5)
    attempt.publish()


def wait(run: Run, attempt: Attempt) -> None:
    """Report until the file `go` is there; a cancel is obeyed at once."""
    progress = attempt.progress()
    progress.report("first", 1, 1, 2.0)
    if not attempt.stage_done("first"):
        attempt.save_json("first.json", {"attempt": attempt.number})
        attempt.finish_stage("first", {"before": 2.0, "after": 1.0})
    iteration = 0
    while not (run.folder / "go").exists():
        iteration += 1
        progress.report("second", min(iteration, 999), 1000, 1.0)
        progress.check_cancelled()
        time.sleep(STEP_S)
    attempt.publish()


def stubborn(run: Run, attempt: Attempt) -> None:
    """Ignore every polite request, and so does a child in a session of its own."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen(["sleep", "300"], start_new_session=True)
    attempt.progress().report("first", 1, 1, 2.0)
    (run.folder / "pids.tmp").write_text(f"{os.getpid()} {child.pid}")
    (run.folder / "pids.tmp").rename(run.folder / "pids")
    while True:
        signal.pause()


def frozen(run: Run, attempt: Attempt) -> None:
    """Stand still once, then do the work."""
    if attempt.number == 1:
        attempt.progress().report("first", 1, 1, 2.0)
        os.kill(os.getpid(), signal.SIGSTOP)
    publish(run, attempt)


def fail(run: Run, attempt: Attempt) -> None:
    raise MissingInputError("'sheet' lacks a <b>hand</b>.")


def defect(run: Run, attempt: Attempt) -> None:
    attempt.progress().report("zeroth_order", 1, 4, 2.0)
    {}["a <b>key</b>"]


def no_memory(run: Run, attempt: Attempt) -> None:
    attempt.progress().report("zeroth_order", 1, 4, 2.0)
    raise MemoryError


def no_device_memory(run: Run, attempt: Attempt) -> None:
    attempt.progress().report("zeroth_order", 1, 4, 2.0)
    raise RuntimeError("Failed to allocate 123456789 bytes on device 'cuda:0'")


def lost_device(run: Run, attempt: Attempt) -> None:
    attempt.progress().report("zeroth_order", 1, 4, 2.0)
    raise RuntimeError("CUDA error 719: unspecified launch failure")


def script(run: Run, attempt: Attempt) -> None:
    """Do what the lines of the file `script` say, in the order in which they are added."""
    progress = attempt.progress()
    done = 0
    while True:
        lines = (run.folder / "script").read_text().split("\n")[:-1] if is_there(run) else []
        for line in lines[done:]:
            done += 1
            command, *values = json.loads(line)
            if command == "report":
                progress.report(*values)
            elif command == "log":
                sys.stdout.write("\n".join([*values, ""]))
                sys.stdout.flush()
            elif command == "save":
                attempt.save_json(*values)
            elif command == "finish":
                attempt.finish_stage(*values)
            elif command == "fail":
                raise MissingInputError(*values)
            elif command == "publish":
                attempt.publish()
                return
        time.sleep(STEP_S)
        progress.check_cancelled()


def is_there(run: Run) -> bool:
    return (run.folder / "script").is_file()


def crash(run: Run, attempt: Attempt) -> None:
    os.write(1, b"the last words\n")
    os._exit(7)


DEEDS = (
    *(publish, wait, stubborn, frozen, fail, crash, defect, script),
    *(no_memory, no_device_memory, lost_device),
)
BEHAVIOURS = {f.__name__: f for f in DEEDS}


def work(channel: Channel) -> None:
    run = Run.open(channel.arguments[0])
    channel.beat(float(channel.arguments[2]))
    if run.name == "silent":
        raise SystemExit(5)
    if run.name.startswith("real "):
        fill_run(run.folder, channel.arguments[1], channel.step)
        return
    with run.begin_attempt() as attempt:
        BEHAVIOURS[run.name.split()[0]](run, attempt)


if __name__ == "__main__":
    run_child(work)
