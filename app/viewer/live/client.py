"""The server's side of the live simulation: its one process, and the rollouts of each session."""

import logging
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from app.viewer.live.drive import HandLimits, HandOrder
from app.viewer.live.wire import (
    DRIVE,
    PAUSE,
    RESUME,
    STEER,
    STEP,
    Message,
    WireError,
    receive,
    send,
)
from physhandi.child import start_module
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.edits import Edits, encode_edits, keeps_what_is_joined
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.steering import SteeredMotion

logger = logging.getLogger(__name__)

Listener = Callable[[Message], None]

STARTING = "**The simulation is starting …** The first time on a machine this takes a while."
"""Shown until the process has loaded or compiled what every simulation needs."""

"""As good as no limit of speed, which JSON has no number for [m/s]."""
_MAX_CRASHES = 5
_CRASH_WINDOW = 60.0


@dataclass(frozen=True, kw_only=True)
class LiveRequest:
    """Request for a rollout."""

    run: Path
    """Run folder."""
    sequence: str
    """One of the run's sequences."""
    parameters: SimulationParameters
    """Parameters of the simulation."""
    automatic_substeps: bool = False
    """Whether to use as few substeps as are stable, instead of the parameters' number."""
    controls: tuple[int, ...] | None = None
    """Numbers of the run's control nodes that may hold the object; None for all."""
    edits: Edits = ()
    """Edits of single springs and nodes."""


@dataclass(frozen=True)
class _Unfinished:
    """Request of a session that is not answered yet."""

    message: Message
    has_crashed: bool = False
    """Whether the process ended while it worked on it; the second time it is dropped."""


