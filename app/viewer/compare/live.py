"""Comparing in a live scene: with a kept rollout, with the fit, or with PhysTwin's topology."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import viser

from app.viewer.compare.camera import ComparisonCameras
from app.viewer.compare.curve import Pairing
from app.viewer.compare.drawing import Look
from app.viewer.compare.phystwin_baseline import PhysTwinBaseline
from app.viewer.compare.sides import ComparedRollouts, ComparedSide, Sides, compared_rollouts
from app.viewer.compare.view import CompareView
from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose
from app.viewer.live.client import LiveRollouts, SimulationClient
from app.viewer.physics.parameters import changes_in, edits_text, knobs
from app.viewer.scene.framing import Framing
from app.viewer.ui.guard import Guard, notify
from app.viewer.ui.keyboard import bind
from physhandi.errors import MissingInputError, UsageError
from physhandi.object_rollout import ObjectRollout

_FIGURE_ON, _FIGURE_OFF = "Back to the scene", "Compare with PhysTwin"
_THIS, _FIT = "this rollout", "the fit"
_LONGEST_TEXT = 70

Compared = Literal["kept", "phystwin"]
"""Counterpart of the sliders' rollout: A that was kept, or B held as by PhysTwin."""


class LiveComparison:
    """Shows the rollout of a live scene together with another one.

    Compared with a kept rollout or the fit, that one is A and the sliders go on moving B. Compared
    with PhysTwin's topology, the sliders move A, and B is simulated once; this is the figure.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        live: SimulationClient,
        session: str,
        *,
        newest: Callable[[], ObjectRollout | None],
        redraw: Callable[[], None],
        pixel_ratio: Callable[[], float],
    ) -> None:
        """Add the buttons, hidden until there is an object.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            live: The process that simulates PhysTwin's topology.
            session: Id of the session.
            newest: Gives the rollout that was asked for last, as far as it is there.
            redraw: Draws the current frame again.
            pixel_ratio: Gives the pixels of the screen for each of the page.
        """
        self._server = server
        self._guard = guard
        self._live = live
        self._mailbox = f"{session}/figure"
        self._newest = newest
        self._redraw = redraw
        self._lock = threading.RLock()
        self._cameras = ComparisonCameras(pixel_ratio)
        self._content: Content | None = None
        self._framing: Framing | None = None
        self._run: Path | None = None
        self._view: CompareView | None = None
        self._compared: Compared = "kept"
        self._look_of_kept = Look(mode="overlay")
        self._rollout_a: ObjectRollout | None = None
        self._last_rollout_a: ObjectRollout | None = None
        self._baseline: PhysTwinBaseline | None = None
        self._phystwin: LiveRollouts | None = None
        self._described: tuple[Any, ...] = ()
        gui = server.gui
        self._figure_button = gui.add_button(
            _FIGURE_OFF, icon=viser.Icon.COLUMNS_2, color="gray", hint="F: the paper's figure"
        )
        self._keep_buttons = gui.add_button_group(
            "Keep as A",
            (_THIS, _FIT),
            hint="Keep a rollout as A, then change B by the sliders. V: compare with what was kept "
            "last, or with the fit",
        )
        self._stop_button = gui.add_button("Stop comparing", color="gray", hint="V")
        self._place = gui.add_folder(None)
        for button in (self._figure_button, self._keep_buttons, self._stop_button):
            button.visible = False
        self._figure_button.on_click(guard(lambda _: self.toggle_figure()))
        self._keep_buttons.on_click(
            guard(lambda event: self.keep(is_fit=event.target.value == _FIT))
        )
        self._stop_button.on_click(guard(lambda _: self.stop()))
        bind(server, guard, "figure", lambda _, __: self.toggle_figure())
        bind(server, guard, "pin", lambda _, __: self.toggle())

    @property
    def is_on(self) -> bool:
        """Whether two rollouts are shown instead of the scene."""
        return self._view is not None

    @property
    def is_figure(self) -> bool:
        """Whether the rollout is compared with PhysTwin's topology."""
        return self._view is not None and self._compared == "phystwin"

    @property
    def offers_figure(self) -> bool:
        """Whether the content can be compared with PhysTwin's topology."""
        return self._run is not None

    def offer(self, content: Content, framing: Framing, run: Path | None) -> None:
        """Get ready for a content; without an object there is nothing to compare.

        Args:
            content: What the session shows.
            framing: Sizes.
            run: Folder of the run; None for a recording.
        """
        self.close()
        with self._lock:
            self._content, self._framing = content, framing
            self._rollout_a = self._last_rollout_a = None
            self._run = run if run is not None and PhysTwinBaseline.is_offered(content) else None
            self._keep_buttons.visible = content.fitted is not None
            self._figure_button.visible = self.offers_figure

    def toggle(self) -> None:
        """Compare with the rollout that was kept last, or with the fit; or stop comparing.

        Raises:
            UsageError: If both have the parameters of what is shown, which would be compared with
                itself.
        """
        with self._lock:
            if self.is_on and self._compared == "kept":
                self._leave()
            elif self._keep_buttons.visible and self._content is not None:
                newest = self._newest()
                now = newest.parameters if newest is not None else None
                others = (self._last_rollout_a, self._content.fitted)
                other = next((o for o in others if o is not None and o.parameters != now), None)
                if other is None:
                    raise UsageError(
                        "Nothing is changed yet. Move a slider; V compares with the fit."
                    )
                self._enter("kept", other)
        self._redraw()

    def keep(self, *, is_fit: bool) -> None:
        """Keep a rollout as A, and compare with it.

        Args:
            is_fit: Whether it is the fitted one instead of the newest.

        Raises:
            MissingInputError: If no frame of it is simulated yet.
        """
        with self._lock:
            fitted = self._content.fitted if self._content is not None else None
            self._enter("kept", fitted if is_fit else self._newest())
            self._last_rollout_a = self._rollout_a
        self._redraw()

    def toggle_figure(self) -> None:
        """Compare with PhysTwin's topology, or show the scene again."""
        with self._lock:
            if self.is_figure:
                self._leave()
            elif self.offers_figure:
                self._enter("phystwin", None)
        self._redraw()

    def stop(self) -> None:
        """Show the scene again."""
        with self._lock:
            was_on = self.is_on
            self._leave()
        if was_on:
            self._redraw()

    def close(self) -> None:
        """Stop comparing and forget PhysTwin's rollout."""
        with self._lock:
            self._leave()
            if self._phystwin is not None:
                self._phystwin.close()
            self._phystwin = self._baseline = None

    def hide(self) -> None:
        """Hide the comparison; runs in the thread that draws."""
        with self._lock:
            if self._view is not None:
                self._view.drawing.hide()

    def draw(
        self,
        rollout: ObjectRollout,
        rollout_frame: int,
        frame: int,
        layers: Layers,
        *,
        is_playing: bool,
    ) -> None:
        """Bring both sides to a frame.

        Args:
            rollout: The rollout that the session shows.
            rollout_frame: Its frame.
            frame: Frame of the hands.
            layers: What is shown.
            is_playing: Whether the clock is running.
        """
        with self._lock:
            view = self._view
            if view is not None:
                self._describe(view, self._newest() or rollout)
                sides = self._sides(rollout, rollout_frame, frame)
                view.draw(frame, sides, layers, is_playing=is_playing)

    def rollouts(
        self, rollout: ObjectRollout, rollout_frame: int, frame: int
    ) -> ComparedRollouts | None:
        """Collect the rollouts of both sides in a frame, to be saved; None outside of a comparison.

        Args:
            rollout: The rollout that the session shows.
            rollout_frame: Its frame.
            frame: Frame of the hands.
        """
        with self._lock:
            if not self.is_on:
                return None
            return compared_rollouts(self._sides(rollout, rollout_frame, frame))

    @property
    def framed_picture(self) -> Callable[[viser.ClientHandle], dict[str, Any]] | None:
        """Finds camera and size of a picture of both sides; None if the client's own will do."""
        return self._view.picture() if self._view is not None else None

    def part(self, client: viser.ClientHandle) -> Pose:
        """Forget a client; returns where its camera stands in the scene."""
        with self._lock:
            return self._cameras.forget(client)

    def pose(self) -> Pose | None:
        """Pose of the first client's camera in the scene; None without clients."""
        clients = list(self._server.get_clients().values())
        return self._cameras.before(clients[0]) if clients else None

    def welcome(self, client: viser.ClientHandle) -> None:
        """Show both sides to a client that comes while they are on."""
        with self._lock:
            if self._view is not None:
                self._view.welcome(client)

    def turn(self, client: viser.ClientHandle) -> None:
        """Let the sides follow a client's camera."""
        with self._lock:  # A comparison that is being left aims no camera.
            if self._view is not None:
                self._view.turn(client)

    def reset_view(self, client: viser.ClientHandle) -> bool:
        """Show both sides whole to a client; False if they are not beside each other."""
        with self._lock:
            return self._view is not None and self._view.reset_view(client)

    def next_tint(self, step: int) -> bool:
        """Give both sides their next colors, or those before; False outside of a comparison."""
        with self._lock:
            view = self._view
        if view is not None:
            view.panel.next_tint(step)
        return view is not None

    def _enter(self, compared: Compared, rollout_a: ObjectRollout | None) -> None:
        content, framing = self._content, self._framing
        if content is None or framing is None or content.fitted is None:
            raise MissingInputError("There is no simulated object here to compare.")
        if compared == "kept":
            if rollout_a is None or rollout_a.ready == 0:
                raise MissingInputError("There is no simulated frame to keep yet.")
            self._rollout_a = rollout_a
        if self._view is not None and self._compared == compared:
            return
        self._leave()
        self._compared = compared
        look = self._look_of_kept if compared == "kept" else Look(tint="parts")
        if compared == "phystwin":
            self._simulate_phystwin(content, content.fitted)
        with self._place:
            self._view = CompareView(
                self._server,
                self._guard,
                content=content,
                framing=framing,
                rollouts=[content.fitted],
                cameras=self._cameras,
                look=look,
                redraw=self._redraw,
            )
        self._described = ()
        self._stop_button.visible = compared == "kept"
        self._figure_button.label = _FIGURE_ON if compared == "phystwin" else _FIGURE_OFF
        for client in self._server.get_clients().values():
            self._view.turn(client)
        self._view.enter()

    def _leave(self) -> None:
        view, self._view = self._view, None
        if view is not None:
            view.leave()
            view.close()
            self._stop_button.visible = False
            self._figure_button.label = _FIGURE_OFF

    def _sides(self, rollout: ObjectRollout, rollout_frame: int, frame: int) -> Sides:
        """Collect what A and B show."""
        shown, is_figure = self._shown_side(rollout, rollout_frame, frame), self.is_figure
        other = (
            self._phystwin.newest if is_figure and self._phystwin is not None else self._rollout_a
        )
        title, detail = ("PhysTwin-style", "simulating …") if is_figure else ("A · kept", "")
        if other is not None and other.ready > 0:
            detail = self._topology(other) if is_figure else self._changes(other)
        else:
            other = None
        compared = ComparedSide(
            name="phystwin" if is_figure else "a",
            title=title,
            detail=detail,
            rollout=other,
            frame=min(frame, other.ready - 1) if other is not None else 0,
            content=shown.content,
            content_frame=frame,
        )
        return {"a": shown, "b": compared} if is_figure else {"a": compared, "b": shown}

    def _shown_side(self, rollout: ObjectRollout, rollout_frame: int, frame: int) -> ComparedSide:
        """Describe the side that the sliders move."""
        if self._content is None:
            raise MissingInputError("There is no simulated object here to compare.")
        is_figure = self.is_figure
        return ComparedSide(
            name="ours" if is_figure else "b",
            title="ours" if is_figure else "B · now",
            detail=self._topology(rollout) if is_figure else self._changes(rollout),
            rollout=rollout if rollout.ready > 0 else None,
            frame=rollout_frame,
            content=self._content,
            content_frame=frame,
        )

    def _describe(self, view: CompareView, newest: ObjectRollout) -> None:
        """Name both sides on the panel and measure their difference, as far as that is new."""
        rollout_a, content = self._rollout_a, self._content
        first, second = (newest, None) if self.is_figure else (rollout_a, newest)
        if self.is_figure and self._phystwin is not None:
            second = self._phystwin.newest
        if first is None or second is None or content is None:
            return
        notes = self._figure_notes() if self.is_figure else self._changes_from(first, second)
        described = (first, second, second.is_complete, notes)
        if described != self._described:
            self._described = described
            say = self._topology if self.is_figure else self._changes
            names = ("ours", "PhysTwin-style") if self.is_figure else ("kept", "now")
            view.panel.name(
                {"a": f"{names[0]}: {say(first)}", "b": f"{names[1]}: {say(second)}"},
                notes,
                unit=content.length_unit,
                tick_count=content.frame_count,
            )
            # Arrows keep their scale while the sliders move.
            steady = (content.fitted, second if self.is_figure else first)
            view.drawing.measure_forces([r for r in steady if r is not None and r.is_complete])
        count = min(first.frame_count, second.frame_count)
        frames = tuple((frame, frame) for frame in range(count))
        view.follow(Pairing(first=first, second=second, frames=frames))

    def _changes_from(self, rollout_a: ObjectRollout, newest: ObjectRollout) -> tuple[str, ...]:
        """Say how the parameters of B differ from those of A."""
        unit = self._content.length_unit if self._content is not None else "m"
        sliders = knobs(rollout_a.parameters, length_unit=unit)
        changes = changes_in(sliders, rollout_a.parameters, newest.parameters)
        texts = [change.text for change in changes]
        texts += edits_text(rollout_a.edits, newest.edits)
        if texts:
            return (f"From A to B: {', '.join(texts)}",)
        return ("From A to B: equal parameters. Move a slider to change B.",)

    def _changes(self, rollout: ObjectRollout) -> str:
        """Say how the parameters of a rollout differ from the fitted ones."""
        content = self._content
        fitted = content.fitted if content is not None else None
        if content is None or fitted is None or rollout is fitted:
            return "the fit"
        sliders = knobs(fitted.parameters, length_unit=content.length_unit)
        changes = changes_in(sliders, fitted.parameters, rollout.parameters)
        texts = [change.text for change in changes] + edits_text(fitted.edits, rollout.edits)
        text = ", ".join(texts) or "as fitted"
        return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]} …"

    def _topology(self, rollout: ObjectRollout) -> str:
        """Say which virtual springs a rollout has."""
        parameters = rollout.parameters
        is_metric = self._content is None or self._content.is_metric
        radius = parameters.virtual_connection_radius
        shown = f"{1e3 * radius:.3g} mm" if is_metric else f"{radius:.3g}"
        return (
            f"δ {shown} · d_max {parameters.virtual_max_neighbors} · "
            f"{rollout.model.virtual_spring_count} virtual springs"
        )

    def _simulate_phystwin(self, content: Content, fitted: ObjectRollout) -> None:
        """Have PhysTwin's topology simulated, once for a content."""
        if self._phystwin is not None or self._run is None:
            return
        self._baseline = PhysTwinBaseline.of(content, fitted)
        controls = tuple(int(control) for control in self._baseline.controls)
        empty = ObjectRollout.empty(
            fitted.model,
            self._baseline.parameters,
            np.asarray(fitted.control[:, list(controls)]),
            fitted.restart,
        )
        self._phystwin = LiveRollouts(
            self._mailbox,
            self._live,
            empty,
            run=self._run,
            sequence=content.sequence_name,
            controls=controls,
            on_change=self._hear,
        )
        self._phystwin.request(self._baseline.parameters, automatic_substeps=True)

    def _hear(self, kind: str, _: int) -> None:
        """Follow PhysTwin's simulation; runs in the live simulation's thread."""
        simulated = self._phystwin
        if simulated is None:
            return
        if kind in {"diverged", "failed"}:
            title = "The PhysTwin-style simulation stopped; its last good state is kept"
            notify(self._server, title, simulated.readout.error or "", seconds=12.0)
        if self.is_figure:
            self._redraw()

    def _figure_notes(self) -> tuple[str, ...]:
        """Say what B is and how far it is simulated."""
        simulated, baseline = self._phystwin, self._baseline
        if simulated is None or baseline is None:
            return ()
        readout = simulated.readout
        notes = [
            f"B: the same object held by {baseline.source}, virtual springs as in the profile "
            "phystwin.",
            f"PhysTwin-style: simulated {readout.simulated_count}/{readout.frame_count} frames",
        ]
        notes += [baseline.note] if baseline.note else []
        notes += [f"Stopped: {readout.error.splitlines()[0]}"] if readout.error else []
        return tuple(notes)
