"""Latency of the live simulation process from a slider to the first new frame."""

import queue
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from app.viewer.live.client import LiveRequest, SimulationClient
from app.viewer.live.drive import HandLimits, HandOrder
from app.viewer.live.wire import Message
from physhandi.benchmarks.timing import describe_machine
from physhandi.devices import start_warp
from physhandi.errors import MissingInputError, SimulationError
from physhandi.object_rollout import ObjectRollout, load_fitted
from physhandi.run import Run
from physhandi.simulation.steering import SteeredHand, SteeredMotion

_SESSION = "latency"
_PATIENCE = 120.0
_INTERRUPTED_AFTER = 3
_FARTHEST = 0.12
_STEERED, _TURNS_AFTER = 240, 20
"""Frames that are steered, and after how many the hand turns round."""
_LIFT = 0.5
"""Height to which the hand goes up, in extents of what holds the object."""
MOVES = 12
"""Slider positions of each kind that are asked for."""


@dataclass(frozen=True)
class _Answer:
    """Messages of the process after one request, and their times [s after the request]."""

    seconds: list[float]
    messages: list[Message]

    def first(self, kind: str, frame: int = 0) -> float:
        """Tell when a message came."""
        return self.seconds[self._find(kind, frame)]

    def computed(self, frame: int) -> float:
        """Tell when the process had computed a frame [s after the request reached it]."""
        return float(self.messages[self._find("frame", frame)]["elapsed"])

    def _find(self, kind: str, frame: int) -> int:
        for index, message in enumerate(self.messages):
            if message.kind == kind and (kind != "frame" or message["frame"] == frame):
                return index
        raise LookupError(f"no {kind}")


class _Slider:
    """Asks for rollouts as a dragged slider does: each request cuts the one before it off."""

    def __init__(self, live: SimulationClient, run: Run, sequence: str) -> None:
        self._live, self._run, self._sequence = live, run, sequence
        self._inbox: queue.Queue[tuple[float, Message]] = queue.Queue()
        live.subscribe(_SESSION, lambda message: self._inbox.put((time.perf_counter(), message)))

    def ask(
        self, rollout: ObjectRollout, *, automatic: bool, to_the_end: bool, **changes: float
    ) -> _Answer:
        """Ask once and listen.

        Raises:
            SimulationError: If the process cannot simulate it, dies, or says nothing.
        """
        start = time.perf_counter()
        number = self._live.request(
            _SESSION,
            LiveRequest(
                run=self._run.folder,
                sequence=self._sequence,
                parameters=rollout.parameters.replace(**changes),
                automatic_substeps=automatic,
            ),
        )
        answer = _Answer([], [])
        for moment, message in self._answers(number):
            answer.seconds.append(moment - start)
            answer.messages.append(message)
            is_cut = message.kind == "frame" and message["frame"] == _INTERRUPTED_AFTER
            if message.kind == "finished" or (is_cut and not to_the_end):
                break
        return answer

    def steer(self, rollout: ObjectRollout, count: int) -> tuple[list[float], list[float]]:
        """Let the hand go up and down from frame 0 on, as fast as frames can be simulated.

        It is told places, between which it stays however late it hears of the next.

        Args:
            rollout: The object, which all its control nodes move as one body.
            count: Frames that are waited for.

        Returns:
            When each frame was heard of, and how long the process took to simulate it [s].
        """
        control = np.asarray(rollout.held_control(0), np.float32)
        every = np.arange(len(control))
        hand = SteeredHand(name="hand", control=every, wrist=control.mean(axis=0))
        model, start = rollout.going_on(0)
        begun = SteeredMotion(
            model=model,
            start=start,
            parameters=rollout.parameters,
            control=control,
            hands=(hand,),
        )
        lift = _LIFT * float(np.ptp(control, axis=0).max())
        limits = HandLimits(top_speed=lift * rollout.parameters.frame_rate, reach=lift)
        number = self._live.steer(_SESSION, begun, limits, is_paced=False)
        moments: list[float] = []
        durations: list[float] = []
        for moment, message in self._answers(number):
            if message["frame"] % _TURNS_AFTER == 0:
                up = lift if message["frame"] % (2 * _TURNS_AFTER) == 0 else 0.0
                self._live.drive(_SESSION, [HandOrder(goal=(0.0, 0.0, up, 0.0, 0.0, 0.0))])
            moments.append(moment)
            durations.append(float(message["duration"]))
            if len(moments) == count:
                break
        self._live.cancel(_SESSION)
        return moments, durations

    def _answers(self, number: int) -> Iterator[tuple[float, Message]]:
        """Give what is said to one request, and when.

        Raises:
            SimulationError: If the process cannot simulate it, dies, or says nothing.
        """
        for moment, message in self._heard():
            if message.kind in {"crashed", "failed", "diverged"}:
                reason = message.fields.get("error", f"code {message.fields.get('code')}")
                raise SimulationError(f"The live simulation {message.kind}: {reason}")
            if message.kind != "ready" and message["request"] == number:
                yield moment, message

    def _heard(self) -> Iterator[tuple[float, Message]]:
        while True:
            try:
                yield self._inbox.get(timeout=_PATIENCE)
            except queue.Empty:
                raise SimulationError(
                    f"The live simulation process said nothing for {_PATIENCE:g} s."
                ) from None


