"""One try at filling a run: its files, finished stages and publication."""

import errno
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from safetensors.numpy import save

from physhandi.data.arrays import write_array
from physhandi.data.checkpoint import FileCheckpointer, packed
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.files import (
    json_line,
    sweep_temporary,
    temporary_name,
    write_atomically,
    write_bytes,
    write_json,
    write_yaml,
)
from physhandi.data.layout import LOSSES_FILE
from physhandi.data.lease import Lease, locked
from physhandi.data.run_folder import (
    ATTEMPTS,
    CANCEL,
    CHECKPOINTS,
    CURRENT,
    EVENTS,
    EXIT,
    MANIFEST,
    OUT,
    PROGRESS,
    RESERVE,
    RUN_FORMAT,
    STAGES_FILE,
    StageEntry,
    artefacts,
    attempt_numbers,
    file_record,
    find_damage,
    inside,
    is_filled,
    now,
    read_events,
    read_mapping,
    read_number,
    read_record,
)
from physhandi.errors import CancelledError, RunError, describe
from physhandi.progress import Preview, Progress

logger = logging.getLogger(__name__)


def take_over(previous: Path, folder: Path) -> list[dict[str, Any]]:
    """Link the files of finished stages and the checkpoints of the attempt before.

    Args:
        previous: Folder of the attempt before.
        folder: Folder of the new attempt.

    Returns:
        The leading finished stages whose files are all still what they were.
    """
    stages = _whole_stages(previous) if (previous / STAGES_FILE).is_file() else []
    for stage in stages:
        for rel in stage["files"]:
            _link(inside(previous / OUT, rel), inside(folder / OUT, rel))
    for rel, path in artefacts(previous / CHECKPOINTS):
        _link(path, inside(folder / CHECKPOINTS, rel))
    if stages:
        write_json(folder / STAGES_FILE, stages)
    return stages


def prune(run_folder: Path, keep: set[int]) -> None:
    """Remove attempts that are neither to be kept nor published."""
    published = read_number(run_folder / CURRENT)
    for number in set(attempt_numbers(run_folder)) - keep - {published}:
        shutil.rmtree(run_folder / ATTEMPTS / str(number), ignore_errors=True)


def _whole_stages(previous: Path) -> list[dict[str, Any]]:
    """Give the leading finished stages whose files are all still what they were."""
    stages = _listed_stages(previous / STAGES_FILE)
    latest: dict[str, Any] = {}
    for stage in stages:
        latest |= stage["files"]
    for count, stage in enumerate(stages):
        files = {rel: latest[rel] for rel in stage["files"]}
        if find_damage(previous / OUT, files) is not None:
            return stages[:count]
    return stages


def _listed_stages(path: Path) -> list[dict[str, Any]]:
    """Read the list of finished stages; a damaged one proves nothing, so none is finished."""
    try:
        stages = read_record(path, list[StageEntry]) or []
        for rel in (rel for stage in stages for rel in stage.get("files", {})):
            inside(path.parent, rel)
    except RunError:
        return []
    is_whole = all({"files", "summary"} <= set(stage) for stage in stages)
    return [dict(stage) for stage in stages] if is_whole else []


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:  # Some file systems have no hard links.
        shutil.copy2(source, target)


PREVIEW = "preview.safetensors"
MOST_FRAMES = 24
"""Frames of a preview; longer motions are shown with fewer frames a second."""
MOST_POINTS = {"object": 400, "control": 120, "seen": 120, "joints": 42}
"""Points of each kind in a frame."""
INTERVAL_S = 1.5
"""Least time between two previews."""
SHARE = 0.008
"""Most of a fit's time that previews may take; what is not used is saved up for dear ones."""
_UNKNOWN = 65535
_STEPS = 65534


