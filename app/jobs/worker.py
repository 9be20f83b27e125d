"""The process that fills one run: `python -m app.jobs.worker --run-dir DIR`."""

import argparse
import logging
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from app.child import die_with_parent
from physhandi.errors import CancelledError, PhysHandiError, describe
from physhandi.progress import Progress
from physhandi.run import Run

logger = logging.getLogger(__name__)
_LOG_INTERVAL_S = 5.0


class LoggedProgress(Progress):
    """Logs when a stage begins, and now and then how far it is."""

    def __init__(self) -> None:
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
        if stage == self._stage and time.monotonic() - self._time < _LOG_INTERVAL_S:
            return
        self._stage, self._time = stage, time.monotonic()
        told = f"{stage}: {iteration} of {total}"
        told += "" if loss is None else f", loss {loss:.4g}"
        logger.info("%s", f"{told} ({message})" if message else told)


def work(run_folder: Path, device: str) -> int:
    """Run the pipeline for a run folder; returns the exit code.

    The run folder tells how it ended; the log has the details.
    """
    run = Run.open(run_folder)
    logger.info("run %s begins on %s", run.id, device)
    try:
        from physhandi import pipeline

        pipeline.run_job(run, LoggedProgress(), device=device)
    except CancelledError as error:
        logger.info("%s", error)
        return 0
    except (PhysHandiError, OSError) as error:
        # The message is for the user; no traceback.
        logger.error("%s", describe(error))  # noqa: TRY400
        return 1
    except Exception as error:
        defect = f"{type(error).__name__}: {error}"
        logger.exception("run %s stopped by a defect of the program (%s)", run.id, defect)
        return 1
    logger.info("run %s is finished", run.id)
    return 0


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise CancelledError("The process was asked to end.")


def main(argv: list[str] | None = None) -> None:
    """Read the arguments, work, exit."""
    parser = argparse.ArgumentParser(prog="physhandi-worker", description=__doc__)
    parser.add_argument("--run-dir", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--parent", type=int, help="process id of the supervisor")
    options = parser.parse_args(argv)
    if options.parent is not None:
        die_with_parent(options.parent)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    signal.signal(signal.SIGTERM, _stop)
    sys.exit(work(options.run_dir, options.device))


if __name__ == "__main__":
    main()
