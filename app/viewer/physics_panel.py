"""The panel that changes the physics: sliders, undo, pace, and what the simulation says."""

import math
import threading
import time
from collections.abc import Callable

import numpy as np
import viser

from app.keys import Action
from app.viewer.contact_knobs import ground_knobs, self_collision_knobs
from app.viewer.content import Content
from app.viewer.followed import FollowedChoice
from app.viewer.guard import Guard
from app.viewer.history import History
from app.viewer.keep_panel import Keeping, KeepPanel, PresetChoice
from app.viewer.keyboard import bind
from app.viewer.parameters import changes_in, knobs
from app.viewer.resimulation import STARTING, Readout
from app.viewer.slider_set import SliderSet
from app.viewer.substeps_choice import SubstepsChoice, warning
from app.viewer.take import Take
from physhandi.simulation.model import SimulationParameters

_FIRST_KNOBS = 5
_REFRESH = 0.2
_UNDO, _REDO, _RESET = "Undo", "Redo", "Reset"
HOLD, STEP, GO = "Hold", "1 frame", "Go"
"""The pace of the simulation: wait, compute one frame, run."""
_PUT_BACK = "choose…"


class PhysicsPanel:
    """Sliders that re-simulate the object, and the readout above them."""

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        fitted: Take,
        guard: Guard,
        simulate: Callable[[SimulationParameters, bool], None],
        *,
        set_pace: Callable[[str], None],
        keeping: Keeping | None = None,
        save: Callable[[str], None] | None = None,
    ) -> None:
        """Add the panel.

        Args:
            server: Where to.
            content: What is shown.
            fitted: The fitted rollout.
            guard: Wraps the callbacks.
            simulate: Simulates parameters, with substeps chosen automatically or not.
            set_pace: Lets the simulation wait, compute one frame or run (`HOLD`, `STEP`, `GO`).
            keeping: Where presets and runs are kept; None where nothing can be kept.
            save: Makes a run of a name out of what is on the screen.
        """
        self.history = History(fitted.parameters)
        self._simulate = simulate
        self._set_pace = set_pace
        self._is_held = False
        self._changed: dict[str, tuple[str, ...]] = {}
        self._is_metric = content.is_metric
        self._unit = "mm" if content.is_metric else content.length_unit
        self._refreshed = -math.inf
        self._lock = threading.Lock()
        # Each slider is heard in a thread of its own.
        self._turn = threading.Lock()
        self.keep: KeepPanel | None = None
        gui, unit, parameters = server.gui, content.length_unit, fitted.parameters
        height = np.asarray(fitted.position[0])[:, 2]
        low, high = float(height.min()), float(height.max())
        main_knobs = knobs(parameters, length_unit=unit)
        store = None if keeping is None else keeping.presets
        self._folder = gui.add_folder("Physics")
        with self._folder:
            self._status = gui.add_markdown("")
            self._presets = PresetChoice(
                gui, guard, self.history, length_unit=unit, store=store, moved=self._run
            )
            self._sliders = SliderSet(gui, guard, self.history, self._moved)
            self._sliders.add(*main_knobs[:_FIRST_KNOBS])
            buttons = gui.add_button_group(
                "History", (_UNDO, _REDO, _RESET), hint="Ctrl+Z and Ctrl+Shift+Z"
            )
            buttons.on_click(guard(lambda event: self._press(event.target.value)))
            pace = gui.add_button_group(
                "Simulation",
                (HOLD, STEP, GO),
                hint="Hold it, compute one frame (N), or let it go on (H)",
            )
            pace.on_click(guard(lambda event: set_pace(event.target.value)))
            self._changes = gui.add_markdown("")
            self._put_back = FollowedChoice(
                gui.add_dropdown(
                    "Put back",
                    (_PUT_BACK,),
                    visible=False,
                    hint="Give one parameter its fitted value again",
                ),
                guard,
            )
            self._put_back.handle.on_update(guard.by_user(lambda _: self._put_one_back()))
            with gui.add_folder("More physics", expand_by_default=False):
                self._sliders.add(*main_knobs[_FIRST_KNOBS:])
                self._substeps = SubstepsChoice(gui, guard, self.history, self._run)
            with gui.add_folder("Ground", expand_by_default=False):
                self._sliders.add(*ground_knobs(parameters, length_unit=unit, low=low, high=high))
            with gui.add_folder("Self-collision", expand_by_default=False):
                self._sliders.add(*self_collision_knobs(parameters, length_unit=unit))
            if keeping is not None and save is not None:
                self.keep = KeepPanel(
                    gui,
                    guard,
                    self.history,
                    choice=self._presets,
                    length_unit=unit,
                    keeping=keeping,
                    save=save,
                )
        self._commands = self._add_keys(server, guard)

    @property
    def is_automatic(self) -> bool:
        """Whether the number of substeps is chosen automatically."""
        return self.history.is_automatic

    def restore(self, parameters: SimulationParameters, *, is_automatic: bool) -> None:
        """Simulate what another session of the same object simulates."""
        self.history.replace(parameters, is_automatic=is_automatic)
        if self.history.is_changed:
            self._run()

    def remove(self) -> None:
        """Take the panel away."""
        self.close()
        for command in self._commands:
            command.remove()
        self._folder.remove()

    def close(self) -> None:
        """Stop listening to what others keep."""
        if self.keep is not None:
            self.keep.close()

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
        self._is_held = readout.is_held
        self._substeps.hear(readout)
        text = self._text(readout)
        if self._status.content != text:
            self._status.content = text

    def _text(self, readout: Readout) -> str:
        pace = ""
        if math.isfinite(readout.frame_duration):
            rate = 1.0 / max(readout.frame_duration, 1e-6)
            pace = f" · {readout.frame_duration * 1e3:.3g} ms a frame · {rate:.0f} frames/s"
        lines = [
            f"object springs {readout.object_spring_count} · "
            f"virtual springs {readout.virtual_spring_count}",
            f"nodes {readout.node_count} · substeps {readout.substeps_per_frame}",
            f"simulated {readout.simulated_count}/{readout.frame_count} frames{pace}",
        ]
        if readout.is_starting:
            lines.insert(0, STARTING)
        if math.isfinite(readout.difference):
            value = readout.difference * (1e3 if self._is_metric else 1.0)
            lines.append(f"{value:.3g} {self._unit} from the fitted rollout (mean)")
        if readout.virtual_spring_count == 0:
            lines.append("**⚠ No virtual spring: nothing holds the object.** Raise δ virtual.")
        if unstable := warning(readout):
            lines.append(unstable)
        if readout.error is not None:
            lines.append(f"**Stopped at frame {readout.simulated_count}; last good state shown**")
        elif readout.is_held and readout.is_busy:
            lines.append(f"**Held at frame {max(readout.simulated_count - 1, 0)}**")
        elif readout.is_held:
            lines.append("**Held: the next simulation waits at frame 0**")
        return "<br/>".join(lines)

    def _add_keys(self, server: viser.ViserServer, guard: Guard) -> list[viser.CommandHandle]:
        actions: dict[Action, Callable[[], None]] = {
            "undo": lambda: self._press(_UNDO),
            "redo": lambda: self._press(_REDO),
            "one_frame": lambda: self._set_pace(STEP),
            "hold": lambda: self._set_pace(GO if self._is_held else HOLD),
        }
        return [
            command
            for action, act in actions.items()
            for command in bind(server, guard, action, lambda _, __, act=act: act())
        ]

    def _press(self, name: str) -> None:
        history = self.history
        before = (history.current, history.is_automatic)
        {_UNDO: history.undo, _REDO: history.redo, _RESET: history.reset}[name]()
        if (history.current, history.is_automatic) != before or name == _RESET:
            self._run()

    def _put_one_back(self) -> None:
        fields = self._changed.get(self._put_back.take())
        if fields:
            self.history.put_back(*fields)
            self._run()

    def _run(self) -> None:
        """Show the parameters in force and simulate them."""
        with self._turn:
            self._sliders.show()
            self._substeps.show()
        self._moved()

    def _moved(self) -> None:
        """Simulate what is in force, leaving the sliders to the user who moves them."""
        history = self.history
        with self._turn:  # What is asked for last must be what was read last.
            self._sliders.mark()
            self._presets.show()
            if self.keep is not None:
                self.keep.show()
            self._show_changes()
            self._simulate(history.current, history.is_automatic)

    def _show_changes(self) -> None:
        history = self.history
        changes = changes_in(
            self._sliders.knobs, history.start, history.current, is_automatic=history.is_automatic
        )
        self._changed = {change.name: change.fields for change in changes}
        text = ", ".join(change.text for change in changes)
        self._put_back.offer((_PUT_BACK, *self._changed))
        self._put_back.show(_PUT_BACK)
        self._put_back.handle.visible = bool(changes)
        self._changes.content = f"Changed: {text or 'nothing: parameters as fitted'}"
