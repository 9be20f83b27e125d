"""The process that fills one run: ``python -m app.jobs.worker RUN_FOLDER DEVICE BEAT_S``.

The run folder tells how far it is and how it ended; its log has the details.
"""

import logging
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from app.jobs.processes import STORE
from physhandi.child import Channel, loading_modules, run_child
from physhandi.errors import CancelledError
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.run_store import RunStore

logger = logging.getLogger(__name__)
_LOG_INTERVAL_S = 5.0


class LoggedProgress(Progress):
    """Logs when a stage begins, and now and then how far it is."""

    def __init__(self, step: Callable[[], None]) -> None:
        """Prepare.

        Args:
            step: Is told that the work got on.
        """
        self._step = step
        self._stage = ""
        self._time = 0.0

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Log a report, unless the last one was just now; see `Progress.report`."""
        self._step()
        if stage == self._stage and time.monotonic() - self._time < _LOG_INTERVAL_S:
            return
        self._stage, self._time = stage, time.monotonic()
        line = f"{stage}: {iteration} of {total}"
        line += "" if loss is None else f", loss {loss:.4g}"
        logger.info("%s", f"{line} ({message})" if message else line)


def fill_run(run_folder: Path, device: str, step: Callable[[], None]) -> None:
    """Run the pipeline for a run folder.

    Args:
        run_folder: The run.
        device: Warp device.
        step: Is told that the work got on.

    Raises:
        PhysHandiError: If it failed or was cancelled, as the run folder says too.
    """
    run = Run.open(run_folder)
    logger.info("run %s begins on %s", run.id, device)
    with loading_modules():
        from physhandi import pipeline

    url = os.environ.get(STORE)
    store = RunStore(url) if url else None
    pipeline.run_job(run, LoggedProgress(step), device=device, store=store)
    logger.info("run %s is finished", run.id)


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise CancelledError("The process was asked to end.")


def _work(channel: Channel) -> None:
    run_folder, device, beat_s = channel.arguments
    channel.beat(float(beat_s))
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    signal.signal(signal.SIGTERM, _stop)
    fill_run(Path(run_folder), device, channel.step)


if __name__ == "__main__":
    run_child(_work)