class PreviewFile:
    """Writes previews of a run, so seldom that the fit does not feel it."""

    def __init__(self, run_folder: Path) -> None:
        """Prepare; the first preview is due at once, and what an earlier attempt showed goes."""
        self._path = run_folder / PREVIEW
        self._path.unlink(missing_ok=True)
        self._begin = time.monotonic()
        self._due = 0.0
        self._number = 0
        self.spent_s = 0.0
        """Time that all previews took together."""

    def is_due(self) -> bool:
        """Tell whether it is time for another preview."""
        return time.monotonic() >= self._due

    def write(self, make: Callable[[], Preview]) -> None:
        """Replace the file, and put the next one off until all took at most `SHARE` of the time."""
        begin = time.monotonic()
        self._number += 1
        content = encode(make(), self._number)
        write_atomically(self._path, lambda stream: stream.write(content), is_durable=False)
        self.spent_s += time.monotonic() - begin
        self._due = max(begin + INTERVAL_S, self._begin + self.spent_s / SHARE)


def encode(preview: Preview, number: int) -> bytes:
    """Make the content of the file.

    Args:
        preview: What to show.
        number: How many previews of the attempt there were, this one included.
    """
    picked: dict[str, ndarray] = {}
    by_kind: dict[str, ndarray] = dict(preview.points)
    count = len(next(iter(by_kind.values())))
    frames = _spread(count, min(count, MOST_FRAMES))
    for kind, points in by_kind.items():
        most = min(points.shape[1], MOST_POINTS[kind])
        shown = _spread(points.shape[1], most)
        picked[kind] = np.asarray(points[frames][:, shown], np.float32)
    # What runs away must not shrink the rest to a dot: the box is that of the first frame, with
    # room for the motion of hands around it.
    low, side = _box(picked)
    arrays: dict[str, ndarray] = {}
    for kind, points in picked.items():
        unit = (points - low) / side
        is_known = np.isfinite(unit).all(axis=-1, keepdims=True)
        whole = np.round(np.clip(np.nan_to_num(unit), 0.0, 1.0) * _STEPS)
        arrays[kind] = np.where(is_known, whole, _UNKNOWN).astype(np.uint16)
    about = {
        "stage": preview.stage,
        "sequence": preview.sequence,
        "loss": preview.loss if np.isfinite(preview.loss) else None,
        "frame_rate": preview.frame_rate,
        "frames": frames.tolist(),
        "low": low.tolist(),
        "side": side,
        "number": number,
    }
    return save(packed(arrays), metadata={"about": json.dumps(about)})


def _spread(count: int, most: int) -> Int[ndarray, " kept"]:
    """Choose so many of the numbers from 0 to `count` - 1, evenly and with both ends."""
    return np.rint(np.linspace(0, count - 1, most)).astype(np.int64)


def _box(picked: dict[str, Float[ndarray, "frame point 3"]]) -> tuple[ndarray, float]:
    """Find a cube that holds what is shown; of simulated points only those of the first frame.

    Returns:
        Its lower corner and its side [m].
    """
    sure = [
        (points[:1] if kind == "object" else points).reshape(-1, 3)
        for kind, points in picked.items()
    ]
    everything = np.concatenate(sure)
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        return np.zeros(3), 1.0
    low, high = everything.min(axis=0), everything.max(axis=0)
    side = 1.3 * max(float((high - low).max()), 1e-3)
    return np.asarray((low + high) / 2 - side / 2, float), side


_SNAPSHOT_INTERVAL_S = 0.2
_HEARTBEAT_INTERVAL_S = 5.0
_LINE_LIMIT = 4096
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EIO}
_RESERVED = 16_384
"""Bytes that are kept for the note on the end of an attempt."""


