"""The object of one session: its rollouts, the sliders that change them, and who follows them."""

import threading

import viser

from app.viewer.clock.playback import Playback
from app.viewer.content.content import Content
from app.viewer.live.client import SimulationClient
from app.viewer.live.rollouts import LiveRollouts, Readout
from app.viewer.physics.error_panel import ErrorPanel, load_track_error
from app.viewer.physics.frame_strip import FrameStrip
from app.viewer.physics.keep_panel import UserStorage
from app.viewer.physics.panel import PhysicsPanel
from app.viewer.ui.guard import Guard, notify
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run


class ObjectSession:
    """Re-simulates the object of one sequence of a run, and shows how far that is."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        playback: Playback,
        *,
        session: str,
        live: SimulationClient,
        content: Content,
        fitted: ObjectRollout,
        run: Run,
        strip: FrameStrip,
        storage: UserStorage | None = None,
    ) -> None:
        """Listen to the live simulation and add the panels where the caller stands.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            playback: The session's clock.
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
        self.panel = PhysicsPanel(server, guard, content, self._rollouts, run=run, storage=storage)
        """The sliders."""
        error = load_track_error(run, content.sequence_name, fitted.frame_count)
        self._errors = ErrorPanel(server, content, fitted, error)
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
        """Tell the panel which frame is on the screen."""
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
