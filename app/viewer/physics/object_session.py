"""The object of one session: its rollouts, the sliders that change them, and what is heard."""

import threading

import viser

from app.viewer.clock.playback import Playback
from app.viewer.content.content import Content
from app.viewer.live.client import SimulationClient
from app.viewer.live.rollouts import LiveRollouts, Readout
from app.viewer.physics.error_panel import ErrorPanel, load_track_error
from app.viewer.physics.frame_strip import FrameStrip
from app.viewer.physics.keep_panel import UserStorage, run_changes
from app.viewer.physics.panel import GO, STEP, PhysicsPanel
from app.viewer.ui.guard import Guard, notify
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters


class ObjectSession:
    """Lets sliders re-simulate the object of one sequence of a run."""

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
        keeping: UserStorage | None = None,
    ) -> None:
        """Listen to the live simulation and add the physics panel where the caller stands.

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
            keeping: Where presets and runs are kept; None where nothing can be kept.
        """
        self._server = server
        self._playback = playback
        self._fitted = fitted
        self._run = run
        self._sequence = content.sequence_name
        self._strip = strip
        self._keeping = keeping
        self._closed = threading.Event()
        # Sliders, buttons and the simulation are heard in threads of their own.
        self._lock = threading.RLock()
        self._asking = threading.Lock()
        self._panel: PhysicsPanel | None = None
        self._resimulation = LiveRollouts(
            session,
            live,
            fitted,
            run=run.folder,
            sequence=content.sequence_name,
            on_change=self._hear,
        )
        self._panel = PhysicsPanel(
            server,
            content,
            fitted,
            guard,
            self._simulate,
            set_pace=self._set_pace,
            keeping=keeping,
            save=self._save,
        )
        error = load_track_error(run, content.sequence_name, fitted.frame_count)
        self._errors = ErrorPanel(server, content, fitted, error)
        self._show_readout(at_once=True)

    @property
    def panel(self) -> PhysicsPanel | None:
        """The sliders."""
        return self._panel

    def at(self, frame: int) -> tuple[ObjectRollout, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        return self._resimulation.at(frame)

    @property
    def newest(self) -> ObjectRollout:
        """The rollout that was asked for last, as far as it is there."""
        return self._resimulation.newest

    def show(self, frame: int, *, is_playing: bool) -> None:
        """Tell the panel which frame is on the screen."""
        self._errors.show(frame, is_playing=is_playing)

    def close(self) -> None:
        """Stop simulating."""
        self._closed.set()
        self._resimulation.close()
        if self._panel is not None:
            self._panel.close()

    def remove(self) -> None:
        """Stop simulating and take the panel away."""
        self.close()
        if self._panel is not None:
            self._panel.remove()
            self._errors.remove()
            self._strip.hide()
            self._panel = None

    def _simulate(self, parameters: SimulationParameters, automatic_substeps: bool) -> None:
        resimulation = self._resimulation
        if parameters == self._fitted.parameters and not automatic_substeps:
            resimulation.show_fitted()
            return
        self._request()

    def _request(self) -> None:
        """Simulate the parameters in force, even the fitted ones."""
        panel = self._panel
        if panel is not None:
            with self._asking:  # What is asked for last must be what was read last.
                parameters, is_automatic = panel.history.current, panel.is_automatic
                self._resimulation.request(parameters, automatic_substeps=is_automatic)
            self._show_readout(at_once=True)

    def _set_pace(self, pace: str) -> None:
        """Hold the simulation, compute one frame of it or let it run."""
        resimulation = self._resimulation
        with self._lock:
            readout = resimulation.readout
            if pace != GO and not readout.is_held:
                resimulation.hold(on=True)
            if pace == GO:
                resimulation.hold(on=False)
            elif pace == STEP:
                if not readout.is_busy:
                    self._request()
                resimulation.step()
        self._show_readout(at_once=True)

    def _save(self, name: str) -> None:
        """Have what is on the screen simulated and measured as a run of its own."""
        panel, keeping = self._panel, self._keeping
        if panel is None or panel.keep is None or keeping is None:
            return
        readout = self._resimulation.readout
        if readout.error is not None:
            raise UsageError(
                f"The simulation stopped at frame {readout.simulated_count}, and as a run it would "
                "too. Change the parameters until it reaches the end."
            )
        now, is_automatic = panel.history.current, panel.is_automatic
        changes = run_changes(self._run, self._fitted.parameters, now, is_automatic=is_automatic)
        run = keeping.saver.save(self._run.id, self._sequence, name, changes)
        keeping.saver.follow(run, panel.keep.tell, self._closed)

    def _show_readout(self, *, at_once: bool) -> Readout:
        with self._lock:  # What is shown last must be what was read last.
            readout = self._resimulation.readout
            if self._panel is not None:
                self._panel.show(readout, at_once=at_once or readout.is_held)
                self._strip.show(readout, at_once=at_once or readout.is_held)
        return readout

    def _hear(self, kind: str, ready: int) -> None:
        """Follow the live simulation; runs in its thread."""
        panel = self._panel
        if panel is None:
            return
        readout = self._show_readout(at_once=kind != "frame")
        if kind in {"stability", "ready"}:
            return
        with self._lock:  # What is measured last must be what was read last.
            self._errors.follow(self._resimulation.newest, at_once=kind != "frame")
        if kind == "frame":
            self._follow(ready, is_held=readout.is_held)
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

    def _follow(self, ready: int, *, is_held: bool) -> None:
        """Let the running clock follow the frames that are ready, from the first one on."""
        playback = self._playback
        if is_held:
            playback.play(on=False)
            playback.seek(ready - 1)
            return
        # Of a clock that stands, too: it may be started before another frame is ready.
        playback.limit(ready)
        if not self._resimulation.is_busy:
            # Somebody went back to the fit meanwhile, and no other frame will come.
            playback.limit(playback.frame_count)
        elif playback.is_playing and ready == 1:
            playback.seek(0)
        elif not playback.is_playing and playback.frame == ready - 1:
            playback.redraw()
