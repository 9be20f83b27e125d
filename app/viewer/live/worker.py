"""The live simulation process: simulates what the sliders of all sessions ask for.

Started as ``python -m app.viewer.live.worker FD`` with one end of a socket pair. One thread
reads requests into one mailbox per session, where a newer request replaces an older one; the
main thread simulates one frame of each active session in turn. The process ends when its parent
does.
"""

import logging
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import warp as wp

from app.child import die_with_parent
from app.viewer.live.wire import CONTROLS, Holds, Message, receive, send
from physhandi.errors import PhysHandiError, SimulationDivergedError
from physhandi.fitted_object import FittedObject
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps, with_stable_substeps
from physhandi.simulation.topology import build_model

_PARAMETERS = SimulationParameters(
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
        model = build_model(node, control[0], _PARAMETERS)
        Simulator(model, _PARAMETERS, device).rollout(control)
        stable_substeps(model, _PARAMETERS, control[0])
    except (PhysHandiError, ValueError, OSError, RuntimeError):
        logger.exception("the live simulation could not be prepared")


logger = logging.getLogger(__name__)


class Mailboxes:
    """The latest request of each session; older ones are forgotten."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._latest: dict[str, Message] = {}
        self._controls: list[Message] = []
        self._newest: dict[str, int] = {}
        self._is_closed = False

    def put(self, message: Message) -> None:
        """Replace the request of the message's session; what changes its pace is kept beside it.

        What was overtaken on its way by a newer request of the session is ignored.
        """
        session = message["session"]
        with self._condition:
            if message.kind in CONTROLS:
                self._controls.append(message)
            elif not self._is_overtaken(message):
                if message.kind == "simulate":
                    self._newest[session] = message["request"]
                elif message.kind == "close":
                    self._newest.pop(session, None)
                self._latest[session] = message
            self._condition.notify()

    def _is_overtaken(self, message: Message) -> bool:
        # Several threads of the server send, one of them what it noted before a crash or a start.
        newest = self._newest.get(message["session"], 0)
        if message.kind == "simulate":
            return message["request"] < newest
        return message.kind == "prepare" and newest > 0

    def take(self, *, wait: bool) -> list[Message] | None:
        """Empty all mailboxes.

        Args:
            wait: Whether to wait for a request if there is none.

        Returns:
            Requests of different sessions, then what changes their pace, or None after `close`.
        """
        with self._condition:
            while wait and not (self._latest or self._controls or self._is_closed):
                self._condition.wait()
            if self._is_closed:
                return None
            taken = [*self._latest.values(), *self._controls]
            self._latest, self._controls = {}, []
            return taken

    def close(self) -> None:
        """Let `take` return None from now on."""
        with self._condition:
            self._is_closed = True
            self._condition.notify()


class SimulationWorker:
    """Answers requests, one frame of each session in turn."""

    def __init__(self, connection: socket.socket, device: str) -> None:
        self._connection = connection
        self._device = device
        self._mailboxes = Mailboxes()
        self._objects: dict[str, tuple[tuple[str, str], FittedObject]] = {}
        self._active: dict[str, Iterator[int]] = {}
        self._holds = Holds()
        self._newest: dict[str, int] = {}

    def run(self) -> None:
        """Work until the parent closes the connection."""
        threading.Thread(target=self._read, name="live-requests", daemon=True).start()
        warm_up(self._device)
        send(self._connection, Message("ready", {"session": "", "request": 0}))
        while True:
            is_idle = not any(self._holds.may_go_on(session) for session in self._active)
            requests = self._mailboxes.take(wait=is_idle)
            if requests is None:
                return
            for request in requests:
                self._start(request)
            for session, frames in list(self._active.items()):
                if not self._holds.may_go_on(session):
                    continue
                try:
                    self._holds.count(session, next(frames))
                except StopIteration:
                    del self._active[session]

    def _read(self) -> None:
        try:
            while (message := receive(self._connection)) is not None:
                arrived = {**message.fields, "arrived": time.perf_counter()}
                self._mailboxes.put(Message(message.kind, arrived))
        finally:
            self._mailboxes.close()

    def _start(self, request: Message) -> None:
        session = request["session"]
        if request.kind in CONTROLS:
            self._holds.hear(request)
            return
        if request.kind == "simulate":
            if request["request"] <= self._newest.get(session, 0):
                return  # The server repeats a request if it is not sure that it arrived.
            self._newest[session] = request["request"]
        self._active.pop(session, None)
        if request.kind == "simulate":
            self._active[session] = self._answer(request)
            self._holds.start(session, is_held=bool(request["is_held"]))
        elif request.kind == "prepare":
            self._active[session] = self._prepare(request)
        elif request.kind == "close":
            self._objects.pop(session, None)
            self._newest.pop(session, None)
            self._holds.forget(session)

    def _answer(self, request: Message) -> Iterator[int]:
        """Simulate one request; pauses after each frame and gives the number of frames."""
        about = {"session": request["session"], "request": request["request"]}
        try:
            yield from self._simulate(request, about)
        except SimulationDivergedError as error:
            send(
                self._connection,
                Message("diverged", {**about, "error": str(error), "frame": error.frame}),
            )
        except PhysHandiError as error:
            send(self._connection, Message("failed", {**about, "error": str(error)}))
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            logger.exception("request %s failed", about)
            send(self._connection, Message("failed", {**about, "error": str(error)}))

    def _prepare(self, request: Message) -> Iterator[int]:
        """Load what a session's first request will need, and simulate one frame of it."""
        try:
            fitted = self._object(request)
            parameters = SimulationParameters.from_dict(request["parameters"])
            model, control = fitted.model(parameters), fitted.choose_controls(None)
            yield 0
            for frame, _, _ in fitted.simulator(model, parameters, self._device).frames(control):
                yield int(frame) + 1
                if frame > 0:
                    return
        except (PhysHandiError, ValueError, OSError, RuntimeError, MemoryError):
            logger.exception("%s could not be prepared", request["session"])

    def _simulate(self, request: Message, about: dict[str, object]) -> Iterator[int]:
        fitted = self._object(request)
        parameters = SimulationParameters.from_dict(request["parameters"])
        control = fitted.choose_controls(request["controls"])
        model = fitted.model(parameters)
        if request["automatic_substeps"]:
            parameters = with_stable_substeps(parameters, model, control[0])
        send(
            self._connection,
            Message(
                "started",
                {**about, "substeps_per_frame": parameters.substeps_per_frame},
                model.to_tensors(),
            ),
        )
        yield 0
        simulator = fitted.simulator(model, parameters, self._device)
        clock, frame = time.perf_counter(), 0
        try:
            for frame, position, velocity in simulator.frames(control):
                now = time.perf_counter()
                send(
                    self._connection,
                    Message(
                        "frame",
                        {
                            **about,
                            "frame": int(frame),
                            "duration": now - clock,
                            "elapsed": now - request["arrived"],
                        },
                        {
                            "position": np.asarray(position, dtype=np.float32),
                            "velocity": np.asarray(velocity, dtype=np.float32),
                        },
                    ),
                )
                if frame == 1:  # Not before the user sees the first frame that moves.
                    self._tell_needed(about, fitted.needed_substeps(model, parameters))
                yield int(frame) + 1
                clock = time.perf_counter()
        except SimulationDivergedError:
            if frame == 0:
                self._tell_needed(about, fitted.needed_substeps(model, parameters))
            raise
        send(self._connection, Message("finished", about))

    def _tell_needed(self, about: dict[str, object], substeps: int) -> None:
        send(self._connection, Message("stability", {**about, "needed": substeps}))

    def _object(self, request: Message) -> FittedObject:
        key = (str(request["run"]), str(request["sequence"]))
        known = self._objects.get(request["session"])
        if known is None or known[0] != key:
            known = (key, FittedObject(*key))
            self._objects[request["session"]] = known
        return known[1]


def main(arguments: list[str]) -> None:
    """Serve requests from the socket whose descriptor is the first argument."""
    descriptor, parent, device = int(arguments[0]), int(arguments[1]), arguments[2]
    die_with_parent(parent)
    if device == "auto":
        device = "cuda:0" if wp.get_cuda_device_count() > 0 else "cpu"
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # The server is told too, and closes the socket.
    logging.basicConfig(level=logging.INFO, format="live simulation: %(levelname)s %(message)s")
    with socket.socket(fileno=descriptor) as connection:
        SimulationWorker(connection, device).run()


if __name__ == "__main__":
    main(sys.argv[1:])
