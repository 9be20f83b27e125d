"""Readers of small files, which are damaged by types and structure as fast as they can be read.

The long form shares the time of each reader among all processors; every part of it has a seed of
its own. An answer is judged by checks that have nothing in common with those of the readers.
"""

import json
import math
import multiprocessing
import os
import resource
import shutil
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import yaml
from support.hostile.damaged_files import damage_file

from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.uploads import Uploads
from app.jobs.ticket import QUEUED, Ticket, put_in_line, read_ticket
from app.settings import BUNDLED, ServerSettings
from physhandi.data.run_folder import EVENTS, read_events
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import parse_meta
from physhandi.errors import PhysHandiError
from physhandi.run import Run
from reliability import Case, Counts, Report

_PART_S = 48.0
"""Processor time of one part of the long form [s]."""
_HANGS_S = 10.0
"""A file of a few kilobytes that takes longer is said to hang its reader [s of processor time]."""
_MOST_MB = 256.0
"""Memory that reading any number of such files may take [MB]."""
_NAMES = (
    *("run.yaml", "job.yaml", "sequence.yaml", "progress.json", "events.jsonl"),
    *("queued.json", "upload.json"),
)
"""Files whose readers are tried."""
_COUNTED = ("stage", "message", "seq", "attempt", "time", "iteration", "total", "loss", "eta_s")


class HangError(BaseException):
    """A reader is at work for too long; nobody catches it by mistake."""


def _readers(folder: Path) -> dict[str, tuple[Path, Callable[[], None]]]:
    """Make a folder of each kind; gives for each reader its file, and what reads and judges it."""
    settings = ServerSettings(data_dir=folder)
    run = _copy_small(BUNDLED / "runs" / "towel_fold_quick", settings.run_dir / "run")
    sequence = _copy_small(BUNDLED / "towel_fold", settings.sequence_dir / "towel_fold")
    ticket = Ticket(time=1.5, starts=1, why="It was lost.", device="cpu", who="somebody")
    put_in_line(run, ticket)
    sent = Uploads(settings, BackgroundTasks()).begin("take", [("a/0.png", 3), ("b.csv", 7)])
    about = next((folder / "incoming").rglob("upload.json"))
    return {
        "run.yaml": (run / "run.yaml", lambda: _judge_name(Run.open(run))),
        "job.yaml": (run / "job.yaml", lambda: _judge_job(Run.open(run))),
        "sequence.yaml": (sequence / "sequence.yaml", lambda: _judge_meta(Sequence.load(sequence))),
        "progress.json": (run / "progress.json", lambda: _judge_report(Run.open(run).progress)),
        "events.jsonl": (run / EVENTS, lambda: _judge_events(*read_events(run), run / EVENTS)),
        "queued.json": (run / QUEUED, lambda: _judge_ticket(read_ticket(run / QUEUED), folder)),
        "upload.json": (
            about,
            lambda: _judge_upload(Uploads(settings, BackgroundTasks()).describe(sent["id"])),
        ),
    }


def _copy_small(source: Path, target: Path) -> Path:
    """Copy a folder with its arrays, but without images and without a run's results."""
    left_out = shutil.ignore_patterns("*.png", "*.mp4", "attempts", "depth", "mask")
    return shutil.copytree(source, target, ignore=left_out)


def _judge_name(run: Run) -> None:
    for text in (run.name, run.label, run.note, run.created):
        _require_text(text)


def _judge_job(run: Run) -> None:
    assert run.kind in {"reconstruction", "simulation"}
    assert len(run.sequences) == len(run.sequence_names) > 0
    for text in (*run.sequences, *run.sequence_names):
        _require_text(text)
        assert text
    assert isinstance(run.config, Mapping)
    _require_sendable(dict(run.config))


def _judge_meta(sequence: Sequence) -> None:
    """What a sequence says of itself has to be a sequence.yaml that says the same."""
    meta = sequence.meta
    told = meta.to_dict()
    assert parse_meta(json.loads(json.dumps(told)), "again").to_dict() == told
    assert type(meta.frame_count) is int
    assert 1 <= meta.reconstruction_count <= meta.frame_count
    for view in meta.views:
        assert view.camera.K.shape == (3, 3)
        assert np.isfinite(view.camera.K).all()
    _require_sendable(told)


def _judge_report(told: Mapping[str, Any]) -> None:
    for name in _COUNTED:
        value = told.get(name)
        if name in {"stage", "message"}:
            _require_text(told.get(name, ""))
        elif name in {"seq", "attempt"}:
            assert name not in told or type(value) is int, f"{name}: {value!r}"
        elif value is not None:
            assert type(value) in {int, float}, f"{name}: {value!r}"
            assert math.isfinite(value), f"{name}: {value!r}"
    _require_sendable(dict(told))


def _judge_events(events: list[dict[str, Any]], offset: int, path: Path) -> None:
    """Each event is that of a line; where one cannot be read, all others still are."""
    content = path.read_bytes()
    assert offset == content.rfind(b"\n") + 1
    assert len(events) <= content.count(b"\n")
    for event in events:
        _judge_report(event)


