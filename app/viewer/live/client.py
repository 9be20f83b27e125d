"""The server's side of the live simulation process: starts it, feeds it and hears its answers."""

import logging
import os
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from app.child import start_module
from app.viewer.live.wire import PAUSE, RESUME, STEP, Message, WireError, receive, send
from physhandi.simulation.parameters import SimulationParameters

logger = logging.getLogger(__name__)

Listener = Callable[[Message], None]

_MAX_CRASHES = 5
_CRASH_WINDOW = 60.0


@dataclass(frozen=True, kw_only=True)
class LiveRequest:
    """What to simulate."""

    run: Path
    """Run folder."""
    sequence: str
    """One of the run's sequences."""
    parameters: SimulationParameters
    """What to simulate it with."""
    automatic_substeps: bool = False
    """Whether to use as few substeps as are stable, instead of the parameters' number."""
    controls: tuple[int, ...] | None = None
    """Which of the run's control nodes may hold the object; None for all."""


class SimulationClient:
    """Owns the live simulation process; one for all sessions.

    Answers reach a session's listener in the thread of this object: messages ``ready`` when the
    process has warmed up, ``started``, ``frame``, ``stability``, ``finished``, ``diverged``,
    ``failed`` of the process, and ``crashed`` when it is gone. After a crash it is started again,
    and a request that was cut off is sent once more.
    """

    def __init__(self, device: str = "cpu") -> None:
        """Prepare; the process starts with the first listener.

        Args:
            device: Warp device that the process simulates on.
        """
        self._device = device
        self._lock = threading.Lock()
        self._wake = threading.Condition(self._lock)
        self._listeners: dict[str, Listener] = {}
        self._pending: dict[str, tuple[Message, bool]] = {}
        self._early: dict[str, Message] = {}
        self._held: set[str] = set()
        self._numbers = count(1)
        self._connection: socket.socket | None = None
        self._process: subprocess.Popen[str] | None = None
        self._crashes: deque[float] = deque(maxlen=_MAX_CRASHES)
        self._is_closed = False
        self._is_ready = False
        self._thread: threading.Thread | None = None
        self._write_lock = threading.Lock()

    @property
    def process_id(self) -> int | None:
        """Process id of the live simulation process; None if it is not running."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    @property
    def is_ready(self) -> bool:
        """Whether the process has loaded what every simulation needs."""
        return self._is_ready

    def start(self) -> None:
        """Start the process and have it warm up, unless it was started before."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._supervise, name="live-simulation", daemon=True
                )
                self._thread.start()

    def subscribe(self, session: str, listener: Listener) -> None:
        """Name the listener of a session, and have the process warm up."""
        with self._lock:
            self._listeners[session] = listener
        self.start()

    def prepare(self, session: str, request: LiveRequest) -> None:
        """Have loaded what a session's first request will need; a request goes before it."""
        message = Message("prepare", {"session": session, **_described(request)})
        with self._lock:
            is_early = self._connection is None
            if is_early:
                self._early[session] = message
        if not is_early:
            self._send(message)

    def unsubscribe(self, session: str) -> None:
        """Forget a session and stop what is simulated for it."""
        with self._lock:
            self._listeners.pop(session, None)
            self._pending.pop(session, None)
            self._early.pop(session, None)
            self._held.discard(session)
        self._send(Message("close", {"session": session}))

    def request(self, session: str, request: LiveRequest) -> int:
        """Ask for a rollout; an unfinished earlier request of the session is dropped.

        Args:
            session: A session with a listener.
            request: What to simulate.

        Returns:
            Number of the request, which its answers carry.
        """
        number = next(self._numbers)
        message = Message(
            "simulate",
            {
                "session": session,
                "request": number,
                **_described(request),
                "is_held": session in self._held,
            },
        )
        with self._lock:
            self._pending[session] = (message, True)
            if self._connection is None:
                self._crashes.clear()
            self._wake.notify_all()
        self._send(message)
        return number

    def hold(self, session: str, *, on: bool) -> None:
        """Hold the session's simulation, this one and those to come, or let it go on."""
        with self._lock:
            (self._held.add if on else self._held.discard)(session)
            self._hold_pending(session, is_held=on)
        self._send(Message(PAUSE if on else RESUME, {"session": session}))

    def step(self, session: str) -> None:
        """Let a held simulation go on by one frame."""
        self._send(Message(STEP, {"session": session}))

    def cancel(self, session: str) -> None:
        """Stop what is being simulated for a session."""
        with self._lock:
            self._pending.pop(session, None)
        self._send(Message("cancel", {"session": session}))

    def close(self) -> None:
        """End the process."""
        with self._lock:
            self._is_closed = True
            self._wake.notify_all()
            connection, process = self._connection, self._process
        if connection is not None:
            _shut(connection)
        if process is not None:
            try:
                process.wait(timeout=2)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._thread is not None:
            self._thread.join(timeout=5)

    def _hold_pending(self, session: str, *, is_held: bool) -> None:
        """Let an unfinished request, should it be sent again, be held or not as it is now."""
        if session in self._pending:
            message, is_new = self._pending[session]
            message = Message(message.kind, {**message.fields, "is_held": is_held})
            self._pending[session] = (message, is_new)

    def _send(self, message: Message) -> None:
        """Write a message; a broken connection is the supervisor's business."""
        with self._write_lock:
            self._write(message)

    def _write(self, message: Message) -> None:
        connection = self._connection
        if connection is not None:
            try:
                send(connection, message)
            except OSError:
                logger.info("the live simulation process is gone; message not sent")

    def _supervise(self) -> None:
        # The kernel's death signal is tied to the thread that started the process, so the
        # process must be started by a thread that lives as long as the server: this one.
        while not self._is_closed:
            connection = self._spawn()
            self._resend()
            try:
                while (message := receive(connection)) is not None:
                    self._deliver(message)
            except (WireError, OSError) as error:
                logger.warning("the live simulation process broke off: %s", error)
            self._bury(connection)
            self._wait_after_crash()

    def _spawn(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = start_module(
                "app.viewer.live.worker",
                str(theirs.fileno()),
                str(os.getpid()),
                self._device,
                pass_fds=[theirs.fileno()],
            )
        with self._write_lock:
            self._connection = ours
        if self._is_closed:
            _shut(ours)
        return ours

    def _resend(self) -> None:
        # Nobody else writes meanwhile: what is newer, or changes the pace, must come after it.
        with self._write_lock:
            with self._lock:
                early, self._early = self._early, {}
                early |= {session: message for session, (message, _) in self._pending.items()}
            for message in early.values():
                self._write(message)

    def _deliver(self, message: Message) -> None:
        if message.kind == "ready":
            self._is_ready = True
            with self._lock:
                listeners = list(self._listeners.values())
            for listener in listeners:
                self._tell(listener, message)
            return
        session = message["session"]
        with self._lock:
            listener = self._listeners.get(session)
            pending = self._pending.get(session)
            is_current = pending is not None and pending[0]["request"] == message["request"]
            if is_current and message.kind in {"finished", "diverged", "failed"}:
                del self._pending[session]
        if listener is not None:
            self._tell(listener, message)

    def _bury(self, connection: socket.socket) -> None:
        self._is_ready = False
        with self._write_lock:
            self._connection = None
            connection.close()
        process = self._process
        if process is None:
            return
        if process.poll() is None:
            process.kill()
        code = process.wait()
        if self._is_closed:
            return
        logger.error("the live simulation process ended with code %d", code)
        with self._lock:
            self._crashes.append(time.monotonic())
            cut_off = {s: m for s, (m, is_new) in self._pending.items() if is_new}
            self._pending = {s: (m, False) for s, m in cut_off.items()}
            listeners = list(self._listeners.items())
        for session, listener in listeners:
            about = {"session": session, "code": code, "is_retried": session in cut_off}
            self._tell(listener, Message("crashed", about))

    def _wait_after_crash(self) -> None:
        """Do not start the process over and over if it crashes at once; wait for a request."""
        with self._lock:
            while (
                not self._is_closed
                and len(self._crashes) == _MAX_CRASHES
                and time.monotonic() - self._crashes[0] < _CRASH_WINDOW
            ):
                self._wake.wait(timeout=5)

    @staticmethod
    def _tell(listener: Listener, message: Message) -> None:
        try:
            listener(message)
        except Exception:
            logger.exception("a session could not take a %s message", message.kind)


def _described(request: LiveRequest) -> dict[str, Any]:
    """Give a request as plain fields of a message."""
    return {
        "run": str(request.run),
        "sequence": request.sequence,
        "parameters": request.parameters.to_dict(),
        "automatic_substeps": request.automatic_substeps,
        "controls": None if request.controls is None else list(request.controls),
    }


def _shut(connection: socket.socket) -> None:
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        logger.debug("the connection was closed already")
