"""The queue and its processes."""

import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from psutil import _pslinux
from sheet_sequence import write_sheet

from app.jobs.catalog import Catalog
from app.jobs.launch_keys import KeyedRequest
from app.jobs.scheduler import Scheduler
from app.settings import ServerSettings
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


def submit_again(count: int, folder: Path) -> Report:
    """Ask for the same fit from eight threads, with a new server after each quarter."""
    write_sheet(folder / "sequences" / "sheet")
    settings = ServerSettings(data_dir=folder)
    request = KeyedRequest.of("the key", {"sequences": ["sheet"]})
    answers: Counter[str] = Counter()

    def submit(scheduler: Scheduler) -> str:
        return scheduler.launch(["sheet"], "quick", request=request).id

    with ThreadPoolExecutor(8) as pool:
        while answers.total() < count:
            scheduler = Scheduler(settings, Catalog(settings))
            asked = min(max(1, count // 4), count - answers.total())
            answers.update(pool.map(submit, [scheduler] * asked))
    runs = [path for path in settings.run_dir.iterdir() if (path / "queued.json").is_file()]
    return {"done": answers.total(), "runs": len(runs), "wrong": len(answers) + len(runs) - 2}


CASES = {
    "R13": Case("The clock is set by hours, forth and back, during a fit", 10, 4, set_clocks),
    "R15": Case(
        "The same fit is asked for again, at once and after restarts", 1000, 40, submit_again
    ),
}
