"""The panel that changes the physics: sliders, undo, and what the simulation says."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import viser

from app.viewer.content import Content
from app.viewer.guard import Guard
from app.viewer.history import History
from app.viewer.parameters import (
    Knob,
    Switch,
    knobs,
    self_collision_knobs,
    what_changed,
)
from app.viewer.resimulation import Readout
from app.viewer.take import Take
from physhandi.simulation.model import SimulationParameters

_FIRST_KNOBS = 5
_REFRESH = 0.2
_UNDO, _REDO, _RESET = "Undo", "Redo", "Reset"
_CHANGED = "● "
_AS_FITTED, _AUTOMATIC = "as fitted", "automatic"


class PhysicsPanel:
    """Sliders that re-simulate the object, and the readout below them."""

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        fitted: Take,
        guard: Guard,
        simulate: Callable[[SimulationParameters, bool], None],
    ) -> None:
        """Add the panel.

        Args:
            server: Where to.
            content: What is shown.
            fitted: The fitted rollout.
            guard: Wraps the callbacks.
            simulate: Simulates parameters, with substeps chosen automatically or not.
        """
        self.history = History(fitted.parameters)
        self._simulate = simulate
        unit = content.length_unit
        main_knobs = knobs(fitted.parameters, length_unit=unit)
        collision_knobs = self_collision_knobs(fitted.parameters, length_unit=unit)
        self._knobs = (*main_knobs, *collision_knobs)
        self._is_metric = content.is_metric
        self._unit = "mm" if content.is_metric else content.length_unit
        self._sliders: dict[str, Any] = {}
        self._refreshed = -math.inf
        self._lock = threading.Lock()
        gui = server.gui
        self._folder = gui.add_folder("Physics")
        with self._folder:
            self._status = gui.add_markdown("")
            self._progress = gui.add_progress_bar(100.0, color="blue")
            for knob in main_knobs[:_FIRST_KNOBS]:
                self._add_slider(gui, knob, guard)
            buttons = gui.add_button_group("History", (_UNDO, _REDO, _RESET))
            buttons.on_click(guard(self._press))
            self._changes = gui.add_markdown("")
            with gui.add_folder("More physics", expand_by_default=False):
                for knob in main_knobs[_FIRST_KNOBS:]:
                    self._add_slider(gui, knob, guard)
                self._substeps = gui.add_dropdown(
                    "substeps",
                    (_AS_FITTED, _AUTOMATIC),
                    hint="Automatic takes as few substeps as are stable at frame 0",
                )
                self._substeps.on_update(guard.by_user(lambda _: self._run()))
            with gui.add_folder("Self-collision", expand_by_default=False):
                for knob in collision_knobs:
                    self._add_slider(gui, knob, guard)

    @property
    def is_automatic(self) -> bool:
        """Whether the number of substeps is chosen automatically."""
        return self._substeps.value == _AUTOMATIC

    def restore(self, parameters: SimulationParameters, *, is_automatic: bool) -> None:
        """Simulate what another session of the same object simulates."""
        self._substeps.value = _AUTOMATIC if is_automatic else _AS_FITTED
        self.history.replace(parameters)
        self._show_parameters()
        if is_automatic or parameters != self.history.start:
            self._run()

    def remove(self) -> None:
        """Take the panel away."""
        self._folder.remove()

    def show(self, readout: Readout, *, at_once: bool) -> None:
        """Write the readout, not more often than people can read.

        Args:
            readout: What to say.
            at_once: Whether to write it even if the last one is fresh.
        """
        now = time.monotonic()
        with self._lock:
            if not at_once and now - self._refreshed < _REFRESH:
                return
            self._refreshed = now
        self._status.content = self._text(readout)
        self._progress.value = 100.0 * readout.simulated_count / max(readout.frame_count, 1)
        self._progress.animated = readout.is_busy
        self._progress.color = "red" if readout.error else "blue"

    def _text(self, readout: Readout) -> str:
        lines = [
            f"object springs {readout.object_spring_count} · "
            f"virtual springs {readout.virtual_spring_count}",
            f"nodes {readout.node_count} · substeps {readout.substeps_per_frame}"
            + (
                f" · {readout.frame_duration * 1e3:.3g} ms a frame"
                if math.isfinite(readout.frame_duration)
                else ""
            ),
            f"simulated {readout.simulated_count}/{readout.frame_count} frames",
        ]
        if math.isfinite(readout.difference):
            value = readout.difference * (1e3 if self._is_metric else 1.0)
            lines.append(f"{value:.3g} {self._unit} from the fitted rollout (mean)")
        if readout.error is not None:
            lines.append(f"**Stopped at frame {readout.simulated_count}; last good state shown**")
        return "<br/>".join(lines)

    def _add_slider(self, gui: viser.GuiApi, knob: Knob | Switch, guard: Guard) -> None:
        start = knob.to_slider(self.history.start)
        if isinstance(knob, Switch):
            slider = gui.add_checkbox(knob.label, bool(start), hint=knob.hint)
        elif knob.is_integer:
            slider = gui.add_slider(
                knob.label, int(knob.low), int(knob.high), 1, int(start), hint=knob.hint
            )
        else:
            slider = gui.add_slider(
                knob.label, knob.low, knob.high, knob.step, start, hint=knob.hint
            )
            slider.precision = min(slider.precision + 1, 7)  # Typed values may be finer.
        slider.on_update(guard.by_user(lambda _, knob=knob: self._move(knob)))
        self._sliders[knob.field] = slider

    def _move(self, knob: Knob | Switch) -> None:
        value = knob.from_slider(self._sliders[knob.field].value)
        before = self.history.current
        if self.history.set(knob.field, value) != before:
            self._run()

    def _press(self, event: Any) -> None:
        before = self.history.current
        act = {_UNDO: self.history.undo, _REDO: self.history.redo, _RESET: self.history.reset}
        now = act[event.target.value]()
        self._show_parameters()
        if now != before or event.target.value == _RESET:
            self._run()

    def _show_parameters(self) -> None:
        for knob in self._knobs:
            self._sliders[knob.field].value = knob.to_slider(self.history.current)

    def _mark_changed(self) -> None:
        """Put a dot before the name of every slider that is not as fitted."""
        start, now = self.history.start, self.history.current
        for knob in self._knobs:
            is_changed = getattr(start, knob.field) != getattr(now, knob.field)
            label = f"{_CHANGED}{knob.label}" if is_changed else knob.label
            slider = self._sliders[knob.field]
            if slider.label != label:
                slider.label = label

    def _run(self) -> None:
        self._mark_changed()
        changes = what_changed(self._knobs, self.history.start, self.history.current)
        self._changes.content = f"Changed: {changes}"
        self._simulate(self.history.current, self._substeps.value == _AUTOMATIC)
