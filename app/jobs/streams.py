"""Server-sent events: news are asked for at intervals and sent to a browser."""

import asyncio
import json
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable

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
                    # In one piece: each piece that a reader who has gone does not take is a line
                    # of the log.
                    if texts := await asyncio.to_thread(lambda: [_text(one) for one in news()]):
                        quiet = 0.0
                        yield "".join(texts)
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


def _text(news: News) -> str:
    name, event, data = news
    return f"id: {name}\nevent: {event}\ndata: {json.dumps(data, ensure_ascii=False)}\n\n"
