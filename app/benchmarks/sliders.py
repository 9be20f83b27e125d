"""Latency from a slider of a live scene to the first new frame, without a browser."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.benchmarks.served import Served
from app.benchmarks.streams import Screen, percentiles
from app.viewer.live.client import STARTING
from app.viewer.physics.parameters import Knob, knobs
from physhandi.data.layout import SequenceFiles
from physhandi.errors import UsageError
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import ObjectRollout, load_surface
from physhandi.run import Run

FIELDS = ("stiffness_scale", "connection_radius")
"""Parameters whose sliders are moved."""
TOLERANCE = 1e-7
"""Positions that differ by less are the same [m]."""
_DRAGGED = 3
"""Of so many moves all but the last cut the rollout before them off."""


@dataclass(frozen=True)
class Move:
    """One position of a slider, and what the object does there."""

    value: float
    """Value on the slider."""
    shown: Float[ndarray, "frame vertex 3"]
    """Positions of the object's surface [m], simulated by the benchmark itself."""


class MeasuredSlider:
    """One slider of a run, and rollouts for some of its positions."""

    def __init__(self, run: Run, sequence: str, field: str) -> None:
        """Load the run.

        Args:
            run: A finished run with an object.
            sequence: One of its sequences.
            field: Parameter that the slider moves.

        Raises:
            UsageError: If that is a switch, or the object has no surface.
        """
        self._fitted = FittedObject.of(run, sequence)
        meta = run.yaml(SequenceFiles(sequence).meta)
        unit = "m" if meta.get("metric", True) else str(meta.get("length_unit", "units"))
        start = self._fitted.parameters
        controls = {knob.field: knob for knob in knobs(start, length_unit=unit)}
        knob = controls[field]
        if not isinstance(knob, Knob):
            raise UsageError(f"{field} is a switch, which has no way to be moved along.")
        surface = load_surface(run, self._fitted.fitted, ())
        if surface is None:
            raise UsageError(
                f"The object of '{run.name}' has no surface whose motion could be heard."
            )
        self.knob = knob
        self._start = start
        self._surface = surface

    @property
    def fitted(self) -> Float[ndarray, "frame node 3"]:
        """Positions of the surface in the fitted rollout [m]."""
        return self._shown(self._fitted.fitted.position)

    def moves(self, count: int) -> list[Move]:
        """Choose positions, each further than the one before, and simulate them.

        A step that changes nothing, as when no node is that near, is not among them.

        Args:
            count: How many at most.
        """
        value = self.knob.to_slider(self._start)
        # Softer objects are safe at every number of substeps, and wider radii change the springs.
        step = -self.knob.step if self.knob.is_logarithm else self.knob.step
        chosen: list[Move] = []
        before = self.fitted
        while len(chosen) < count and self.knob.low < value < self.knob.high:
            value = min(max(round(value + step, 6), self.knob.low), self.knob.high)
            parameters = self._start.replace(**{self.knob.field: self.knob.from_slider(value)})
            rollout = self._fitted.begin(parameters)
            # Most steps of a radius reach no further node; the first frame tells that.
            for number, _ in enumerate(self._fitted.fill(rollout)):
                if number == 1 and not self._is_changed(rollout, before):
                    break
            else:
                chosen.append(Move(value, self._shown(rollout.position)))
                before = chosen[-1].shown
        return chosen

    def _is_changed(self, rollout: ObjectRollout, before: Float[ndarray, "frame node 3"]) -> bool:
        """Tell whether the first simulated frame differs from the one before."""
        return float(np.abs(self._surface.place(rollout.position[1]) - before[1]).max()) > TOLERANCE

    def _shown(self, position: Float[ndarray, "frame node 3"]) -> Float[ndarray, "frame vertex 3"]:
        """Find where the surface is while the nodes are there [m]."""
        return np.stack([self._surface.place(frame) for frame in position])


def is_new_frame(
    shown: Float[ndarray, "vertex 3"],
    rollout: Float[ndarray, "frame vertex 3"],
    before: Float[ndarray, "frame vertex 3"],
) -> bool:
    """Tell whether an object stands as in a frame of one rollout and in none of the one before."""

    def is_of(frames: ndarray) -> bool:
        return bool((np.abs(frames - shown).max(axis=(1, 2)) <= TOLERANCE).any())

    return is_of(rollout) and not is_of(before)


def measure_slider(
    served: Served, run_id: str, slider: MeasuredSlider, moves: list[Move], *, is_playing: bool
) -> dict[str, Any]:
    """Move a slider, most times while the rollout before is still being simulated.

    Args:
        served: The server; its live simulation runs on the CPU.
        run_id: The run to show.
        slider: The slider.
        moves: Where to.
        is_playing: Whether the clock runs; else it is paused in the middle, and the first new
            frame is that one.

    Returns:
        Time from the slider's message to that of the first surface that only the new
        rollout has, also one by one (``seconds``).
    """
    session = served.open("run", run_id)
    seconds: list[float] = []
    before = slider.fitted
    with served.watch(session) as client:
        screen = Screen(client)
        if is_playing:
            client.listen(0.5)
        else:
            screen.rest_at(len(before) // 2, before[len(before) // 2])
            client.listen(0.3)
        for number, move in enumerate(moves):
            start = time.perf_counter()
            label = slider.knob.label
            client.set(label, move.value)
            new, old = move.shown, before
            seconds.append(
                screen.seconds_until(lambda p, new=new, old=old: is_new_frame(p, new, old)) - start
            )
            if number % _DRAGGED == _DRAGGED - 1:
                total = f"simulated {len(new)}/{len(new)}"
                client.until(lambda total=total: total in client.texts())
            before = move.shown
    served.shut(session)
    return {"moves": len(moves), **percentiles(seconds), "seconds": seconds}


def measure_first_move(
    served: Served, run_id: str, slider: MeasuredSlider, moves: list[Move]
) -> dict[str, Any]:
    """Move a slider of the first scene of a server as soon as it is there, and then again.

    Args:
        served: The server, just started; its live simulation runs on the CPU.
        run_id: The run to show.
        slider: The slider.
        moves: The first and the second position.

    Returns:
        Times to the first new frame of both moves, whether the panel said meanwhile that the
        simulation was still starting, and how long it took to start the server and to open the
        scene.
    """
    start = time.perf_counter()
    session = served.open("run", run_id)
    opened = time.perf_counter()
    before, seconds = slider.fitted, list[float]()
    is_told = False
    with served.watch(session) as client:
        screen = Screen(client)
        for move in moves:
            new, old = move.shown, before
            begin = time.perf_counter()
            client.set(slider.knob.label, move.value)

            def is_there(shown: ndarray, new: ndarray = new, old: ndarray = old) -> bool:
                nonlocal is_told
                is_told = is_told or STARTING in client.texts()
                return is_new_frame(shown, new, old)

            seconds.append(screen.seconds_until(is_there) - begin)
            before = move.shown
    served.shut(session)
    return {
        "server_start_ms": 1e3 * served.start_seconds,
        "scene_open_ms": 1e3 * (opened - start),
        "first_move_ms": 1e3 * seconds[0],
        "second_move_ms": 1e3 * seconds[1],
        "is_start_shown": is_told,
    }
