"""The rollouts of one session: the fitted one, the one shown and the one being simulated."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.viewer.live.client import LiveRequest, SimulationClient
from app.viewer.live.wire import Message
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters

STARTING = "**The simulation is starting …** The first time on a machine this takes a while."
"""What a panel says until the live simulation has loaded or compiled what it needs."""


@dataclass(frozen=True, kw_only=True)
class Readout:
    """What the physics panel says about the rollout."""

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
            run=run, sequence=sequence, parameters=fitted.parameters, controls=controls
        )
        self._number = 0
        self._shown = fitted
        self._incoming: ObjectRollout | None = None
        self._durations: list[float] = []
        self._is_busy = False
        self._is_held = False
        self._needed: int | None = None
        live.subscribe(session, self._hear)
        if controls is None:
            live.prepare(session, self._wanted)

    def request(self, parameters: SimulationParameters, *, automatic_substeps: bool) -> None:
        """Ask for the rollout of other parameters; the fitted one is there already."""
        with self._lock:
            self._wanted = replace(
                self._wanted, parameters=parameters, automatic_substeps=automatic_substeps
            )
            is_fitted = (
                parameters == self.fitted.parameters
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
        """What there is to say about the newest rollout."""
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

    def _hear(self, message: Message) -> None:
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
            self._incoming = ObjectRollout.empty(model, parameters, self.fitted.control)
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
