"""Audit log: a line of JSON for each request that is to change something."""

import hashlib
import json
import logging
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.security import Visitor, only_looks

logger = logging.getLogger(__name__)

MOST_AUDIT_BYTES = 4 * 2**20
"""Size of a file at which the next one is begun."""
KEPT = 4
"""Older files that are kept."""
MOST_REFUSED = 60
"""Refused requests that are written in a minute; else whoever may only look could fill the log."""
_MINUTE = 60.0
_ID = re.compile("[A-Za-z0-9_-]{1,64}")
_SECRET = {"share_id", "session_id"}
"""Parts of addresses that open something to who knows them."""


class AuditLog:
    """Lines in ``audit.jsonl`` of a folder; older ones in ``audit.1.jsonl`` and so on."""

    def __init__(
        self,
        folder: Path,
        *,
        most_bytes: int = MOST_AUDIT_BYTES,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Prepare; nothing is made before the first line.

        Args:
            folder: Where the files are; its owner alone may read what is made there.
            most_bytes: Size of a file at which the next one is begun.
            clock: Tells the time [s since 1970].
        """
        self._folder = folder
        self._most_bytes = most_bytes
        self._clock = clock
        self._lock = threading.Lock()
        self._refused: deque[float] = deque(maxlen=MOST_REFUSED)
        self._left_out = 0

    def write(self, entry: Mapping[str, Any], *, is_refused: bool = False) -> None:
        """Add a line; what cannot be written is told in the program's log, and goes on.

        Args:
            entry: What happened, as plain values; the time is put before it.
            is_refused: Whether nothing came of it; of these only so many are written.
        """
        with self._lock:
            now = self._clock()
            if is_refused and not self._may_write_refused(now):
                return
            at = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds")
            fields = {"time": at, **entry}
            if self._left_out:
                fields["left_out_before"] = self._left_out
            line = json.dumps(fields, ensure_ascii=True).encode() + b"\n"
            try:
                self._append(line)
            except OSError as error:
                logger.warning("a line of the audit log was lost: %s", error)
            else:
                self._left_out = 0

    def note_scene(self, who: str, what: str, run_id: str | None) -> None:
        """Note what was kept or deleted from within a live scene, which is no request of its own.

        Args:
            who: Whose scene it is.
            what: What was done.
            run_id: Id of the run that it became; None for none.
        """
        made = {} if run_id is None else {"run_id": run_id}
        self.write({"who": who, "may_change": True, "what": what, **made, "status": 200})

    def note_removed(self, removed: Mapping[str, Any]) -> None:
        """Note what the server has removed by its rules.

        Args:
            removed: What it was, as plain values.
        """
        self.write({"who": "server", "may_change": True, **removed, "status": 200})

    def _may_write_refused(self, now: float) -> bool:
        times = self._refused
        if len(times) == MOST_REFUSED and 0.0 <= now - times[0] < _MINUTE:
            self._left_out += 1
            return False
        times.append(now)
        return True

    def _append(self, line: bytes) -> None:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = self._place(0)
        if path.exists() and path.stat().st_size + len(line) > self._most_bytes:
            for number in range(KEPT, 0, -1):
                younger = self._place(number - 1)
                if younger.exists():
                    younger.replace(self._place(number))
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(descriptor, line)
        finally:
            os.close(descriptor)

    def _place(self, number: int) -> Path:
        return self._folder / (f"audit.{number}.jsonl" if number else "audit.jsonl")


class Audited:
    """ASGI middleware around the gatekeeper: notes who signs in, and requests to change something.

    Whoever is not known is not noted, since nothing can come of it, and anybody could fill the log.
    """

    def __init__(self, app: ASGIApp, log: AuditLog) -> None:
        self._app = app
        self._log = log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and note what came of it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500

        async def send_noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, send_noted)
        finally:
            self._note(scope, status)

    def _note(self, scope: Scope, status: int) -> None:
        state: Mapping[str, Any] = scope.get("state", {})
        visitor = cast("Visitor | None", state.get("visitor"))
        if visitor is None:
            return
        is_new = state.get("signs_in") is True
        # What is begun and ended by requests that are noted is not noted piece by piece.
        if not is_new and (only_looks(scope) or state.get("is_part") is True):
            return
        # Empty where there is none, or where the gatekeeper refused before any was looked for.
        path = getattr(scope.get("route"), "path", "")
        ids = {**scope.get("path_params", {}), **state.get("made", {})}
        entry = {
            "who": visitor.name,
            "may_change": visitor.may_change,
            "client": (scope.get("client") or ("unknown", 0))[0],
            "what": "sign in" if is_new else f"{scope['method']} {path}".rstrip(),
            **{name: _shown(name, value) for name, value in ids.items() if not is_new},
            "status": status,
        }
        self._log.write(entry, is_refused=status >= 400)


def _shown(name: str, value: object) -> str:
    """Show an id; one that is secret is shown by its hash, what is none not at all."""
    if not isinstance(value, str) or not _ID.fullmatch(value):
        return ""
    return hashlib.sha256(value.encode()).hexdigest()[:12] if name in _SECRET else value
