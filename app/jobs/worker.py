"""The process that fills one run: `python -m app.jobs.worker --run-dir DIR`."""

import argparse
import logging
import signal
import sys
from pathlib import Path
from types import FrameType

from app.jobs.processes import die_with_parent
from physhandi.data.run import Run
from physhandi.errors import CancelledError, PhysHandiError

logger = logging.getLogger(__name__)


def work(run_folder: Path, device: str) -> int:
    """Run the pipeline for a run folder; returns the exit code.

    The run folder tells how it ended; the log has the details.
    """
    run = Run.open(run_folder)
    logger.info("run %s begins on %s", run.id, device)
    try:
        from physhandi import pipeline

        pipeline.run_job(run, device=device)
    except CancelledError as error:
        logger.info("%s", error)
        return 0
    except PhysHandiError as error:
        logger.error("%s", error)  # noqa: TRY400  # the message is for the user; no traceback
        return 1
    except Exception:
        logger.exception("run %s stopped by a defect of the program", run.id)
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
