"""The live sessions of a server: opening, listing, closing and forgetting them."""

import logging
import secrets
import threading
from typing import Protocol

from app.viewer.content import Catalog
from app.viewer.live import LiveSimulation
from app.viewer.session_view import Kind, SessionInfo
from app.viewer.session_view import Session as Session
from physhandi.errors import PhysHandiError, UsageError

logger = logging.getLogger(__name__)

_REAP_INTERVAL = 20.0


class TooManySessionsError(PhysHandiError):
    """No further live session can be opened now."""


class ViewerSettings(Protocol):
    """What the sessions need to know of the server's settings."""

    @property
    def live_sessions(self) -> int:
        """Most live sessions at a time."""
        ...

    @property
    def live_idle_s(self) -> float:
        """Seconds after which a session that nobody looks at is closed."""
        ...

    @property
    def device(self) -> str:
        """Warp device of the live simulation."""
        ...


class Sessions:
    """All live sessions of the server and the process that simulates for them."""

    def __init__(
        self,
        settings: ViewerSettings,
        catalog: Catalog,
    ) -> None:
        """Prepare; nothing is started before the first session.

        Args:
            settings: Limits and device.
            catalog: Finds runs and sequences.
        """
        self._settings = settings
        self._catalog = catalog
        self._lock = threading.Lock()
        self._sessions: dict[str, Session] = {}
        self._opening = 0
        self.live = LiveSimulation(settings.device)
        self._closed = threading.Event()
        self._reaper: threading.Thread | None = None

    def open(self, kind: Kind, target: str, owner: str) -> str:
        """Open a live session.

        Args:
            kind: What `target` is the id of.
            target: Id of a run or a sequence.
            owner: Who asks.

        Returns:
            The session's id, for ``/viewer/<id>/``.

        Raises:
            TooManySessionsError: If as many sessions as allowed are open.
            PhysHandiError: If the run or sequence cannot be shown.
        """
        if kind not in {"run", "sequence"}:
            raise UsageError(f"A session shows a run or a sequence, not {kind!r}.")
        self._reserve()
        try:
            session_id = secrets.token_urlsafe(18)
            session = Session(
                session_id,
                kind=kind,
                target=target,
                owner=owner,
                catalog=self._catalog,
                live=self.live,
            )
            with self._lock:
                self._sessions[session_id] = session
        finally:
            with self._lock:
                self._opening -= 1
        logger.info("session opened for %s %s by %s", kind, target, owner)
        return session_id

    def get(self, session_id: str) -> Session | None:
        """Find a session; None if there is none of that id."""
        with self._lock:
            return self._sessions.get(session_id)

    def list(self) -> list[SessionInfo]:
        """Describe all sessions, the oldest first."""
        with self._lock:
            sessions = list(self._sessions.values())
        return [session.info for session in sessions]

    def close(self, session_id: str) -> bool:
        """Close a session; returns whether there was one."""
        with self._lock:
            session = self._sessions.pop(session_id, None)
        if session is not None:
            session.close()
        return session is not None

    def shutdown(self) -> None:
        """Close all sessions and end the live simulation process."""
        self._closed.set()
        for info in self.list():
            self.close(info.id)
        self.live.close()

    def reap(self) -> int:
        """Close the sessions that nobody has looked at for too long; returns how many."""
        idle = [info.id for info in self.list() if info.idle >= self._settings.live_idle_s]
        return sum(self.close(session_id) for session_id in idle)

    def _reserve(self) -> None:
        with self._lock:
            if len(self._sessions) + self._opening >= self._settings.live_sessions:
                raise TooManySessionsError(
                    f"{len(self._sessions)} live sessions are open, the most this server allows. "
                    "Close one of them, or watch the replay, which needs no session."
                )
            self._opening += 1
            if self._reaper is None:
                self._reaper = threading.Thread(
                    target=self._reap_now_and_then, name="viewer-reaper", daemon=True
                )
                self._reaper.start()

    def _reap_now_and_then(self) -> None:
        while not self._closed.wait(min(_REAP_INTERVAL, self._settings.live_idle_s)):
            try:
                count = self.reap()
            except Exception:
                logger.exception("closing idle sessions failed")
                continue
            if count:
                logger.info("%d idle sessions closed", count)
