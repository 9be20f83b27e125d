"""One try at filling a run: its files, finished stages and publication."""

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from numpy import ndarray
from safetensors.numpy import save

from physhandi.data.atomic import (
    sweep_temporary,
    temporary_name,
    write_array,
    write_bytes,
    write_json,
    write_yaml,
)
from physhandi.data.checkpoint import packed, read_checkpoint, write_checkpoint
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.lease import Lease, locked
from physhandi.data.resume import prune, take_over
from physhandi.data.run_files import (
    ATTEMPTS,
    CANCEL,
    CHECKPOINTS,
    CURRENT,
    EXIT,
    MANIFEST,
    OUT,
    RUN_FORMAT,
    STAGES,
    artefacts,
    attempt_numbers,
    file_record,
    inside,
    now,
    read_mapping,
)
from physhandi.data.run_progress import RunProgress
from physhandi.errors import CancelledError, RunError, describe
from physhandi.progress import Progress

_LOSSES = "losses.json"
_ATTEMPT_FILES = {_LOSSES, ENVIRONMENT}
"""Written anew by every attempt, so that no stage can stand for them."""


class Attempt:
    """One try at filling a run; only its process may write, and only until it is replaced.

    Use it as a context manager: an exception marks the run as failed or cancelled. Finished stages
    of the attempt before are taken over, so that work goes on after the last of them.
    """

    def __init__(self, run_folder: Path, lease: Lease) -> None:
        """Start the next attempt of a run; see `Run.begin_attempt`."""
        self.run_folder = run_folder
        self._lease = lease
        numbers = attempt_numbers(run_folder)
        self.number = max(numbers, default=0) + 1
        self.folder = run_folder / ATTEMPTS / str(self.number)
        self.out = self.folder / OUT
        self._checkpoints = self.folder / CHECKPOINTS
        self._records: dict[str, tuple[tuple[int, int, int], dict[str, Any]]] = {}
        self._stages: list[dict[str, Any]] = []
        self._is_open = True
        self._stage_clock = time.monotonic()
        sweep_temporary(run_folder.rglob(".*.tmp"))
        self._prepare(numbers)
        if read_mapping(run_folder / EXIT).get("state") == "cancelled":
            (run_folder / CANCEL).unlink(missing_ok=True)
        (run_folder / EXIT).unlink(missing_ok=True)
        prune(run_folder, keep={*numbers[-1:], self.number})

    def __enter__(self) -> "Attempt":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self._is_open or not self._lease.is_held():
            return
        if error is None:
            self.fail(RunError("The attempt ended without publishing its results."))
        elif isinstance(error, CancelledError | KeyboardInterrupt):
            self.cancelled()
        else:
            self.fail(error)

    def progress(self, also: Progress | None = None) -> RunProgress:
        """Make the progress that writes the run's event log; `also` is told the same."""
        return RunProgress(self.run_folder, self.number, self._lease, also)

    def save_array(self, rel: str, array: ndarray) -> Path:
        """Store an array as ``.npy``."""
        path = self._path(rel)
        try:
            write_array(path, array)
        except ValueError as error:
            raise RunError(f"{rel} cannot be stored: {error}") from error
        return path

    def save_tensors(self, rel: str, tensors: Mapping[str, ndarray]) -> Path:
        """Store named arrays as ``.safetensors``."""
        path = self._path(rel)
        write_bytes(path, save(packed(tensors)))
        return path

    def save_json(self, rel: str, obj: Any) -> Path:
        """Store plain data as JSON; NaN and infinity become null."""
        path = self._path(rel)
        write_json(path, obj)
        return path

    def save_yaml(self, rel: str, obj: Any) -> Path:
        """Store plain data as YAML."""
        path = self._path(rel)
        write_yaml(path, obj)
        return path

    def checkpoint(self, name: str, tensors: Mapping[str, ndarray]) -> None:
        """Keep the state of an unfinished stage, so that a later attempt can go on with it."""
        inside(self._checkpoints, name)
        write_checkpoint(self._checkpoints, name, tensors)

    def load_checkpoint(self, name: str) -> dict[str, ndarray] | None:
        """Read the newest whole checkpoint of that name, also of the attempt before."""
        inside(self._checkpoints, name)
        return read_checkpoint(self._checkpoints, name)

    def stage_done(self, name: str) -> bool:
        """Tell whether a stage is finished, here or in the attempt before."""
        return any(stage["name"] == name for stage in self._stages)

    def stage_summary(self, name: str) -> dict[str, Any]:
        """Give what `finish_stage` was told about a finished stage.

        Raises:
            KeyError: If the stage is not finished.
        """
        for stage in self._stages:
            if stage["name"] == name:
                return stage["summary"]
        raise KeyError(name)

    def finish_stage(self, name: str, summary: Mapping[str, Any] | None = None) -> None:
        """Declare a stage finished with all files that were written until now.

        Summaries of all stages are collected in ``losses.json``. A stage's time runs from the end
        of the one before, or from the beginning of the attempt.
        """
        self._lease.check()
        seconds = time.monotonic() - self._stage_clock
        known: dict[str, Any] = {}
        for stage in self._stages:
            known |= stage["files"]
        files = {
            rel: record
            for rel, record in self._hash_outputs().items()
            if known.get(rel) != record and rel not in _ATTEMPT_FILES
        }
        self._stages = [stage for stage in self._stages if stage["name"] != name]
        self._stages.append(
            {
                "name": name,
                "time": now(),
                "seconds": round(seconds, 3),
                "summary": dict(summary or {}),
                "files": files,
            }
        )
        self._stage_clock = time.monotonic()
        write_json(self.folder / STAGES, self._stages)
        self._save_losses()

    def heartbeat(self) -> None:
        """Tell that the process is alive; `RunProgress.report` does it too.

        Raises:
            RunError: If another process took the run over.
        """
        self._lease.heartbeat()

    def publish(self) -> None:
        """Make the outputs the run's result.

        Raises:
            RunError: If another process took the run over; nothing is published then.
        """
        self._lease.check()
        manifest = {
            "format": RUN_FORMAT,
            "attempt": self.number,
            "time": now(),
            "stages": [stage["name"] for stage in self._stages],
            "files": self._hash_outputs(),
        }
        with locked(self.run_folder):
            self._lease.check()
            write_json(self.folder / MANIFEST, manifest)
            write_bytes(self.run_folder / CURRENT, f"{self.number}\n".encode())
            self._end("succeeded", None)

    def fail(self, error: BaseException | str) -> None:
        """End the attempt with an error.

        Raises:
            RunError: If another process took the run over.
        """
        with locked(self.run_folder):
            self._end("failed", error)

    def cancelled(self) -> None:
        """End the attempt because the user asked for it; checkpoints stay for a later attempt.

        Raises:
            RunError: If another process took the run over.
        """
        with locked(self.run_folder):
            self._end("cancelled", "Cancelled.")

    def _prepare(self, numbers: list[int]) -> None:
        """Make the attempt's folder in one step, so that a crash here loses no earlier work."""
        temporary = self.folder.with_name(temporary_name(self.folder.name))
        (temporary / OUT).mkdir(parents=True)
        (temporary / CHECKPOINTS).mkdir()
        if numbers:
            self._stages = take_over(self.folder.with_name(str(numbers[-1])), temporary)
        temporary.replace(self.folder)
        if self._stages:
            self._save_losses()

    def _end(self, state: str, error: BaseException | str | None) -> None:
        self._lease.check()
        content: dict[str, Any] = {"state": state, "attempt": self.number, "time": now()}
        if error is not None:
            kind = type(error).__name__ if isinstance(error, BaseException) else ""
            told = describe(error) if isinstance(error, BaseException) else error
            content |= {"error": told, "error_type": kind}
        try:
            write_json(self.run_folder / EXIT, content)
        finally:  # On a full disk the end cannot be noted, but the run must be free again.
            self._is_open = False
            self._lease.release()

    def _path(self, rel: str) -> Path:
        if not self._is_open:
            raise RunError(f"Attempt {self.number} has ended; begin another one to write {rel}.")
        path = inside(self.out, rel)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _hash_outputs(self) -> dict[str, Any]:
        """Hash all outputs; files that have not changed since the last time are not read again."""
        records: dict[str, tuple[tuple[int, int, int], dict[str, Any]]] = {}
        for rel, path in artefacts(self.out):
            status = path.stat()
            key = (status.st_ino, status.st_size, status.st_mtime_ns)
            known = self._records.get(rel)
            is_same = known is not None and known[0] == key
            records[rel] = known if known is not None and is_same else (key, file_record(path))
        self._records = records
        return {rel: record for rel, (_, record) in records.items()}

    def _save_losses(self) -> None:
        write_json(self._path(_LOSSES), {stage["name"]: stage["summary"] for stage in self._stages})
