"""Progress of a run, told through files that a server can follow."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from physhandi.data.atomic import json_line, write_json
from physhandi.data.lease import Lease
from physhandi.data.preview import PreviewFile
from physhandi.data.run_files import CANCEL, EVENTS, PROGRESS, read_events
from physhandi.errors import CancelledError
from physhandi.progress import Preview, Progress

_SNAPSHOT_INTERVAL_S = 0.2
_HEARTBEAT_INTERVAL_S = 5.0
_LINE_LIMIT = 4096


class RunProgress(Progress):
    """Writes each report to ``events.jsonl`` and the latest one to ``progress.json``.

    Reports also renew the lease, so that a process that was replaced stops at its next report.
    """

    def __init__(self, folder: Path, attempt: int, lease: Lease, also: Progress | None) -> None:
        self._folder = folder
        self._attempt = attempt
        self._lease = lease
        self._also = also
        known, _ = read_events(folder)
        self._seq = max((int(event.get("seq", -1)) for event in known), default=-1)
        self._stage = ""
        self._stage_start = (0.0, 0)
        self._snapshot_time = -_SNAPSHOT_INTERVAL_S
        self._heartbeat_time = time.monotonic()
        self._preview = PreviewFile(folder)
        self._end_torn_line()

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Record that `iteration` of `total` of a stage is finished; see `Progress.report`."""
        clock = time.monotonic()
        is_new_stage = stage != self._stage
        if is_new_stage:
            self._stage, self._stage_start = stage, (clock, iteration)
        self._seq += 1
        event: dict[str, object] = {
            "seq": self._seq,
            "time": time.time(),
            "attempt": self._attempt,
            "stage": stage,
            "iteration": iteration,
            "total": total,
            "loss": loss,
            "message": message,
        }
        self._append(event)
        if (
            is_new_stage
            or iteration >= total
            or clock - self._snapshot_time >= _SNAPSHOT_INTERVAL_S
        ):
            self._snapshot_time = clock
            snapshot = event | {"eta_s": self._eta(clock, iteration, total)}
            write_json(self._folder / PROGRESS, snapshot, is_durable=False)
        if clock - self._heartbeat_time >= _HEARTBEAT_INTERVAL_S:
            self._heartbeat_time = clock
            self._lease.heartbeat()
        if self._also is not None:
            self._also.report(stage, iteration, total, loss, message)

    def wants_preview(self) -> bool:
        """Tell whether it is time for a preview; see `PreviewFile`."""
        return self._preview.is_due()

    def preview(self, make: Callable[[], Preview]) -> None:
        """Replace the run's preview file."""
        self._preview.write(make)

    def check_cancelled(self) -> None:
        """Raise `CancelledError` if the run's ``CANCEL`` file is there."""
        if (self._folder / CANCEL).exists():
            raise CancelledError(f"Run '{self._folder.name}' was cancelled.")
        if self._also is not None:
            self._also.check_cancelled()

    def _eta(self, clock: float, iteration: int, total: int) -> float | None:
        start, first = self._stage_start
        done = iteration - first
        return (clock - start) / done * (total - iteration) if done > 0 else None

    def _append(self, event: dict[str, object]) -> None:
        line = json_line(event)
        if len(line) >= _LINE_LIMIT:
            excess = len(line) - _LINE_LIMIT + 8
            line = json_line(event | {"message": str(event["message"])[: -max(excess, 1)]})
            if len(line) >= _LINE_LIMIT:  # Escaped characters count six times.
                line = json_line(event | {"message": ""})
        self._write(line.encode() + b"\n")

    def _write(self, content: bytes) -> None:
        """Append with a single call, so that lines of two processes never mix."""
        descriptor = os.open(self._folder / EVENTS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(descriptor, content)
        finally:
            os.close(descriptor)

    def _end_torn_line(self) -> None:
        path = self._folder / EVENTS
        if not path.is_file() or path.stat().st_size == 0:
            return
        with path.open("rb") as stream:
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                self._write(b"\n")
