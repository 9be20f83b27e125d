"""The live simulation process: simulates what the sliders of all sessions ask for.

Started as ``python -m app.viewer.live FD DEVICE`` with one end of a socket pair. One thread
reads requests into a mailbox, where a session's newer request replaces its older one; the main
thread simulates one frame of each active session in turn. The process ends when its parent does.
"""

import logging
import math
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
import warp as wp

from app.viewer.live.drive import Drives, HandLimits
from app.viewer.live.wire import DRIVE, PAUSE, RESUME, STEER, STEP, Message, receive, send
from physhandi.child import Channel
from physhandi.errors import PhysHandiError, SimulationDivergedError
from physhandi.fitted_object import FittedObject
from physhandi.simulation.edits import Edits, decode_edits
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.steering import SteeredMotion, SteeredSimulation
from physhandi.simulation.topology import build_model

logger = logging.getLogger(__name__)


class Mailbox:
    """Pending work of each session: its newest request, then changes of its pace.

    Of what steers a session's hands only the newest is kept, however often that is told.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._messages: dict[str, list[Message]] = {}
        self._is_closed = False

    def put(self, message: Message) -> None:
        """Add a message; a request replaces everything that the session has asked for before."""
        with self._condition:
            if message.kind in {PAUSE, RESUME, STEP, DRIVE}:
                waiting = self._messages.setdefault(message["session"], [])
                if message.kind == DRIVE:
                    waiting[:] = [other for other in waiting if other.kind != DRIVE]
                waiting.append(message)
            else:
                self._messages[message["session"]] = [message]
            self._condition.notify()

    def take(self, *, wait: bool, until: float = math.inf) -> list[Message] | None:
        """Empty the mailbox.

        Args:
            wait: Whether to wait for a message if there is none.
            until: When to stop waiting [s, clock of `time.monotonic`].

        Returns:
            The messages, those of one session in their order, or None after `close`.
        """
        with self._condition:
            while wait and not (self._messages or self._is_closed):
                left = until - time.monotonic()
                if left <= 0.0:
                    break
                self._condition.wait(None if math.isinf(left) else left)
            if self._is_closed:
                return None
            messages = [message for of_session in self._messages.values() for message in of_session]
            self._messages = {}
            return messages

    def close(self) -> None:
        """Let `take` return None from now on."""
        with self._condition:
            self._is_closed = True
            self._condition.notify()


class PacedFrames:
    """The simulation of one session, frame by frame, and whether the next one may be computed.

    A held one computes its first frame, the state it starts from, and then one frame a step. One
    that is watched while somebody steers it computes its frames when they are due.
    """

    def __init__(
        self, counts: Iterator[int], *, is_held: bool = False, period: float = 0.0
    ) -> None:
        """Prepare.

        Args:
            counts: Computes a frame at a time and gives the number of frames computed so far.
            is_held: Whether to wait for steps.
            period: Time from one frame to the next [s]; 0 for as fast as possible.
        """
        self._counts = counts
        self._computed = 0
        self._steps: int | None = 0 if is_held else None
        self._period = period
        self._due = -math.inf

    @property
    def may_advance(self) -> bool:
        """Whether the next frame may be computed."""
        return self._steps is None or self._steps > 0 or self._computed == 0

    @property
    def due(self) -> float:
        """Time from which the next frame may be computed [s, clock of `time.monotonic`]."""
        return self._due if self.may_advance else math.inf

    def set_pace(self, kind: str) -> None:
        """Wait (`PAUSE`), run (`RESUME`) or compute one more frame (`STEP`)."""
        if kind == RESUME:
            self._steps = None
        else:
            self._steps = (self._steps or 0) + 1 if kind == STEP else 0

    def advance(self) -> bool:
        """Compute the next frame; returns whether there was one."""
        if self._period > 0.0:
            # One that is late by more than a frame has lost its turn: nothing is made up for.
            self._due = max(self._due, time.monotonic() - self._period) + self._period
        count = next(self._counts, None)
        if count is None:
            return False
        if self._steps is not None and self._computed > 0:
            self._steps = max(self._steps - (count - self._computed), 0)
        self._computed = count
        return True


class SimulationWorker:
    """Answers requests, one frame of each session in turn."""

    def __init__(self, connection: socket.socket, device: str) -> None:
        self._connection = connection
        self._device = device
        self._mailbox = Mailbox()
        self._objects: dict[str, tuple[tuple[str, str], FittedObject]] = {}
        self._active: dict[str, PacedFrames] = {}
        self._orders: dict[str, Message] = {}

    def run(self) -> None:
        """Work until the parent closes the connection; nobody reads it afterwards."""
        reader = threading.Thread(target=self._read, name="live-requests", daemon=True)
        reader.start()
        try:
            with suppress(ConnectionError):  # It may do so while it is being written to.
                self._serve()
        finally:
            with suppress(OSError):  # Closed by the other side already.
                self._connection.shutdown(socket.SHUT_RDWR)
            reader.join()

    def _serve(self) -> None:
        warm_up(self._device)
        send(self._connection, Message("ready", {"session": "", "request": 0}))
        while True:
            due = min((frames.due for frames in self._active.values()), default=math.inf)
            messages = self._mailbox.take(wait=due > time.monotonic(), until=due)
            if messages is None:
                return
            for message in messages:
                self._handle(message)
            for session, frames in list(self._active.items()):
                if frames.due <= time.monotonic() and not frames.advance():
                    del self._active[session]

    def _read(self) -> None:
        try:
            while (message := receive(self._connection)) is not None:
                arrived = {**message.fields, "arrived": time.perf_counter()}
                self._mailbox.put(Message(message.kind, arrived, message.arrays))
        finally:
            self._mailbox.close()

    def _handle(self, message: Message) -> None:
        session = message["session"]
        if message.kind in {PAUSE, RESUME, STEP}:
            if session in self._active:
                self._active[session].set_pace(message.kind)
            return
        if message.kind == DRIVE:
            if session in self._active:
                self._orders[session] = message
            return
        self._active.pop(session, None)
        self._orders.pop(session, None)
        if message.kind == "simulate":
            is_held = bool(message["is_held"])
            frames = self._answer(message, self._simulate)
            self._active[session] = PacedFrames(frames, is_held=is_held)
        elif message.kind == STEER:
            period = float(message["period"])
            frames = self._answer(message, self._steer)
            self._active[session] = PacedFrames(frames, period=period)
        elif message.kind == "prepare":
            self._active[session] = PacedFrames(self._prepare(message))
        elif message.kind == "close":
            self._objects.pop(session, None)

    def _answer(
        self, request: Message, simulate: Callable[[Message, dict[str, object]], Iterator[int]]
    ) -> Iterator[int]:
        """Simulate one request; pauses after each frame and gives the number of frames."""
        about = {"session": request["session"], "request": request["request"]}
        try:
            yield from simulate(request, about)
        except SimulationDivergedError as error:
            send(
                self._connection,
                Message("diverged", {**about, "error": str(error), "frame": error.frame}),
            )
        except PhysHandiError as error:
            send(self._connection, Message("failed", {**about, "error": str(error)}))
        except ConnectionError:  # Nobody is left to be told.
            raise
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            logger.exception("request %s failed", about)
            send(self._connection, Message("failed", {**about, "error": str(error)}))

    def _prepare(self, request: Message) -> Iterator[int]:
        """Load what a session's first request will need, and simulate one frame of it."""
        try:
            fitted = self._object(request)
            parameters = SimulationParameters.from_dict(request["parameters"])
            rollout = fitted.begin(parameters, edits=_edits_of(request))
            yield 0
            for frame, _, _ in fitted.fill(rollout, self._device):
                yield frame + 1
                if frame > 0:
                    return
        except (PhysHandiError, ValueError, OSError, RuntimeError, MemoryError):
            logger.exception("%s could not be prepared", request["session"])

    def _simulate(self, request: Message, about: dict[str, object]) -> Iterator[int]:
        fitted = self._object(request)
        parameters = SimulationParameters.from_dict(request["parameters"])
        rollout = fitted.begin(
            parameters,
            controls=request["controls"],
            automatic_substeps=bool(request["automatic_substeps"]),
            edits=_edits_of(request),
        )
        send(
            self._connection,
            Message(
                "started",
                {**about, "substeps_per_frame": rollout.parameters.substeps_per_frame},
                rollout.model.to_tensors(),
            ),
        )
        yield 0
        frames = fitted.fill(rollout, self._device)
        clock, frame = time.perf_counter(), 0
        try:
            for frame, position, velocity in frames:
                now = time.perf_counter()
                send(
                    self._connection,
                    Message(
                        "frame",
                        {
                            **about,
                            "frame": frame,
                            "duration": now - clock,
                            "elapsed": now - request["arrived"],
                        },
                        {
                            "position": position,
                            "velocity": velocity,
                        },
                    ),
                )
                if frame == 1:  # Not before the user sees the first frame that moves.
                    self._send_stability(about, fitted.needed_substeps(rollout))
                yield frame + 1
                clock = time.perf_counter()
        except SimulationDivergedError:
            if frame == 0:
                self._send_stability(about, fitted.needed_substeps(rollout))
            raise
        send(self._connection, Message("finished", about))

    def _steer(self, request: Message, about: dict[str, object]) -> Iterator[int]:
        """Simulate the frames of a motion, or without end what is steered from its start on."""
        motion = SteeredMotion.from_tensors(
            request.arrays, SimulationParameters.from_dict(request["parameters"])
        )
        drives = Drives(motion, HandLimits(**request["limits"]))
        steered = SteeredSimulation(motion, self._device)
        state, pose, duration = steered.state, motion.pose[0], 0.0
        pull = steered.pulls(state)
        while True:
            frame = steered.frame
            fields = {**about, "frame": frame, "duration": duration}
            arrays = {"position": state[0], "velocity": state[1], "pose": pose, "pull": pull}
            send(self._connection, Message("frame", fields, arrays))
            yield frame + 1
            if not request["replays"]:
                newest = self._orders.pop(request["session"], None)
                if newest is not None:
                    drives.obey(newest["orders"], newest["most_force"])
                pose = drives.next(pull)
            elif frame + 1 < motion.frame_count:
                pose = motion.pose[frame + 1]
            else:
                break
            clock = time.perf_counter()
            state = steered.step(pose)
            pull = steered.pulls(state)
            duration = time.perf_counter() - clock
        send(self._connection, Message("finished", about))

    def _send_stability(self, about: dict[str, object], substeps: int) -> None:
        send(self._connection, Message("stability", {**about, "needed": substeps}))

    def _object(self, request: Message) -> FittedObject:
        key = (str(request["run"]), str(request["sequence"]))
        loaded = self._objects.get(request["session"])
        if loaded is None or loaded[0] != key:
            loaded = (key, FittedObject.of(*key))
            self._objects[request["session"]] = loaded
        return loaded[1]


