"""Comparing in a live scene: one rollout is kept as A, and the sliders go on moving B."""

import threading
from collections.abc import Callable
from typing import Any

import viser

from app.viewer.compare.curve import Pairing
from app.viewer.compare.drawing import CompareDrawing
from app.viewer.compare.figure import Side
from app.viewer.compare.figure_mode import FigureMode
from app.viewer.compare.look import Look
from app.viewer.compare.recorded import Half, Halves
from app.viewer.compare.view import CompareView
from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from app.viewer.physics.parameters import changes_in, knobs
from app.viewer.scene.framing import Framing
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout

_THIS, _FIT, _STOP = "this rollout", "the fit", "stop"
_LONGEST_TEXT = 70


class PinMode:
    """Keeps a rollout as A and shows it together with the one that the sliders make, B."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        figure: FigureMode,
        newest: Callable[[], ObjectRollout | None],
        redraw: Callable[[], None],
    ) -> None:
        """Add the buttons, hidden until there is an object.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            figure: The other mode that moves cameras; only one of both is on.
            newest: Gives the rollout that was asked for last, as far as it is there.
            redraw: Draws the current frame again.
        """
        self._server = server
        self._guard = guard
        self._figure = figure
        self._newest = newest
        self._redraw = redraw
        self._lock = threading.RLock()
        self._content: Content | None = None
        self._framing: Framing | None = None
        self._pinned: ObjectRollout | None = None
        self._view: CompareView | None = None
        self._told: tuple[ObjectRollout, ObjectRollout] | None = None
        self._look = Look(mode="overlay")
        figure.before_entering = self.stop
        gui = server.gui
        self._buttons = gui.add_button_group(
            "Keep as A", (_THIS, _FIT), hint="V: keep a rollout as A, then change B by the sliders"
        )
        self._buttons.visible = False
        self._stop = gui.add_button("Stop comparing", color="gray", hint="V")
        self._stop.visible = False
        self._place = gui.add_folder(None)
        self._buttons.on_click(guard(lambda event: self.pin(is_fit=event.target.value == _FIT)))
        self._stop.on_click(guard(lambda _: self.stop()))
        bind(server, guard, "pin", lambda _, __: self.toggle())

    @property
    def is_on(self) -> bool:
        """Whether two rollouts are shown instead of one."""
        return self._view is not None

    def offer(self, content: Content, framing: Framing) -> None:
        """Get ready for a content; without an object there is nothing to keep."""
        self.stop()
        with self._lock:
            self._content, self._framing = content, framing
            self._buttons.visible = content.fitted is not None

    def toggle(self) -> None:
        """Keep the rollout on the screen, or stop comparing."""
        if self.is_on:
            self.stop()
        elif self._buttons.visible:
            self.pin(is_fit=False)

    def pin(self, *, is_fit: bool) -> None:
        """Keep a rollout as A.

        Args:
            is_fit: Whether it is the fitted one instead of the newest.

        Raises:
            MissingInputError: If no frame of it is simulated yet.
        """
        # Before the lock is taken: the figure holds its own while it asks this mode to stop.
        if self._figure.is_on:
            self._figure.toggle()
        with self._lock:
            content = self._content
            fitted = content.fitted if content is not None else None
            rollout = fitted if is_fit else self._newest()
            if content is None or self._framing is None or rollout is None or rollout.ready == 0:
                raise MissingInputError("There is no simulated frame to keep yet.")
            self._pinned, self._told = rollout, None
            if self._view is None:
                self._enter(content, self._framing, rollout)
        self._redraw()

    def stop(self) -> None:
        """Show one rollout again."""
        with self._lock:
            view, self._view = self._view, None
            self._pinned = None
            self._stop.visible = False
            if view is not None:
                view.leave()
                view.close()
        if view is not None:
            self._redraw()

    def close(self) -> None:
        """Stop measuring; the server is about to stop."""
        with self._lock:
            if self._view is not None:
                self._view.curve.close()

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
            rollout: The rollout that the session shows, B.
            rollout_frame: Its frame.
            frame: Frame of the hands.
            layers: What is shown.
            is_playing: Whether the clock is running.
        """
        with self._lock:
            view, pinned = self._view, self._pinned
            if view is None or pinned is None:
                return
            self._tell(view, pinned, self._newest() or rollout)
            halves = self.halves(rollout, rollout_frame, frame)
            view.draw(frame, halves, layers, is_playing=is_playing)

    def halves(self, rollout: ObjectRollout, rollout_frame: int, frame: int) -> Halves:
        """Collect what both sides show in a frame."""
        content, pinned = self._content, self._pinned
        if content is None or pinned is None:
            return {}
        sides = {
            "a": Side(
                rollout=pinned,
                frame=min(frame, pinned.ready - 1),
                caption=f"A · kept\n{self._changes(pinned)}",
            ),
            "b": Side(
                rollout=rollout, frame=rollout_frame, caption=f"B · now\n{self._changes(rollout)}"
            ),
        }
        return {name: Half(side=side, content=content, frame=frame) for name, side in sides.items()}

    def sides(self, rollout: ObjectRollout, rollout_frame: int, frame: int) -> dict[str, Side]:
        """Collect the rollouts of both sides in a frame, to be saved."""
        halves = self.halves(rollout, rollout_frame, frame)
        return {name: half.side for name, half in halves.items()}

    @property
    def framed_picture(self) -> Callable[[viser.ClientHandle], dict[str, Any]] | None:
        """Finds the picture's camera; None if the client's own will do."""
        return self._view.picture() if self._view is not None else None

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

    def _enter(self, content: Content, framing: Framing, rollout: ObjectRollout) -> None:
        drawing = CompareDrawing(self._server, content, framing, [rollout])
        with self._place:
            self._view = CompareView(
                self._server,
                self._guard,
                drawing,
                self._figure.cameras,
                look=self._look,
                redraw=self._redraw,
                has_keys=False,
            )
        self._stop.visible = True
        for client in self._server.get_clients().values():
            self._view.turn(client)
        self._view.enter()

    def _tell(self, view: CompareView, pinned: ObjectRollout, newest: ObjectRollout) -> None:
        """Compare with another rollout, and say how their parameters differ."""
        if self._told is not None and self._told[0] is pinned and self._told[1] is newest:
            view.follow(self._pairing(pinned, newest))
            return
        self._told = (pinned, newest)
        content = self._content
        unit = content.length_unit if content is not None else "m"
        told = changes_in(
            knobs(pinned.parameters, length_unit=unit), pinned.parameters, newest.parameters
        )
        text = ", ".join(change.text for change in told) or "equal parameters"
        view.panel.name(
            {"a": f"kept: {self._changes(pinned)}", "b": f"now: {self._changes(newest)}"},
            (f"From A to B: {text}",),
            unit=unit,
            tick_count=newest.frame_count,
        )
        view.follow(self._pairing(pinned, newest))

    def _pairing(self, pinned: ObjectRollout, newest: ObjectRollout) -> Pairing:
        count = min(pinned.frame_count, newest.frame_count)
        return Pairing(first=pinned, second=newest, frames=tuple((f, f) for f in range(count)))

    def _changes(self, rollout: ObjectRollout) -> str:
        """Say what a rollout has that the fit has not."""
        content = self._content
        fitted = content.fitted if content is not None else None
        if content is None or fitted is None or rollout is fitted:
            return "the fit"
        sliders = knobs(fitted.parameters, length_unit=content.length_unit)
        told = changes_in(sliders, fitted.parameters, rollout.parameters)
        text = ", ".join(change.text for change in told) or "as fitted"
        return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]} …"
