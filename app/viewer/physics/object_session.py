"""The object of one session: its rollouts, the sliders that change them, and who follows them."""

import math
import threading
import time
from typing import Any

import viser

from app.viewer.clock.playback import Playback
from app.viewer.content.content import Content
from app.viewer.live.client import LiveRollouts, Readout, SimulationClient
from app.viewer.physics.error_panel import ErrorPanel, load_track_error
from app.viewer.physics.keep_panel import UserStorage
from app.viewer.physics.panel import PhysicsPanel
from app.viewer.ui.guard import Guard, notify
from app.viewer.ui.tabs import Tabs
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run

_REFRESH = 0.1
_NEW, _BAD, _OLD = "#228be6", "#e03131", "rgba(128,128,128,0.3)"


class ObjectSession:
    """Re-simulates the object of one sequence of a run, and shows how far that is."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        playback: Playback,
        *,
        tabs: Tabs,
        session: str,
        live: SimulationClient,
        content: Content,
        fitted: ObjectRollout,
        run: Run,
        strip: "FrameStrip",
        storage: UserStorage | None = None,
    ) -> None:
        """Listen to the live simulation and add the panels.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            playback: The session's clock.
            tabs: Where the panels go.
            session: Id of the session.
            live: The process that simulates.
            content: What is shown.
            fitted: The fitted rollout.
            run: The run.
            strip: Shows which frames are new.
            storage: Where presets and runs are kept; None where nothing can be kept.
        """
        self._server = server
        self._playback = playback
        self._strip = strip
        # Controls and the live simulation call in threads of their own.
        self._lock = threading.RLock()
        self._is_shown = False
        self._rollouts = LiveRollouts(
            session,
            live,
            fitted,
            run=run.folder,
            sequence=content.sequence_name,
            on_change=self._follow,
        )
        self.panel = PhysicsPanel(
            server, guard, content, self._rollouts, tabs=tabs, run=run, storage=storage
        )
        """The sliders."""
        error = load_track_error(run, content.sequence_name, fitted.frame_count)
        doubts = [w["code"] for w in run.warnings if w["sequence"] == content.sequence_name]
        with tabs["Inspect"]:
            self._errors = ErrorPanel(server, content, fitted, error, doubts)
        self._is_shown = True
        self._show_readout(at_once=True)

    def at(self, frame: int) -> tuple[ObjectRollout, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        return self._rollouts.at(frame)

    @property
    def newest(self) -> ObjectRollout:
        """The rollout that was asked for last, as far as it is there."""
        return self._rollouts.newest

    def show(self, frame: int, *, is_playing: bool) -> None:
        """Show the errors of the frame on the screen."""
        self._errors.show(frame, is_playing=is_playing)

    def close(self) -> None:
        """Stop simulating."""
        self._rollouts.close()
        self.panel.close()

    def remove(self) -> None:
        """Stop simulating and take the panels away."""
        with self._lock:
            self._is_shown = False
        self.close()
        self.panel.remove()
        self._errors.remove()
        self._strip.hide()

    def _follow(self, kind: str, ready: int) -> None:
        """Follow the rollouts; called in the thread that changed them."""
        with self._lock:  # What is shown last must be what was read last.
            if not self._is_shown:
                return
            readout = self._show_readout(at_once=kind != "frame")
            if kind in {"requested", "stability", "ready"}:
                return
            self._errors.follow(self._rollouts.newest, at_once=kind != "frame")
        if kind == "frame":
            self._follow_frame(ready, is_held=readout.is_held)
            return
        self._playback.limit(self._playback.frame_count)
        if kind == "diverged":
            title = "Simulation diverged; the last good state is kept"
            notify(self._server, title, readout.error or "", seconds=12.0)
        elif kind == "failed":
            notify(self._server, "Simulation failed", readout.error or "")
        elif kind == "crashed":
            then = "Move a slider to simulate again."
            then = "Simulating again." if readout.is_busy else then
            title = "The live simulation stopped and was started anew"
            notify(self._server, title, then, color="orange")

    def _show_readout(self, *, at_once: bool) -> Readout:
        with self._lock:
            readout = self._rollouts.readout
            self.panel.show(readout, at_once=at_once or readout.is_held)
            self._strip.show(readout, at_once=at_once or readout.is_held)
        return readout

    def _follow_frame(self, ready: int, *, is_held: bool) -> None:
        """Let the running clock follow the frames that are ready, from the first one on."""
        playback = self._playback
        if is_held:
            playback.play(on=False)
            playback.seek(ready - 1)
            return
        # Of a clock that stands, too: it may be started before another frame is ready.
        playback.limit(ready)
        if not self._rollouts.is_busy:
            # Somebody went back to the fit meanwhile, and no other frame will come.
            playback.limit(playback.frame_count)
        elif playback.is_playing and ready == 1:
            playback.seek(0)
        elif not playback.is_playing and playback.frame == ready - 1:
            playback.redraw()


class FrameStrip:
    """Shows which frames of the timeline are new while the sliders' rollout is simulated.

    It is as wide as the track of the slider above it and takes no room as long as the fitted
    rollout is shown.
    """

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        """Add the strip.

        Args:
            server: Where to.
            order: Place in the panel, just behind the slider's.
        """
        self._drawn = -math.inf
        self._html: Any = server.gui.add_html("", order=order, visible=False)

    def show(self, readout: Readout, *, at_once: bool) -> None:
        """Draw what a readout says, not more often than people see.

        Args:
            readout: What to draw.
            at_once: Whether to draw it even if the last one is fresh.
        """
        is_visible, now = not readout.is_fitted, time.monotonic()
        if not at_once and now - self._drawn < _REFRESH:
            return
        self._drawn = now
        if is_visible:
            self._html.content = strip_html(readout)
        if self._html.visible != is_visible:
            self._html.visible = is_visible

    def hide(self) -> None:
        """Take no room until there is something to show again."""
        self._html.visible = False


def strip_html(readout: Readout) -> str:
    """Draw the strip of one readout."""
    ready, count = readout.simulated_count, max(readout.frame_count, 1)
    # A slider's handle is in the middle of its frame, so the last new frame ends at its handle.
    part = 0.0 if ready == 0 else 100.0 * max(ready - 1, 0) / max(count - 1, 1)
    part = 100.0 if ready >= count else part
    rest = _BAD if readout.error else _OLD
    bar = (
        "<div style='height:4px;border-radius:2px;"
        f"background:linear-gradient(to right,{_NEW} {part:.1f}%,{rest} {part:.1f}%)'></div>"
    )
    track = "margin:-0.3em 6.6em 0.2em 11.7em"
    style = "font-size:0.7em;line-height:1.4;opacity:0.85"
    caption = f"<div style='text-align:right;padding:0 1.2em 0.5em 0'>{_caption(readout)}</div>"
    return f"<div style='{style}'><div style='{track}'>{bar}</div>{caption}</div>"


def _caption(readout: Readout) -> str:
    ready, last = readout.simulated_count, readout.frame_count - 1
    if ready == 0:
        return "it stopped before its first frame" if readout.error else "no frame is new yet"
    new = f"frames 0 to {ready - 1} of {last} are new" if ready > 1 else f"frame 0 of {last} is new"
    if readout.error:
        return f"{new}, then it stopped"
    return new if readout.is_busy else "every frame is new"