class RunProgress(Progress):
    """Writes each report to ``events.jsonl`` and the latest one to ``progress.json``.

    Reports also renew the lease, so that a process that was replaced stops at its next report.
    """

    def __init__(self, folder: Path, attempt: int, lease: Lease, also: Progress | None) -> None:
        self._folder = folder
        self._attempt = attempt
        self._lease = lease
        self._also = also
        events, _ = read_events(folder)
        self._seq = max((int(event.get("seq", -1)) for event in events), default=-1)
        self._stage = ""
        self._stage_start = (0.0, 0)
        self._snapshot_time = -_SNAPSHOT_INTERVAL_S
        self._heartbeat_time = time.monotonic()
        self._preview = PreviewFile(folder)
        self._is_torn = self._has_torn_line()
        self._is_mute = False

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
        event: dict[str, object] = {
            "seq": self._seq + 1,
            "time": time.time(),
            "attempt": self._attempt,
            "stage": stage,
            "iteration": iteration,
            "total": total,
            "loss": loss,
            "message": message,
        }
        self._tell(lambda: self._append(event))
        if (
            is_new_stage
            or iteration >= total
            or clock - self._snapshot_time >= _SNAPSHOT_INTERVAL_S
        ):
            self._snapshot_time = clock
            snapshot = event | {"eta_s": self._eta(clock, iteration, total)}
            self._tell(lambda: write_json(self._folder / PROGRESS, snapshot, is_durable=False))
        if clock - self._heartbeat_time >= _HEARTBEAT_INTERVAL_S:
            self._heartbeat_time = clock
            self._tell(self._lease.heartbeat)
        if self._also is not None:
            self._also.report(stage, iteration, total, loss, message)

    def wants_preview(self) -> bool:
        """Tell whether it is time for a preview; see `PreviewFile`."""
        return self._preview.is_due()

    def preview(self, make: Callable[[], Preview]) -> None:
        """Replace the run's preview file."""
        self._tell(lambda: self._preview.write(make))

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
        self._seq += 1

    def _tell(self, write: Callable[[], object]) -> None:
        """Write what only tells of the work; where there is no room, the work goes on without."""
        try:
            write()
        except OSError as error:
            if error.errno not in _NO_ROOM:
                raise
            if not self._is_mute:
                logger.warning("not all of how far this is can be told: %s", describe(error))
            self._is_mute = True

    def _write(self, content: bytes) -> None:
        """Append with a single call, so that lines of two processes never mix."""
        descriptor = os.open(self._folder / EVENTS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            content = b"\n" * self._is_torn + content
            count = os.write(descriptor, content)
            self._is_torn = count != len(content)
            if self._is_torn:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._folder / EVENTS))
        finally:
            os.close(descriptor)

    def _has_torn_line(self) -> bool:
        path = self._folder / EVENTS
        if not path.is_file() or path.stat().st_size == 0:
            return False
        with path.open("rb") as stream:
            stream.seek(-1, os.SEEK_END)
            return stream.read(1) != b"\n"


_ATTEMPT_FILES = {LOSSES_FILE, ENVIRONMENT}
"""Written anew by every attempt, so that no stage can stand for them."""


@runtime_checkable
class ResultStore(Protocol):
    """Keeps published results outside of the run's folder; see `physhandi.run_store`."""

    def put_files(
        self, run_folder: Path, number: int, files: Mapping[str, Any], beat: Callable[[], None]
    ) -> None:
        """Take the results of an attempt."""
        ...

    def publish(self, run_folder: Path, number: int, manifest: Mapping[str, Any]) -> None:
        """Let them be seen."""
        ...


