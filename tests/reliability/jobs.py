"""The queue and its processes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from psutil import _pslinux

from physhandi.data.lease import live_holder
from physhandi.run import Run
from reliability import Case, Report


@contextmanager
def clock_set_by(seconds: float) -> Iterator[None]:
    """Let this process see the clock as if somebody had set it."""
    now, booted = time.time, _pslinux.boot_time
    with (
        patch("time.time", lambda: now() + seconds),
        # The kernel tells when it was started by the clock as it is now.
        patch("psutil._pslinux.boot_time", lambda: booted() + seconds),
    ):
        yield


def set_clocks(count: int, folder: Path) -> Report:
    """Look at a run at work, and let it renew its lease, while the clock is set otherwise."""
    alive = Run.create(
        folder / "alive", name="alive", kind="reconstruction", sequences=[], config={}
    )
    wrong = done = 0
    with alive.begin_attempt() as attempt:
        for number in range(count):
            hours = (number // 2 + 1) * (-1) ** number
            with clock_set_by(3600.0 * hours):
                holder = live_holder(alive.folder)
                wrong += holder is None or alive.state != "running"
                attempt.heartbeat()
            wrong += live_holder(alive.folder) is None
            done += 1
        attempt.publish()
    return {"done": done, "wrong": wrong}


CASES = {"R13": Case("The clock is set by hours, forth and back, during a fit", 10, 4, set_clocks)}
