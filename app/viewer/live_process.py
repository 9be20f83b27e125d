"""The live simulation process: simulates what the sliders of all sessions ask for.

Started as ``python -m app.viewer.live_process FD`` with one end of a socket pair. One thread
reads requests into one mailbox per session, where a newer request replaces an older one; the
main thread simulates one frame of each active session in turn. The process ends when its parent
does.
"""

import ctypes
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import warp as wp

from app.viewer.fitted_object import FittedObject
from app.viewer.wire import Message, receive, send
from physhandi.errors import PhysHandiError, SimulationDivergedError
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.stability import with_stable_substeps

logger = logging.getLogger(__name__)

_PR_SET_PDEATHSIG = 1


class Mailboxes:
    """The latest request of each session; older ones are forgotten."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._latest: dict[str, Message] = {}
        self._is_closed = False

    def put(self, message: Message) -> None:
        """Replace the request of the message's session."""
        with self._condition:
            self._latest[message["session"]] = message
            self._condition.notify()

    def take(self, *, wait: bool) -> list[Message] | None:
        """Empty all mailboxes.

        Args:
            wait: Whether to wait for a request if there is none.

        Returns:
            Requests of different sessions, or None after `close`.
        """
        with self._condition:
            while wait and not self._latest and not self._is_closed:
                self._condition.wait()
            if self._is_closed:
                return None
            taken, self._latest = list(self._latest.values()), {}
            return taken

    def close(self) -> None:
        """Let `take` return None from now on."""
        with self._condition:
            self._is_closed = True
            self._condition.notify()


class LiveSimulator:
    """Answers requests, one frame of each session in turn."""

    def __init__(self, connection: socket.socket, device: str) -> None:
        self._connection = connection
        self._device = device
        self._mailboxes = Mailboxes()
        self._objects: dict[str, tuple[tuple[str, str], FittedObject]] = {}
        self._active: dict[str, Iterator[None]] = {}
        self._newest: dict[str, int] = {}

    def run(self) -> None:
        """Work until the parent closes the connection."""
        threading.Thread(target=self._read, name="live-requests", daemon=True).start()
        while True:
            requests = self._mailboxes.take(wait=not self._active)
            if requests is None:
                return
            for request in requests:
                self._start(request)
            for session, frames in list(self._active.items()):
                try:
                    next(frames)
                except StopIteration:
                    del self._active[session]

    def _read(self) -> None:
        try:
            while (message := receive(self._connection)) is not None:
                self._mailboxes.put(message)
        finally:
            self._mailboxes.close()

    def _start(self, request: Message) -> None:
        session = request["session"]
        if request.kind == "simulate":
            if self._newest.get(session) == request["request"]:
                return  # The server repeats a request if it is not sure that it arrived.
            self._newest[session] = request["request"]
        self._active.pop(session, None)
        if request.kind == "simulate":
            self._active[session] = self._answer(request)
        elif request.kind == "close":
            self._objects.pop(session, None)
            self._newest.pop(session, None)

    def _answer(self, request: Message) -> Iterator[None]:
        """Simulate one request; pauses after each frame."""
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

    def _simulate(self, request: Message, about: dict[str, object]) -> Iterator[None]:
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
        yield
        simulator = fitted.simulator(model, parameters, self._device)
        clock = time.perf_counter()
        for frame, position, velocity in simulator.frames(control):
            now = time.perf_counter()
            send(
                self._connection,
                Message(
                    "frame",
                    {**about, "frame": int(frame), "duration": now - clock},
                    {
                        "position": np.asarray(position, dtype=np.float32),
                        "velocity": np.asarray(velocity, dtype=np.float32),
                    },
                ),
            )
            yield
            clock = time.perf_counter()
        send(self._connection, Message("finished", about))

    def _object(self, request: Message) -> FittedObject:
        key = (str(request["run"]), str(request["sequence"]))
        known = self._objects.get(request["session"])
        if known is None or known[0] != key:
            known = (key, FittedObject(*key))
            self._objects[request["session"]] = known
        return known[1]


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when its parent dies, on systems that can."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)


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
        LiveSimulator(connection, device).run()


if __name__ == "__main__":
    main(sys.argv[1:])