def _judge_ticket(ticket: Ticket | None, folder: Path) -> None:
    """A ticket that is kept again is the same one."""
    assert ticket is not None
    for text in (ticket.why, ticket.device, ticket.engine, ticket.who, ticket.remark):
        _require_text(text)
    assert ticket.priority in {"low", "normal", "high"}
    assert type(ticket.starts) is int
    assert 0 <= ticket.starts < 2**63
    assert type(ticket.time) is float
    assert math.isfinite(ticket.turn)
    put_in_line(folder, ticket)
    assert read_ticket(folder / QUEUED) == ticket
    _require_sendable(asdict(ticket))


def _judge_upload(told: Mapping[str, Any]) -> None:
    assert told["state"] == "receiving"
    _require_text(told["name"])
    for file in told["files"]:
        _require_text(file["path"])
        assert not {"", "..", "."} & {*file["path"].split("/")}, file
        assert type(file["size"]) is int, file
        assert file["size"] >= 0, file
        assert file["received"] == 0  # Nothing was sent, and nothing else is looked at.
    assert told["total"] == sum(file["size"] for file in told["files"])
    _require_sendable(dict(told))


def _require_text(value: object) -> None:
    assert isinstance(value, str), f"no text: {value!r}"
    assert "\0" not in value, f"no text: {value!r}"


def _require_sendable(told: Any) -> None:
    """Pages and the API send it: plain data, finite numbers, text that has bytes."""
    json.dumps(told, allow_nan=False, ensure_ascii=False).encode()


def _damage(path: Path, chance: np.random.Generator) -> None:
    """Damage a file in a place, or in two if it can be taken apart after the first."""
    for place in range(int(chance.integers(1, 3))):
        try:
            damage_file(path, lambda options: options[int(chance.integers(len(options)))])
        except (yaml.YAMLError, ValueError, TypeError, RecursionError):
            assert place  # The whole file can be taken apart.


@contextmanager
def _no_hang() -> Iterator[None]:
    """Break off what is inside after some processor time."""

    def break_off(number: int, frame: FrameType | None) -> None:
        raise HangError

    before = signal.signal(signal.SIGPROF, break_off)
    signal.setitimer(signal.ITIMER_PROF, _HANGS_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _fuzz(name: str, folder: Path, seed: int, is_enough: Callable[[int, float], bool]) -> Counts:
    """Damage the file of one reader until it is enough, of so many times and processor time [s]."""
    folder.mkdir(parents=True)
    readers = _readers(folder)
    assert tuple(readers) == _NAMES
    path, read = readers[name]
    chance = np.random.default_rng([_NAMES.index(name), seed])
    original = path.read_bytes()
    counts = Counts("wrong", "hung", "leaked")
    begin, times, peak = time.process_time(), 0, _peak_mb()
    while not is_enough(times, time.process_time() - begin):
        _damage(path, chance)
        damaged = path.read_bytes()
        since = time.process_time()
        try:
            with _no_hang(), warnings.catch_warnings():
                warnings.simplefilter("error")
                read()
        except PhysHandiError:
            counts["refused"] += 1
        except HangError:
            counts.find("hung", f"{name} hangs its reader: {damaged[:2000]!r}")
        except Exception:  # noqa: BLE001 - whatever it is, nobody foresaw it
            told = traceback.format_exc(limit=-3)
            counts.find("wrong", f"{name} is read wrongly: {damaged[:2000]!r}: {told}")
        taken = time.process_time() - since
        counts["longest [ms]"] = max(counts["longest [ms]"], round(1e3 * taken))
        path.write_bytes(original)
        times += 1
    grown = _peak_mb() - peak
    if grown > _MOST_MB:
        counts.find("leaked", f"{name}, seed {seed}: memory grew by {grown:.0f} MB")
    counts["memory at most [MB]"] = round(_peak_mb())
    counts["done"] = counts[name] = times
    return counts


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _together(all_counts: Iterator[Counts]) -> Counts:
    total = Counts("wrong", "hung", "leaked")
    for counts in all_counts:
        for key, value in counts.items():
            is_peak = key.endswith("]")
            total[key] = max(total[key], value) if is_peak else total[key] + value
        total.findings += counts.findings
    return total


def _fuzz_for(name: str, folder: Path, seed: int, seconds: float) -> Counts:
    return _fuzz(name, folder, seed, lambda _times, taken: taken >= seconds)


def damage_for(seconds: float, folder: Path) -> Report:
    """Damage the file of each reader for some processor time [s], beside each other."""
    parts = max(1, round(seconds / _PART_S))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        # A part of each reader, then another one: whoever is stopped early has had some of all.
        tasks = [
            pool.submit(_fuzz_for, name, folder / f"{name}.{part}", part, seconds / parts)
            for part in range(parts)
            for name in _NAMES
        ]
        total = _together(task.result() for task in tasks)
    total["processor time of each [s]"] = round(seconds)
    return total


def damage_files(count: int, folder: Path) -> Report:
    """Damage the files of all readers so many times."""
    each, more = divmod(count, len(_NAMES))
    shares = [each + (number < more) for number in range(len(_NAMES))]
    return _together(
        _fuzz(name, folder / name, 0, lambda times, _taken, share=share: times >= share)
        for name, share in zip(_NAMES, shares, strict=True)
    )


CASES = {
    "R10b": Case(
        "Readers are given files that are damaged by types and structure",
        *(6000, 60, damage_files),
        last=damage_for,
        minutes=20.0,
    )
}