def measure_latency(
    run: Run, sequence: str, *, device: str = "cpu", moves: int = MOVES
) -> dict[str, Any]:
    """Move the stiffness and the radius slider of a run, substeps as fitted and automatic.

    Frame 0 is the same for every slider, so frame 1 is the first new one. A request cuts the one
    before it off in the middle, as it does while a slider is dragged.

    Args:
        run: A finished run.
        sequence: One of its sequences.
        device: Warp device of the process.
        moves: Slider positions of each kind.

    Returns:
        For all moves and each kind the median and the largest time to the first new frame [ms]:
        ``first_new_frame_ms`` as the server sees it, from its request to the frame's arrival, and
        ``in_process_ms`` inside of the simulation process, from the arrival of the request to the
        frame that is about to be sent. Then median and 95th percentile of the time of a frame in
        an undisturbed rollout (``ms_per_frame``, ``p95_ms_per_frame``) and its ``frames_per_s``,
        beside the sequence's (``sequence_frames_per_s``). ``steered`` has the same of a hand that
        is steered; its ``frames_per_s`` counts all of a frame, until the server has it.

    Raises:
        MissingInputError: If the run has no object in this sequence.
        SimulationError: If the process cannot simulate it, dies, or says nothing.
    """
    start_warp()
    rollout = load_fitted(run, sequence)
    if rollout is None:
        raise MissingInputError(f"Run '{run.name}' has no object in '{sequence}' to simulate.")
    about = describe_machine(device)
    live = SimulationClient(device)
    try:
        slider = _Slider(live, run, sequence)
        started = slider.ask(rollout, automatic=False, to_the_end=True)
        kinds = {
            f"{name}, substeps {'automatic' if automatic else 'as fitted'}": _drag(
                slider, rollout, field, moves, automatic=automatic
            )
            for automatic in (False, True)
            for name, field in (("stiffness", "stiffness_scale"), ("radius", "connection_radius"))
        }
        steered = _steered(*slider.steer(rollout, _STEERED))
    finally:
        live.close()
    heard = [seconds for kind in kinds.values() for seconds in kind.pop("heard")]
    computed = [seconds for kind in kinds.values() for seconds in kind.pop("computed")]
    return {
        "benchmark": "live",
        **about,
        "scene": f"{run.name}: {sequence}",
        "nodes": rollout.model.node_count,
        "springs": len(rollout.model.spring_nodes),
        "frames": rollout.frame_count - 1,
        "sequence_frames_per_s": rollout.parameters.frame_rate,
        "start_ms": 1e3 * started.first("frame", 1),
        **_to_first_frame(heard, computed),
        "kinds": kinds,
        "steered": steered,
    }


def _steered(moments: Sequence[float], durations: Sequence[float]) -> dict[str, float]:
    """Say how fast frames came while hands were steered, the first ones left out."""
    counted = slice(_STEERED // 4, None)
    came, took = moments[counted], durations[counted]
    return {
        "ms_per_frame": 1e3 * median(took),
        "p95_ms_per_frame": 1e3 * float(np.quantile(took, 0.95)),
        "frames_per_s": (len(came) - 1) / (came[-1] - came[0]),
    }


def _drag(
    slider: _Slider, rollout: ObjectRollout, field: str, moves: int, *, automatic: bool
) -> dict[str, Any]:
    """Move one slider several times, then let the last rollout end."""
    fitted = getattr(rollout.parameters, field)
    answers: list[_Answer] = []
    for move in range(moves):
        changes = {field: fitted * (1.0 + _FARTHEST * (move + 1) / moves)}
        is_last = move == moves - 1
        answers.append(slider.ask(rollout, automatic=automatic, to_the_end=is_last, **changes))
    heard = [answer.first("frame", 1) for answer in answers]
    computed = [answer.computed(1) for answer in answers]
    last = answers[-1]
    frames = [float(m["duration"]) for m in last.messages if m.kind == "frame" and m["frame"] > 1]
    return {
        "substeps": int(last.messages[0]["substeps_per_frame"]),
        **_to_first_frame(heard, computed),
        "springs_known_ms": 1e3 * median(answer.first("started") for answer in answers),
        "ms_per_frame": 1e3 * median(frames),
        "p95_ms_per_frame": 1e3 * float(np.quantile(frames, 0.95)),
        "frames_per_s": len(frames) / sum(frames),
        "heard": heard,
        "computed": computed,
    }


def _to_first_frame(heard: Sequence[float], computed: Sequence[float]) -> dict[str, float]:
    """Give times to the first new frame, in the server and in the process [ms]."""
    return {
        "first_new_frame_ms": 1e3 * median(heard),
        "worst_first_new_frame_ms": 1e3 * max(heard),
        "in_process_ms": 1e3 * median(computed),
        "worst_in_process_ms": 1e3 * max(computed),
    }
