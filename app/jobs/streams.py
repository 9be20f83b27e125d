"""Server-sent events: what is new is asked for at intervals and sent to a browser."""

import asyncio
import json
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import StreamingResponse

STREAMS_PER_OWNER = 12
"""Event streams that one browser may hold; a further one ends the oldest."""
_POLL_S = 0.4
_PING_S = 15.0

News = tuple[str, str, object]
"""Name of an event (to come back with), its kind and its content."""


class Streams:
    """Counts the event streams of each browser and ends the oldest of too many."""

    def __init__(self, limit: int = STREAMS_PER_OWNER) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._open: dict[str, deque[threading.Event]] = {}

    def answer(self, request: Request, news: Callable[[], Iterable[News]]) -> StreamingResponse:
        """Send what is new, and a comment now and then if nothing is.

        Args:
            request: The request of the browser.
            news: Gives what is new since it was asked last.
        """
        owner: str = request.state.owner
        stopping: threading.Event = request.app.state.stopping

        async def events() -> AsyncIterator[str]:
            ended, quiet = self._enter(owner), 0.0
            try:
                yield "retry: 2000\n\n"
                while not (ended.is_set() or stopping.is_set() or await request.is_disconnected()):
                    quiet += _POLL_S
                    for name, event, data in await asyncio.to_thread(lambda: list(news())):
                        quiet = 0.0
                        text = json.dumps(data, ensure_ascii=False)
                        yield f"id: {name}\nevent: {event}\ndata: {text}\n\n"
                    if quiet >= _PING_S:
                        quiet = 0.0
                        yield ": ping\n\n"
                    await asyncio.sleep(_POLL_S)
            finally:
                self._leave(owner, ended)

        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(events(), media_type="text/event-stream", headers=headers)

    def _enter(self, owner: str) -> threading.Event:
        """Register a stream; the returned event is set when it has to end."""
        ended = threading.Event()
        with self._lock:
            streams = self._open.setdefault(owner, deque())
            streams.append(ended)
            if len(streams) > self._limit:
                streams.popleft().set()
        return ended

    def _leave(self, owner: str, ended: threading.Event) -> None:
        """Forget a stream that is over."""
        with self._lock:
            streams = self._open.get(owner, deque())
            if ended in streams:
                streams.remove(ended)
            if not streams:
                self._open.pop(owner, None)


_KEPT = 1000
_INTERVAL_S = 0.3
_SHARE = 0.1


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
        self._changes: deque[tuple[int, str, dict[str, Any]]] = deque(maxlen=_KEPT)
        self._known: dict[str, dict[str, Any]] | None = None
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
            return self._id(self._number), list((self._known or {}).values())

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
        if self._known is not None and started < self._next_look:
            return
        runs = {run["id"]: run for run in self._look()}
        # Of thousands of runs a look takes long; it may not take all of the server's time.
        ended = time.monotonic()
        self._next_look = started + max(_INTERVAL_S, (ended - started) / _SHARE)
        if self._known is not None:
            for run_id, run in runs.items():
                if self._known.get(run_id) != run:
                    self._add("run", run)
            for run_id in self._known.keys() - runs.keys():
                self._add("gone", {"id": run_id})
        self._known = runs

    def _add(self, event: str, data: dict[str, Any]) -> None:
        self._number += 1
        self._changes.append((self._number, event, data))
