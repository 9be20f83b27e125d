"""The small process between server and worker: ``python -m app.jobs.supervise``.

It loads no heavy library, writes the log, notes how the worker ended if the worker could not, and
leaves no process behind.
"""

import os
import signal
from pathlib import Path

from app.jobs.processes import COOKIE, adopt_orphans, claim_supervision, end_processes
from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.data.files import write_json
from physhandi.data.lease import live_holder, locked
from physhandi.data.run_folder import CANCEL, EXIT, LOG, now
from physhandi.errors import PhysHandiError


def supervise(run_folder: Path, device: str, worker: str) -> None:
    """Run the worker of a run until it ends; nothing happens if the run has a supervisor."""
    claim = claim_supervision(run_folder)
    if claim is None:
        return
    adopt_orphans()
    (run_folder / EXIT).unlink(missing_ok=True)
    with Child(worker, str(run_folder), device, log=run_folder / LOG) as child:
        signal.signal(signal.SIGTERM, lambda _number, _frame: child.terminate())
        error, kind = _hear(child)
        nonce = os.environ.get(COOKIE, "").rpartition(":")[2]
        end_processes(run_folder, grace_s=0.0, spare=os.getpid(), nonce=nonce)
    if not (run_folder / EXIT).is_file():
        note_end(run_folder, error, kind)


def note_end(run_folder: Path, error: str, kind: str = "") -> None:
    """Write how a run ended for a worker that could not; what it wrote itself stays.

    Args:
        run_folder: The run.
        error: What went wrong; a run that was to be cancelled is cancelled whatever it is.
        kind: Name of the error's class, if it is known.
    """
    is_cancelled = (run_folder / CANCEL).exists()
    with locked(run_folder):
        if (run_folder / EXIT).is_file() or live_holder(run_folder) is not None:
            return
        content = {"state": "cancelled" if is_cancelled else "failed", "time": now()}
        content |= (
            {"error": "Cancelled.", "error_type": ""}
            if is_cancelled
            else {"error": error, "error_type": kind}
        )
        write_json(run_folder / EXIT, content)


def _hear(child: Child) -> tuple[str, str]:
    """Wait for the worker's end; returns what went wrong and the name of the error's class."""
    try:
        for _ in child.messages():
            pass
    except ChildEndedError as error:
        return _explain(error.code), ""
    except PhysHandiError as error:
        return str(error), type(error).__name__
    return _explain(0), ""


def _explain(code: int) -> str:
    if code == -signal.SIGKILL:
        return (
            "The worker was killed (signal 9), most likely because memory ran out. "
            "Use a profile with fewer nodes, or resume."
        )
    if code < 0:
        return f"The worker died of {signal.Signals(-code).name}. Its log may tell why."
    return f"The worker ended with code {code} before it could say why. Its log may tell."


def _work(channel: Channel) -> None:
    run_folder, device, worker = channel.arguments
    supervise(Path(run_folder), device, worker)


if __name__ == "__main__":
    run_child(_work)