class SimulationClient:
    """Owns the live simulation process; one for all sessions.

    Answers reach a session's listener in the thread of this object: messages ``ready`` when the
    process has warmed up, ``started``, ``frame``, ``stability``, ``finished``, ``diverged``,
    ``failed`` of the process, and ``crashed`` when it is gone. After a crash it is started again,
    and a request that was cut off is sent once more.

    One lock is held from the number of a request until it is written, so that messages reach the
    process in the order of the calls.
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
        self._unfinished: dict[str, _Unfinished] = {}
        self._held: set[str] = set()
        self._numbers = count(1)
        self._connection: socket.socket | None = None
        self._process: subprocess.Popen[str] | None = None
        self._crashes: deque[float] = deque(maxlen=_MAX_CRASHES)
        self._is_closed = False
        self._is_ready = False
        self._thread: threading.Thread | None = None

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

    def unsubscribe(self, session: str) -> None:
        """Forget a session and stop what is simulated for it."""
        with self._lock:
            self._listeners.pop(session, None)
            self._unfinished.pop(session, None)
            self._held.discard(session)
            self._write(Message("close", {"session": session}))

    def prepare(self, session: str, request: LiveRequest) -> None:
        """Load what a session's first request will need."""
        message = _message("prepare", {"session": session}, request)
        with self._lock:
            if self._connection is None:
                self._unfinished[session] = _Unfinished(message)
            self._write(message)

    def request(self, session: str, request: LiveRequest) -> int:
        """Ask for a rollout; an unfinished earlier request of the session is dropped.

        Args:
            session: A session with a listener.
            request: What to simulate.

        Returns:
            Number of the request, which its answers carry.
        """
        with self._lock:
            number = next(self._numbers)
            about = {"session": session, "request": number, "is_held": session in self._held}
            message = _message("simulate", about, request)
            self._unfinished[session] = _Unfinished(message)
            if self._connection is None:
                self._crashes.clear()
            self._wake.notify_all()
            self._write(message)
        return number

    def steer(
        self,
        session: str,
        motion: SteeredMotion,
        limits: HandLimits,
        *,
        replays: bool = False,
        is_paced: bool = True,
    ) -> int:
        """Simulate what is steered, without end; a crash of the process ends it.

        Frames come as messages ``frame`` with the arrays ``position``, ``velocity``, ``pose`` and
        ``pull``, which is how the object pulls at each hand [N].

        Args:
            session: A session with a listener; what it asked for before is dropped.
            motion: The state to begin in, and the hands; poses after the first are not used.
            limits: What no hand that is steered can do.
            replays: Whether to simulate the poses of the motion instead, and then to end.
            is_paced: Whether to wait until a frame is due, as far as it is not late.

        Returns:
            Number of the request, which its frames carry.
        """
        fields = {
            "session": session,
            "parameters": motion.parameters.to_dict(),
            "replays": replays,
            "period": 1.0 / motion.parameters.frame_rate if is_paced else 0.0,
            "limits": asdict(limits),
        }
        with self._lock:
            number = next(self._numbers)
            message = Message(STEER, fields | {"request": number}, motion.to_tensors())
            self._unfinished.pop(session, None)
            if self._connection is None:
                self._unfinished[session] = _Unfinished(message)
            self._write(message)
        return number

    def drive(
        self, session: str, orders: Sequence[HandOrder], most_force: float | None = None
    ) -> None:
        """Tell where the steered hands of a session shall go from now on.

        Args:
            session: The session.
            orders: One a hand.
            most_force: A hand that the object pulls at harder gives way [N]; None for no limit.
        """
        described = [order.to_dict() for order in orders]
        fields = {"session": session, "orders": described, "most_force": most_force}
        with self._lock:
            self._write(Message(DRIVE, fields))

    def hold(self, session: str, *, on: bool) -> None:
        """Hold the session's simulation, this one and those to come, or let it go on."""
        with self._lock:
            (self._held.add if on else self._held.discard)(session)
            if session in self._unfinished:  # It may be sent again, to another process.
                item = self._unfinished[session]
                fields = {**item.message.fields, "is_held": on}
                message = replace(item.message, fields=fields)
                self._unfinished[session] = replace(item, message=message)
            self._write(Message(PAUSE if on else RESUME, {"session": session}))

    def step(self, session: str) -> None:
        """Let a held simulation go on by one frame."""
        with self._lock:
            self._write(Message(STEP, {"session": session}))

    def cancel(self, session: str) -> None:
        """Stop what is being simulated for a session."""
        with self._lock:
            self._unfinished.pop(session, None)
            self._write(Message("cancel", {"session": session}))

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

    def _write(self, message: Message) -> None:
        """Write a message under the lock; a broken connection is the supervisor's business."""
        if self._connection is not None:
            try:
                send(self._connection, message)
            except OSError:
                logger.info("the live simulation process is gone; message not sent")

    def _supervise(self) -> None:
        # The kernel's death signal is tied to the thread that started the process, so the
        # process must be started by a thread that lives as long as the server: this one.
        while not self._is_closed:
            connection = self._spawn()
            self._connect(connection)
            try:
                while (message := receive(connection)) is not None:
                    self._deliver(message)
            except (WireError, OSError) as error:
                logger.warning("the live simulation process broke off: %s", error)
            self._disconnect()
            self._wait_after_crash()

    def _spawn(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = start_module(
                "app.viewer.live",
                str(theirs.fileno()),
                self._device,
                pass_fds=[theirs.fileno()],
            )
        return ours

    def _connect(self, connection: socket.socket) -> None:
        """Write to a new process from now on, first what was asked for before it was there."""
        with self._lock:
            self._connection = connection
            for session, item in list(self._unfinished.items()):
                self._write(item.message)
                if item.message.kind in {"prepare", STEER}:
                    del self._unfinished[session]
            if self._is_closed:
                _shut(connection)

    def _deliver(self, message: Message) -> None:
        if message.kind == "ready":
            self._is_ready = True
            with self._lock:
                listeners = list(self._listeners.values())
            for listener in listeners:
                _notify(listener, message)
            return
        session = message["session"]
        with self._lock:
            listener = self._listeners.get(session)
            if message.kind in {"finished", "diverged", "failed"}:
                self._forget(session, message["request"])
        if listener is not None:
            _notify(listener, message)

    def _forget(self, session: str, number: int) -> None:
        """Forget a request that was answered, unless a newer one came meanwhile."""
        item = self._unfinished.get(session)
        if item is not None and item.message.fields.get("request") == number:
            del self._unfinished[session]

    def _disconnect(self) -> None:
        """Bury the process, and tell every session if nobody has ended it."""
        with self._lock:
            self._is_ready = False
            connection, self._connection = self._connection, None
            if connection is not None:
                connection.close()
            self._unfinished = {
                session: replace(item, has_crashed=True)
                for session, item in self._unfinished.items()
                if not item.has_crashed
            }
            retried = set(self._unfinished)
            listeners = list(self._listeners.items())
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
        for session, listener in listeners:
            about = {"session": session, "code": code, "is_retried": session in retried}
            _notify(listener, Message("crashed", about))

    def _wait_after_crash(self) -> None:
        """Do not start the process over and over if it crashes at once; wait for a request."""
        with self._lock:
            while (
                not self._is_closed
                and len(self._crashes) == _MAX_CRASHES
                and time.monotonic() - self._crashes[0] < _CRASH_WINDOW
            ):
                self._wake.wait(timeout=5)


@dataclass(frozen=True, kw_only=True)
class Readout:
    """Status of the newest rollout, for the panels."""

    object_spring_count: int
    """Springs between object nodes."""
    virtual_spring_count: int
    """Springs between control nodes and object nodes."""
    node_count: int
    """Object nodes."""
    substeps_per_frame: int
    """Substeps of a frame."""
    simulated_count: int
    """Frames that are ready."""
    frame_count: int
    """Frames that are wanted."""
    frame_duration: float
    """Mean time that one frame took [s]; NaN if none was simulated."""
    difference: float
    """Mean distance from the fitted rollout over the ready frames [m]."""
    is_busy: bool
    """Whether frames are being simulated."""
    is_starting: bool
    """Whether the live simulation process is still loading or compiling what it needs."""
    is_held: bool
    """Whether the simulation goes on only when it is told to."""
    is_fitted: bool
    """Whether nothing but the fitted rollout is shown."""
    needed_substeps: int | None
    """Fewest substeps of a frame that are stable; None while that is not known."""
    error: str | None
    """Why the simulation ended early, if it did."""


class LiveRollouts:
    """Turns parameter changes into rollouts; the latest request wins.

    The worker drops what a newer request of the session replaces, and what it had sent before is
    refused here by the number of its request. The rollout shown before stays on the screen, frame
    by frame, until its frame has been simulated anew. If the object diverges, the last good state
    stays.
    """

    def __init__(
        self,
        session: str,
        live: SimulationClient,
        fitted: ObjectRollout,
        *,
        run: Path,
        sequence: str,
        controls: tuple[int, ...] | None = None,
        on_change: Callable[[str, int], None],
    ) -> None:
        """Listen to the live simulation process.

        Args:
            session: Id of the session.
            live: The process.
            fitted: The fitted rollout.
            run: Run folder.
            sequence: The run's sequence.
            controls: Which of the run's control nodes hold the object; None for all.
            on_change: Called with ``"requested"`` or the kind of a message of the process, and
                the number of ready frames.
        """
        self.fitted = fitted
        self._session = session
        self._live = live
        self._on_change = on_change
        self._lock = threading.Lock()
        self._wanted = LiveRequest(
            run=run,
            sequence=sequence,
            parameters=fitted.parameters,
            controls=controls,
            edits=fitted.edits if controls is None else (),
        )
        self._number = 0
        self._shown = fitted
        self._incoming: ObjectRollout | None = None
        self._durations: list[float] = []
        self._is_busy = False
        self._is_held = False
        self._needed: int | None = None
        live.subscribe(session, self._receive)
        if controls is None:
            live.prepare(session, self._wanted)

    def request(
        self,
        parameters: SimulationParameters,
        *,
        automatic_substeps: bool,
        edits: Edits | None = None,
    ) -> None:
        """Ask for a rollout; the fitted one is there already.

        Args:
            parameters: What to simulate with.
            automatic_substeps: Whether to use as few substeps as are stable.
            edits: What is done to single springs and nodes; None for what was last.
        """
        with self._lock:
            edits = self._wanted.edits if edits is None else edits
            self._wanted = replace(
                self._wanted,
                parameters=parameters,
                automatic_substeps=automatic_substeps,
                edits=edits,
            )
            is_fitted = (
                parameters == self.fitted.parameters
                and edits == self.fitted.edits
                and not automatic_substeps
                and self._wanted.controls is None
            )
            if is_fitted:
                self._live.cancel(self._session)
                self._number, self._is_busy = 0, False
                self._shown, self._incoming = self.fitted, None
                self._durations, self._needed = [], None
            else:
                self._simulate()
        if is_fitted:
            self._on_change("finished", self.fitted.ready)
        else:
            self._on_change("requested", 0)

    def hold(self, *, on: bool) -> None:
        """Hold the simulation, and those asked for from now on, or let it go on."""
        with self._lock:
            self._is_held = on
            self._live.hold(self._session, on=on)
        self._on_change("requested", 0)

    def step(self) -> None:
        """Hold the simulation and compute one frame of it; one that is over begins anew."""
        with self._lock:
            if not self._is_held:
                self._is_held = True
                self._live.hold(self._session, on=True)
            if not self._is_busy:
                self._simulate()
            self._live.step(self._session)
        self._on_change("requested", 0)

    def _simulate(self) -> None:
        """Have what is wanted simulated, even if it is the fitted rollout."""
        self._is_busy = True
        self._incoming = None
        self._durations, self._needed = [], None
        # Answers to earlier requests are refused from here on.
        self._number = self._live.request(self._session, self._wanted)

    def close(self) -> None:
        """Stop listening."""
        self._live.unsubscribe(self._session)

    def at(self, frame: int) -> tuple[ObjectRollout, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        with self._lock:
            incoming = self._incoming
            if incoming is not None and incoming.ready > 0:
                if frame < incoming.ready:
                    return incoming, frame
                if incoming.error is not None:
                    return incoming, incoming.ready - 1
            return self._shown, min(frame, self._shown.ready - 1)

    @property
    def is_busy(self) -> bool:
        """Whether frames are being simulated."""
        with self._lock:
            return self._is_busy

    @property
    def newest(self) -> ObjectRollout:
        """The rollout that was asked for last, as far as it is there."""
        with self._lock:
            return self._incoming or self._shown

    @property
    def readout(self) -> Readout:
        """Status of the newest rollout."""
        with self._lock:
            rollout = self._incoming or self._shown
            durations = self._durations
            is_waiting = self._is_busy and self._incoming is None
            return Readout(
                object_spring_count=rollout.model.object_spring_count,
                virtual_spring_count=rollout.model.virtual_spring_count,
                node_count=rollout.model.node_count,
                substeps_per_frame=rollout.parameters.substeps_per_frame,
                simulated_count=0 if is_waiting else rollout.ready,
                frame_count=rollout.frame_count,
                frame_duration=float(np.mean(durations)) if durations else float("nan"),
                difference=rollout.mean_distance(self.fitted)
                if not self._is_busy
                else float("nan"),
                is_busy=self._is_busy,
                is_starting=not self._live.is_ready,
                is_held=self._is_held,
                is_fitted=rollout is self.fitted and not self._is_busy,
                needed_substeps=self._needed,
                error=rollout.error,
            )

    def _receive(self, message: Message) -> None:
        with self._lock:
            if message.kind not in {"crashed", "ready"} and message["request"] != self._number:
                return
            self._update(message)
            ready = self._incoming.ready if self._incoming is not None else 0
            if message.kind == "finished" and self._incoming is not None:
                self._shown, self._incoming = self._incoming, None
        self._on_change(message.kind, ready)

    def _update(self, message: Message) -> None:
        if message.kind == "started":
            model = SpringMassModel.from_tensors(message.arrays)
            parameters = self._wanted.parameters.replace(
                substeps_per_frame=message["substeps_per_frame"]
            )
            fitted, edits = self.fitted, self._wanted.edits
            control = model.with_pins(fitted.control)
            restart = fitted.restart if keeps_what_is_joined(edits) else None
            self._incoming = ObjectRollout.empty(model, parameters, control, restart)
            self._incoming.edits = edits
            self._durations = []
        elif message.kind == "frame" and self._incoming is not None:
            frame = int(message["frame"])
            self._incoming.position[frame] = message.arrays["position"]
            if self._incoming.velocity is not None:
                self._incoming.velocity[frame] = message.arrays["velocity"]
            self._incoming.ready = frame + 1
            if frame > 0:
                self._durations.append(float(message["duration"]))
        elif message.kind in {"diverged", "failed"}:
            rollout = self._incoming
            if rollout is None:
                rollout = self._incoming = ObjectRollout.empty(
                    self.fitted.model, self._wanted.parameters, self.fitted.control
                )
            rollout.error = str(message["error"])
            self._is_busy = False
        elif message.kind == "stability":
            self._needed = int(message["needed"])
        elif message.kind == "finished":
            self._is_busy = False
        elif message.kind == "crashed":
            self._is_busy = self._is_busy and bool(message["is_retried"])


def _message(kind: str, about: dict[str, Any], request: LiveRequest) -> Message:
    """Write a request as a message; edits, which may name every spring, as bytes beside it."""
    fields = about | {
        "run": str(request.run),
        "sequence": request.sequence,
        "parameters": request.parameters.to_dict(),
        "automatic_substeps": request.automatic_substeps,
        "controls": None if request.controls is None else list(request.controls),
    }
    if not request.edits:
        return Message(kind, fields)
    return Message(kind, fields, {"edits": np.frombuffer(encode_edits(request.edits), np.uint8)})


def _notify(listener: Listener, message: Message) -> None:
    try:
        listener(message)
    except Exception:
        logger.exception("a session could not take a %s message", message.kind)


def _shut(connection: socket.socket) -> None:
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        logger.debug("the connection was closed already")
