"""The small process that stands between server and worker: `python -m app.jobs.supervise`.

It loads no heavy library, writes the log, notes how the worker ended if the worker could not, and
leaves no process behind.
"""

import argparse
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import BinaryIO

from app.jobs.processes import COOKIE, adopt_orphans, claim_supervision, end_processes
from physhandi.data.files import write_json
from physhandi.data.lease import live_holder, locked
from physhandi.data.run_folder import CANCEL, EXIT, LOG, now

LOG_LIMIT = 50 * 2**20
"""Bytes of log that are kept from the start."""
LOG_TAIL = 2**20
"""Bytes that are kept from the end when the log grew over its limit."""


def supervise(run_folder: Path, device: str, worker: str) -> int:
    """Run the worker of a run until it ends; returns the exit code."""
    claim = claim_supervision(run_folder)
    if claim is None:
        return 3
    adopt_orphans()
    (run_folder / EXIT).unlink(missing_ok=True)
    command = [sys.executable, "-m", worker, "--run-dir", str(run_folder), "--device", device]
    process = subprocess.Popen(
        [*command, "--parent", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    signal.signal(signal.SIGTERM, lambda _number, _frame: process.terminate())
    assert process.stdout is not None  # noqa: S101  # it was asked for
    log = threading.Thread(target=copy_log, args=(process.stdout, run_folder / LOG), daemon=True)
    log.start()
    code = process.wait()
    nonce = os.environ.get(COOKIE, "").rpartition(":")[2]
    end_processes(run_folder, grace_s=0.0, spare=os.getpid(), nonce=nonce)
    log.join(timeout=5)
    if not (run_folder / EXIT).is_file():
        note_end(run_folder, _explain(code))
    return 0 if code == 0 else 1


def note_end(run_folder: Path, error: str) -> None:
    """Write how a run ended for a worker that could not; what it wrote itself stays."""
    is_cancelled = (run_folder / CANCEL).exists()
    with locked(run_folder):
        if (run_folder / EXIT).is_file() or live_holder(run_folder) is not None:
            return
        content = {"state": "cancelled" if is_cancelled else "failed", "time": now()}
        content |= {"error": "Cancelled." if is_cancelled else error, "error_type": ""}
        write_json(run_folder / EXIT, content)


def copy_log(source: BinaryIO, path: Path) -> None:
    """Append what the worker prints to the log; of too much, keep the start and the end."""
    tail = b""
    with path.open("ab") as log:
        room = max(0, LOG_LIMIT - log.tell())
        while chunk := os.read(source.fileno(), 65536):
            if room:
                log.write(chunk[:room])
                log.flush()
            tail = (tail + chunk[room:])[-LOG_TAIL:]
            room = max(0, room - len(chunk))
        if tail:
            log.write(b"\n[the log is too long; this is its end]\n" + tail)


def _explain(code: int) -> str:
    if code == -signal.SIGKILL:
        return (
            "The worker was killed (signal 9), most likely because memory ran out. "
            "Use a profile with fewer nodes, or resume."
        )
    if code < 0:
        return f"The worker died of {signal.Signals(-code).name}. Its log may tell why."
    return f"The worker ended with code {code} before it could say why. Its log may tell."


def main(argv: list[str] | None = None) -> None:
    """Read the arguments, supervise, exit."""
    parser = argparse.ArgumentParser(prog="physhandi-supervise", description=__doc__)
    parser.add_argument("--run-dir", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worker", required=True)
    options = parser.parse_args(argv)
    sys.exit(supervise(options.run_dir, options.device, options.worker))


if __name__ == "__main__":
    main()
