"""Event streams for browsers: changes of the list of runs; progress and log of one run."""

import os
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.jobs.log import read_log
from app.jobs.scheduler import AT_WORK, ENDED
from app.jobs.streams import News
from physhandi.data.attempt import PREVIEW
from physhandi.data.run_folder import read_events
from physhandi.errors import PhysHandiError

_MOST_BYTES = 2**20


def preview_number(run_folder: Path) -> int:
    """Number a run's preview; another one has another number, and 0 is none."""
    try:
        return (run_folder / PREVIEW).stat(follow_symlinks=False).st_mtime_ns // 1000
    except OSError:
        return 0


def preview_bytes(run_folder: Path) -> bytes | None:
    """Read a run's preview; a link that a job might have put there is not followed."""
    try:
        descriptor = os.open(run_folder / PREVIEW, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    with os.fdopen(descriptor, "rb") as stream:
        return stream.read(_MOST_BYTES)


_LOAD_INTERVAL_S = 2.0
_CURSOR = re.compile(r"(-?\d{1,15})(?:-(\d{1,15}))?")


class Watch:
    """Follows a run from where a reader left it.

    Its events are ``run`` (see `follow_run`; first of all, then on every change), ``progress``
    (one report of the worker), ``log`` (``text is_whole``, see `LogPart`) and ``gone``; of a run
    at work also ``preview`` (``number`` of a new one) and now and then ``load``. Each is named
    ``<number of the last report>-<position in the log>``, so that a reader that comes back with
    the last name goes on without gap or repetition.
    """

    def __init__(
        self,
        folder: Path,
        look: Callable[[], dict[str, Any]],
        cursor: str | None,
        load: Callable[[], dict[str, Any]] | None = None,
    ) -> None:
        """Prepare.

        Args:
            folder: Folder of the run.
            look: Describes the run as it is now.
            cursor: Name of the last event that the reader saw. Without one, or with one that is
                none, reports come from the first on, and the log from `TAIL_BYTES` before its end.
            load: Tells what the machine and the run's processes do.
        """
        position = _CURSOR.fullmatch(cursor or "")
        self._folder = folder
        self._look = look
        self._seen = int(position[1]) if position else -1
        self._log = int(position[2]) if position and position[2] else None
        self._offset = 0
        self._sent: dict[str, Any] | None = None
        self._is_gone = False
        self._load = load
        self._load_time = -_LOAD_INTERVAL_S
        self._preview = 0

    def news(self) -> Iterator[News]:
        """Give what is new since the last call."""
        if self._is_gone:
            return
        if not self._folder.is_dir():
            self._is_gone = True
            yield self._name, "gone", {"id": self._folder.name}
            return
        # Looked at first: whatever was written before it ended is then read below.
        run = self._described()
        yield from self._reports()
        yield from self._lines(is_ended=run["state"] in ENDED)
        if run["state"] in AT_WORK:
            yield from self._shown(has_begun=run["state"] != "starting")
        if run != self._sent:
            self._sent = run
            yield self._name, "run", run

    @property
    def _name(self) -> str:
        return f"{self._seen}" if self._log is None else f"{self._seen}-{self._log}"

    def _described(self) -> dict[str, Any]:
        try:
            return self._look()
        except (PhysHandiError, OSError):
            # It is being deleted; the next look finds it gone.
            return self._sent or {"state": ""}

    def _reports(self) -> Iterator[News]:
        events, self._offset = read_events(self._folder, self._offset)
        for event in events:
            number = event.get("seq", -1)
            if number > self._seen:
                self._seen = number
                yield self._name, "progress", event

    def _shown(self, *, has_begun: bool) -> Iterator[News]:
        number = preview_number(self._folder) if has_begun else 0
        if number not in {0, self._preview}:
            self._preview = number
            yield self._name, "preview", {"number": number}
        if self._load is not None and time.monotonic() - self._load_time >= _LOAD_INTERVAL_S:
            self._load_time = time.monotonic()
            yield self._name, "load", self._load()

    def _lines(self, *, is_ended: bool) -> Iterator[News]:
        part = read_log(self._folder, self._log, is_ended=is_ended)
        is_new = part.end != self._log and part.text != ""
        self._log = part.end
        if is_new:
            yield self._name, "log", {"text": part.text, "is_whole": part.is_whole}


_KEPT_EVENTS = 1000
_LOOK_INTERVAL_S = 0.3
_LOOK_SHARE = 0.1


@dataclass(frozen=True)
class RunEvent:
    """One thing that changed."""

    id: str
    """Name of this change; a reader that comes back gives the last one that it saw."""
    event: str
    """``run`` when a run is new or different, ``gone`` when it was removed, ``reset`` to reload."""
    data: Mapping[str, Any]
    """The run's description."""


class Feed:
    """Compares the runs with what they were, however many browsers ask."""

    def __init__(self, look: Callable[[], list[dict[str, Any]]]) -> None:
        """Prepare.

        Args:
            look: Describes all runs as they are now.
        """
        self._look = look
        self._lock = threading.Lock()
        self._epoch = secrets.token_hex(4)
        self._number = 0
        self._changes: deque[tuple[int, str, dict[str, Any]]] = deque(maxlen=_KEPT_EVENTS)
        self._runs: dict[str, dict[str, Any]] | None = None
        self._next_look = 0.0

    def cursor(self) -> str:
        """Name the latest change, so that a page can follow from what it shows."""
        with self._lock:
            self._refresh()
            return self._id(self._number)

    def snapshot(self) -> tuple[str, list[dict[str, Any]]]:
        """Give all runs as they are at this moment, and the name of the latest change to them."""
        with self._lock:
            self._next_look = 0.0
            self._refresh()
            return self._id(self._number), list((self._runs or {}).values())

    def since(self, last: str | None) -> list[RunEvent]:
        """Give all changes after the one named; one ``reset`` if they are not known any more."""
        with self._lock:
            self._refresh()
            number = self._number_of(last)
            if number is None:
                return [RunEvent(self._id(self._number), "reset", {})]
            return [
                RunEvent(self._id(n), event, data) for n, event, data in self._changes if n > number
            ]

    def _id(self, number: int) -> str:
        return f"{self._epoch}-{number}"

    def _number_of(self, last: str | None) -> int | None:
        epoch, _, number = (last or "").partition("-")
        if epoch != self._epoch or not number.isdecimal() or len(number) > 18:
            return None
        oldest = self._changes[0][0] if self._changes else self._number + 1
        return int(number) if oldest - 1 <= int(number) <= self._number else None

    def _refresh(self) -> None:
        started = time.monotonic()
        if self._runs is not None and started < self._next_look:
            return
        runs = {run["id"]: run for run in self._look()}
        # Of thousands of runs a look takes long; it may not take all of the server's time.
        ended = time.monotonic()
        self._next_look = started + max(_LOOK_INTERVAL_S, (ended - started) / _LOOK_SHARE)
        if self._runs is not None:
            for run_id, run in runs.items():
                if self._runs.get(run_id) != run:
                    self._add("run", run)
            for run_id in self._runs.keys() - runs.keys():
                self._add("gone", {"id": run_id})
        self._runs = runs

    def _add(self, event: str, data: dict[str, Any]) -> None:
        self._number += 1
        self._changes.append((self._number, event, data))
