"""The live sessions of a server: opening, copying, closing and forgetting them."""

import logging
import secrets
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

from app.settings import ServerSettings
from app.viewer.compare.session import CompareSession
from app.viewer.content.content import ContentSource
from app.viewer.content.session_state import Kind, SessionInfo, SessionState
from app.viewer.live.client import SimulationClient
from app.viewer.physics.keep_panel import UserStorage
from app.viewer.session import Session as Session
from physhandi.errors import PhysHandiError, UsageError

logger = logging.getLogger(__name__)

_REAP_INTERVAL = 20.0
_MAKES_ROOM_AFTER = 30.0
_REMEMBERED = 200


AnySession = Session | CompareSession


class TooManySessionsError(PhysHandiError):
    """No further live session can be opened now."""


@dataclass(frozen=True, kw_only=True)
class ClosedSession:
    """Record of a session that was closed."""

    kind: Kind
    """Whether it showed a run, a sequence or two runs together."""
    target: str
    """Id of the run or the sequence; of a comparison the query after ``/compare?``."""
    title: str
    """Name of what it showed."""
    owner: str
    """Whose session it was."""
    reason: str
    """Why it was closed, as a sentence."""


class Sessions:
    """All live sessions of the server and the process that simulates for them.

    A session belongs to the browser that opened it; nobody else finds it.
    """

    def __init__(
        self,
        settings: ServerSettings,
        catalog: ContentSource,
        storage: UserStorage | None = None,
    ) -> None:
        """Prepare; nothing is started before the first session.

        Args:
            settings: Limits and device.
            catalog: Finds runs and sequences.
            storage: Where users keep presets and runs; None if they cannot.
        """
        self._storage = storage
        self._settings = settings
        self._catalog = catalog
        self._lock = threading.Lock()
        self._sessions: dict[str, AnySession] = {}
        self._closed_sessions: OrderedDict[str, ClosedSession] = OrderedDict()
        self._opening: Counter[str] = Counter()
        self.link_of: Callable[[Session], str] = lambda _: ""
        self.live = SimulationClient(settings.live_device)
        self._closed = threading.Event()
        self._reaper: threading.Thread | None = None

    def open(
        self,
        kind: Kind,
        target: str,
        owner: str,
        *,
        state: SessionState | None = None,
        may_keep: bool = True,
    ) -> str:
        """Open a live session.

        Args:
            kind: What `target` is the id of.
            target: Id of a run or a sequence, or the query of two runs to compare.
            owner: Who asks.
            state: What to begin with; None for what suits the content.
            may_keep: Whether presets and runs may be kept from it.

        Returns:
            The session's id, for ``/viewer/<id>/``.

        Raises:
            TooManySessionsError: If as many sessions as allowed are open, in all or by this owner.
            PhysHandiError: If the run or sequence cannot be shown.
        """
        if kind not in get_args(Kind):
            raise UsageError(f"A session shows a run, a sequence or a comparison, not {kind!r}.")
        self._reserve(owner)
        try:
            session_id = secrets.token_urlsafe(18)
            storage = None
            if may_keep and self._storage is not None:
                storage = replace(self._storage, owner=owner)
            session = self._make(
                session_id, kind, target, owner=owner, state=state, storage=storage
            )
            if isinstance(session, Session):
                session.link_of = self.link_of
            with self._lock:
                self._sessions[session_id] = session
        finally:
            with self._lock:
                self._opening -= Counter([owner])  # Keeps no zeros.
        logger.info("session opened for %s %s by %s", kind, target, owner)
        return session_id

    def copy(self, session: AnySession) -> str:
        """Open another session of the same owner that begins where a session stands.

        Raises:
            TooManySessionsError: If as many sessions as allowed are open.
        """
        may_keep = isinstance(session, Session) and session.can_keep
        return self.open(
            session.kind, session.target, session.owner, state=session.state, may_keep=may_keep
        )

    def get(self, session_id: str) -> AnySession | None:
        """Find a session; None if there is none of that id."""
        with self._lock:
            return self._sessions.get(session_id)

    def find(self, session_id: str, owner: str) -> AnySession | None:
        """Find a session of an owner; None if there is none, or if it is somebody else's."""
        session = self.get(session_id)
        return session if session is not None and session.owner == owner else None

    def closed_session(self, session_id: str, owner: str) -> ClosedSession | None:
        """Remember a session of an owner that was closed; None if there was none."""
        with self._lock:
            closed = self._closed_sessions.get(session_id)
        return closed if closed is not None and closed.owner == owner else None

    def list(self) -> list[SessionInfo]:
        """Describe all sessions, the oldest first."""
        with self._lock:
            sessions = list(self._sessions.values())
        return [session.info for session in sessions]

    def close(self, session_id: str, reason: str = "You closed it.") -> bool:
        """Close a session; returns whether there was one.

        Args:
            session_id: Its id.
            reason: Why, as a sentence for the one who comes back to it.
        """
        with self._lock:
            session = self._sessions.pop(session_id, None)
            if session is not None:
                self._closed_sessions[session_id] = ClosedSession(
                    kind=session.kind,
                    target=session.target,
                    title=session.info.title,
                    owner=session.owner,
                    reason=reason,
                )
                while len(self._closed_sessions) > _REMEMBERED:
                    self._closed_sessions.popitem(last=False)
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
        most = self._settings.live_idle_s
        time = f"{most / 60:.3g} minutes" if most >= 60 else f"{most:.3g} seconds"
        reason = f"Nobody looked at it for {time}."
        idle = [info.id for info in self.list() if info.idle >= most]
        return sum(self.close(session_id, reason) for session_id in idle)

    def _make(
        self,
        session_id: str,
        kind: Kind,
        target: str,
        *,
        owner: str,
        state: SessionState | None,
        storage: UserStorage | None,
    ) -> AnySession:
        if kind == "comparison":
            return CompareSession(
                session_id, target=target, owner=owner, catalog=self._catalog, state=state
            )
        return Session(
            session_id,
            kind=kind,
            target=target,
            owner=owner,
            catalog=self._catalog,
            live=self.live,
            state=state,
            storage=storage,
        )

    def _reserve(self, owner: str) -> None:
        self._make_room(owner)
        with self._lock:
            if self._is_full(owner):
                raise TooManySessionsError(
                    f"You have {self._count(owner)} live sessions, the most that one browser may "
                    "have. Close one of them, or watch the replay, which needs no session."
                )
            if self._is_full():
                raise TooManySessionsError(
                    f"{len(self._sessions)} live sessions are open, the most this server allows. "
                    "Close one of them, or watch the replay, which needs no session."
                )
            self._opening[owner] += 1
            if self._reaper is None:
                self._reaper = threading.Thread(
                    target=self._reap_now_and_then, name="viewer-reaper", daemon=True
                )
                self._reaper.start()

    def _is_full(self, owner: str | None = None) -> bool:
        """Whether all places are taken, or all that an owner may have."""
        if owner is not None:
            return self._count(owner) >= self._settings.live_sessions_each
        return len(self._sessions) + self._opening.total() >= self._settings.live_sessions

    def _count(self, owner: str) -> int:
        own = sum(session.owner == owner for session in self._sessions.values())
        return own + self._opening[owner]

    def _make_room(self, owner: str) -> None:
        """If no place is left for an owner who asks, close a session that this one has left."""
        with self._lock:
            if not (self._is_full() or self._is_full(owner)):
                return
        left = [s for s in self.list() if s.owner == owner and s.idle >= _MAKES_ROOM_AFTER]
        if left:
            oldest = max(left, key=lambda info: info.idle)
            self.close(oldest.id, "It made room for another scene that you opened.")

    def _reap_now_and_then(self) -> None:
        while not self._closed.wait(min(_REAP_INTERVAL, self._settings.live_idle_s)):
            try:
                count = self.reap()
            except Exception:
                logger.exception("closing idle sessions failed")
                continue
            if count:
                logger.info("%d idle sessions closed", count)
