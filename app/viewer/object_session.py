"""The object of one session: its rollouts, the sliders that change them, and what is heard."""

import viser

from app.viewer.content import Content
from app.viewer.error_panel import ErrorPanel, load_track_error
from app.viewer.guard import Guard, notify
from app.viewer.live import LiveSimulation
from app.viewer.physics_panel import PhysicsPanel
from app.viewer.playback import Playback
from app.viewer.resimulation import Resimulation
from app.viewer.take import Take
from physhandi.data.run import Run
from physhandi.simulation.model import SimulationParameters


class ObjectSession:
    """Lets sliders re-simulate the object of one sequence of a run."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        playback: Playback,
        *,
        session: str,
        live: LiveSimulation,
        content: Content,
        fitted: Take,
        run: Run,
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
        """
        self._server = server
        self._playback = playback
        self._fitted = fitted
        self._panel: PhysicsPanel | None = None
        self._resimulation = Resimulation(
            session,
            live,
            fitted,
            run=run.folder,
            sequence=content.sequence_name,
            on_change=self._hear,
        )
        self._panel = PhysicsPanel(server, content, fitted, guard, self._simulate)
        error = load_track_error(run, content.sequence_name, fitted.frame_count)
        self._errors = ErrorPanel(server, content, fitted, error)
        self._panel.show(self._resimulation.readout, at_once=True)

    @property
    def panel(self) -> PhysicsPanel | None:
        """The sliders."""
        return self._panel

    def at(self, frame: int) -> tuple[Take, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        return self._resimulation.at(frame)

    def show(self, frame: int, *, is_playing: bool) -> None:
        """Tell the panel which frame is on the screen."""
        self._errors.show(frame, is_playing=is_playing)

    def close(self) -> None:
        """Stop simulating."""
        self._resimulation.close()

    def remove(self) -> None:
        """Stop simulating and take the panel away."""
        self.close()
        if self._panel is not None:
            self._panel.remove()
            self._errors.remove()
            self._panel = None

    def _simulate(self, parameters: SimulationParameters, automatic_substeps: bool) -> None:
        resimulation = self._resimulation
        if parameters == self._fitted.parameters and not automatic_substeps:
            resimulation.show_fitted()
            return
        resimulation.request(parameters, automatic_substeps=automatic_substeps)
        if self._panel is not None:
            self._panel.show(resimulation.readout, at_once=True)

    def _hear(self, kind: str, ready: int) -> None:
        """Follow the live simulation; runs in its thread."""
        panel = self._panel
        if panel is None:
            return
        readout = self._resimulation.readout
        panel.show(readout, at_once=kind != "frame")
        self._errors.follow(self._resimulation.newest, at_once=kind != "frame")
        if kind == "frame":
            self._follow(ready)
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

    def _follow(self, ready: int) -> None:
        """Let the running clock follow the frames that are ready, from the first one on."""
        playback = self._playback
        if playback.is_playing:
            playback.limit(ready)
            if ready == 1:
                playback.seek(0)
        elif playback.frame == ready - 1:
            playback.redraw()