def _edits_of(request: Message) -> Edits:
    """Read what a request does to single springs and nodes."""
    content = request.arrays.get("edits")
    return () if content is None else decode_edits(content.tobytes(), "the request")


_CUBE = SimulationParameters(
    connection_radius=0.015,
    virtual_connection_radius=0.015,
    stiffness=10.0,
    virtual_stiffness=10.0,
    damping=0.1,
    substeps_per_frame=100,
)


def warm_up(device: str) -> None:
    """Simulate a small cube for a frame, which loads the kernels or compiles them.

    What fails here fails again when somebody asks for a rollout, who is then told.

    Args:
        device: Warp device.
    """
    node = 0.01 * np.stack(np.meshgrid(*3 * [np.arange(3.0)]), axis=-1).reshape(-1, 3)
    node = node.astype(np.float32)
    control = np.repeat(node[None, :4], 2, axis=0)
    try:
        model = build_model(node, control[0], _CUBE)
        Simulator(model, _CUBE, device).rollout(control)
        stable_substeps(model, _CUBE, control[0])
    except (PhysHandiError, ValueError, OSError, RuntimeError):
        logger.exception("the live simulation could not be prepared")


def serve_simulations(channel: Channel) -> None:
    """Serve requests from the socket whose descriptor is the first argument."""
    descriptor, device = channel.arguments
    if device == "auto":
        device = "cuda:0" if wp.get_cuda_device_count() > 0 else "cpu"
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # The server is told too, and closes the socket.
    logging.basicConfig(level=logging.INFO, format="live simulation: %(levelname)s %(message)s")
    with socket.socket(fileno=int(descriptor)) as connection:
        SimulationWorker(connection, device).run()