class Attempt:
    """One try at filling a run; only its process may write, and only until it is replaced.

    Use it as a context manager: an exception marks the run as failed or cancelled. Finished stages
    of the attempt before are taken over, and the checkpoints of the one that it was in.
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
        self._checkpointer: FileCheckpointer | None = None
        self._records: dict[str, tuple[tuple[int, int, int], dict[str, Any]]] = {}
        self._stages: list[dict[str, Any]] = []
        self._is_open = True
        self._stage_clock = time.monotonic()
        sweep_temporary(run_folder.rglob(".*.tmp"))
        self._prepare(numbers)
        # File systems that compress must keep room for it, too.
        (run_folder / RESERVE).write_bytes(os.urandom(_RESERVED))
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

    def checkpointer(self, origin: Mapping[str, str]) -> FileCheckpointer:
        """Keep the states of the next stage's loops, and find those of the attempt before.

        Args:
            origin: What the stage depends on, by names; its inputs, which are the files of the
                finished stages, are added.
        """
        files = json_line([[stage["name"], stage["files"]] for stage in self._stages])
        inputs = hashlib.sha256(files.encode()).hexdigest()
        self._checkpointer = FileCheckpointer(self._checkpoints, {**origin, "inputs": inputs})
        return self._checkpointer

    def stage_done(self, name: str) -> bool:
        """Tell whether a stage is finished, here or in the attempt before."""
        return any(stage["name"] == name for stage in self._stages)

    def finish_stage(self, name: str, summary: Mapping[str, Any] | None = None) -> None:
        """Declare a stage finished with all files that were written until now.

        Summaries of all stages are collected in ``losses.json``. A stage's time runs from the end
        of the one before, or from the beginning of the attempt; what an earlier attempt had taken
        up to the checkpoint that it went on from is added. Checkpoints are removed.
        """
        self._lease.check()
        seconds = time.monotonic() - self._stage_clock
        if self._checkpointer is not None:
            seconds += self._checkpointer.earlier_s
            self._checkpointer = None
        earlier: dict[str, Any] = {}
        for stage in self._stages:
            earlier |= stage["files"]
        files = {
            rel: record
            for rel, record in self._hash_outputs().items()
            if earlier.get(rel) != record and rel not in _ATTEMPT_FILES
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
        write_json(self.folder / STAGES_FILE, self._stages)
        # They led to what is finished now; if this process dies here, nothing reads them any more.
        shutil.rmtree(self._checkpoints, ignore_errors=True)
        self._save_losses()

    def heartbeat(self) -> None:
        """Tell that the process is alive; `RunProgress.report` does it too.

        Raises:
            RunError: If another process took the run over.
        """
        self._lease.heartbeat()

    def publish(self, store: ResultStore | None = None) -> None:
        """Make the outputs the run's result.

        Args:
            store: Where they are published, too; before they are here.

        Raises:
            RunError: If another process took the run over, or the store does not take them; nothing
                is published then.
        """
        self._lease.check()
        manifest: dict[str, Any] = {
            "format": RUN_FORMAT,
            "attempt": self.number,
            "time": now(),
            "stages": [stage["name"] for stage in self._stages],
            "files": self._hash_outputs(),
        }
        if store is not None:
            files = manifest["files"]
            store.put_files(self.run_folder, self.number, files, self._lease.heartbeat)
        shutil.rmtree(self._checkpoints, ignore_errors=True)
        with locked(self.run_folder):
            self._lease.check()
            if store is not None:
                store.publish(self.run_folder, self.number, manifest)
            write_json(self.folder / MANIFEST, manifest)
            try:
                write_bytes(self.run_folder / CURRENT, f"{self.number}\n".encode())
            except OSError as error:
                if not is_filled(self.run_folder):
                    raise
                # It is in place, though perhaps not after a power failure.
                logger.warning("the disk does not confirm the results: %s", describe(error))
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
        previous = self.folder.with_name(str(numbers[-1])) if numbers else None
        if previous is not None:
            self._stages = take_over(previous, temporary)
        temporary.replace(self.folder)
        if previous is not None:  # Later attempts go on from this one.
            shutil.rmtree(previous / CHECKPOINTS, ignore_errors=True)
        if self._stages:
            self._save_losses()

    def _end(self, state: str, error: BaseException | str | None) -> None:
        self._lease.check()
        content: dict[str, Any] = {"state": state, "attempt": self.number, "time": now()}
        if error is not None:
            kind = type(error).__name__ if isinstance(error, BaseException) else ""
            message = describe(error) if isinstance(error, BaseException) else error
            content |= {"error": message, "error_type": kind}
        (self.run_folder / RESERVE).unlink(missing_ok=True)
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
            earlier = self._records.get(rel)
            is_same = earlier is not None and earlier[0] == key
            records[rel] = earlier if earlier is not None and is_same else (key, file_record(path))
        self._records = records
        return {rel: record for rel, (_, record) in records.items()}

    def _save_losses(self) -> None:
        write_json(
            self._path(LOSSES_FILE), {stage["name"]: stage["summary"] for stage in self._stages}
        )
