"""The figure mode of a session: its button and key, the rival's simulation and the camera."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from app.viewer.compare.figure import Figure, Side
from app.viewer.compare.figure_camera import Eye, FigureCameras, picture_of_figure
from app.viewer.compare.phystwin_baseline import PhysTwinBaseline
from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose
from app.viewer.live.client import LiveRollouts, SimulationClient
from app.viewer.scene.framing import Framing
from app.viewer.ui.guard import Guard, notify
from app.viewer.ui.keyboard import bind
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout

_ON, _OFF = "Back to the scene", "Compare with PhysTwin"


class FigureMode:
    """Switches between the scene and the figure; the rival is simulated at most once."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        live: SimulationClient,
        session: str,
        redraw: Callable[[], None],
    ) -> None:
        """Add the button, hidden until there is something to compare.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            live: The process that simulates the rival.
            session: Id of the session.
            redraw: Draws the current frame again.
        """
        self._server = server
        self._live = live
        self._mailbox = f"{session}/figure"
        self._redraw = redraw
        self._lock = threading.RLock()
        self.cameras = FigureCameras()
        """Where the clients' cameras stood before they were moved."""
        self.before_entering: Callable[[], None] = lambda: None
        """Called before the figure is shown; another mode that moves cameras leaves then."""
        self._is_on = False
        self._content: Content | None = None
        self._figure: Figure | None = None
        self._rival: PhysTwinBaseline | None = None
        self._rollout: LiveRollouts | None = None
        self._run: Path | None = None
        self._button = server.gui.add_button(
            _OFF, icon=viser.Icon.COLUMNS_2, color="gray", hint="F: the paper's figure"
        )
        self._button.visible = False
        self._text = server.gui.add_markdown("")
        self._text.visible = False
        self._button.on_click(guard(lambda _: self.toggle()))
        bind(server, guard, "figure", lambda _, __: self.toggle())

    @property
    def is_on(self) -> bool:
        """Whether the figure is shown instead of the scene."""
        return self._is_on

    def offer(self, content: Content, framing: Framing, run: Path | None) -> None:
        """Get ready for a content; without an object and hands there is no figure."""
        with self._lock:
            self.close()
            self._content = content
            self._run = run
            can = run is not None and PhysTwinBaseline.is_offered(content)
            self._button.visible = can
            if content.fitted is not None and can:
                self._figure = Figure(self._server, content, content.fitted, framing)

    @property
    def is_offered(self) -> bool:
        """Whether there is a figure of the content."""
        return self._figure is not None

    def close(self) -> None:
        """Leave the figure and forget the rival."""
        with self._lock:
            if self._is_on:
                self._leave()
            if self._rollout is not None:
                self._rollout.close()
            if self._figure is not None:
                self._figure.clear()
            self._rollout = self._rival = self._figure = None

    def toggle(self) -> None:
        """Enter the figure or leave it."""
        with self._lock:
            if self._is_on:
                self._leave()
            elif self._figure is not None:
                self.before_entering()
                self._enter()
        self._redraw()

    def hide(self) -> None:
        """Hide the figure's nodes; runs in the thread that draws."""
        if self._figure is not None:
            self._figure.hide()

    def draw(
        self, ours: ObjectRollout, ours_frame: int, frame: int, layers: Layers, *, is_playing: bool
    ) -> None:
        """Bring both halves to a frame.

        Args:
            ours: The rollout that the session shows.
            ours_frame: Its frame.
            frame: Frame of the hands.
            layers: What is shown.
            is_playing: Whether the clock is running.
        """
        figure = self._figure
        if figure is None:
            return
        sides = self.sides(ours, ours_frame, frame)
        figure.draw(sides, frame, layers, is_playing=is_playing)

    def sides(self, ours: ObjectRollout, ours_frame: int, frame: int) -> dict[str, Side]:
        """Collect what both halves show in a frame."""
        left = Side(rollout=ours, frame=ours_frame, caption=self._caption("ours", ours))
        simulated = self._rollout
        if simulated is None or simulated.newest.ready == 0:
            right = Side(rollout=None, frame=0, caption="PhysTwin-style\nsimulating …")
        else:
            rollout = simulated.newest
            at = min(frame, rollout.ready - 1)
            right = Side(
                rollout=rollout, frame=at, caption=self._caption("PhysTwin-style", rollout)
            )
        return {"ours": left, "phystwin": right}

    def part(self, client: viser.ClientHandle) -> Pose:
        """Forget a client; returns where its camera stands in the scene."""
        with self._lock:
            return self.cameras.forget(client)

    def pose(self) -> Pose | None:
        """Where the first client's camera stands in the scene; None without clients."""
        clients = list(self._server.get_clients().values())
        return self.cameras.before(clients[0]) if clients else None

    def turn(self, client: viser.ClientHandle) -> None:
        """Let the halves follow a client's camera."""
        with self._lock:  # A figure that is being left aims no camera.
            figure = self._figure
            if not self._is_on or figure is None:
                return
            if self.cameras.has_lost(client):
                self._aim(client, self.cameras.before(client))
                return
        figure.turn(Eye.of(client.camera.wxyz))

    def welcome(self, client: viser.ClientHandle) -> None:
        """Show the figure whole to a client that comes while it is on."""
        with self._lock:
            if self._is_on:
                self._aim(client, Pose.first(self._server.initial_camera))

    def reset_view(self, client: viser.ClientHandle) -> None:
        """Show the whole figure to a client that looked elsewhere."""
        with self._lock:
            self._aim(client, Pose.of(client.camera))

    def picture(self, client: viser.ClientHandle) -> dict[str, Any]:
        """Find camera and size of a picture of the figure, as arguments of ``get_render``."""
        figure = self._figure
        if figure is None:
            raise MissingInputError("There is no figure to save; this run has no fitted object.")
        return picture_of_figure(client, figure.box(Eye.of(client.camera.wxyz)))

    @property
    def framed_picture(self) -> Callable[[viser.ClientHandle], dict[str, Any]] | None:
        """Finds the picture's camera; the figure always has one of its own."""
        return self.picture

    def _caption(self, name: str, rollout: ObjectRollout) -> str:
        parameters, content = rollout.parameters, self._content
        is_metric = content is None or content.is_metric
        radius = parameters.virtual_connection_radius
        shown = f"{1e3 * radius:.3g} mm" if is_metric else f"{radius:.3g}"
        return (
            f"{name}\nδ {shown} · d_max {parameters.virtual_max_neighbors} · "
            f"{rollout.model.virtual_spring_count} virtual springs"
        )

    def _enter(self) -> None:
        content, run = self._content, self._run
        if content is None or content.fitted is None or run is None:
            return
        if self._rollout is None:
            self._rival = PhysTwinBaseline.of(content, content.fitted)
            chosen = tuple(int(control) for control in self._rival.controls)
            empty = ObjectRollout.empty(
                content.fitted.model,
                self._rival.parameters,
                np.asarray(content.fitted.control[:, list(chosen)]),
            )
            self._rollout = LiveRollouts(
                self._mailbox,
                self._live,
                empty,
                run=run,
                sequence=content.sequence_name,
                controls=chosen,
                on_change=self._hear,
            )
            self._rollout.request(self._rival.parameters, automatic_substeps=True)
        self._is_on = True
        self._button.label = _ON
        self._tell()
        self._text.visible = True
        for client in self._server.get_clients().values():
            self._aim(client, Pose.of(client.camera))

    def _leave(self) -> None:
        self._is_on = False
        self._button.label = _OFF
        self._text.visible = False
        self.cameras.restore(self._server)

    def _aim(self, client: viser.ClientHandle, pose: Pose) -> None:
        """Show the whole figure to a client."""
        figure = self._figure
        if figure is not None:
            eye = Eye.at(pose)
            self.cameras.aim(client, pose, figure.box(eye))
            figure.turn(eye)

    def _hear(self, kind: str, _: int) -> None:
        """Follow the rival's simulation; runs in the live simulation's thread."""
        rollout, figure, content = self._rollout, self._figure, self._content
        if rollout is None or figure is None or content is None or content.fitted is None:
            return
        if kind == "finished":
            figure.measure_forces(content.fitted, rollout.newest)
        elif kind in {"diverged", "failed"}:
            title = "The PhysTwin-style simulation stopped; its last good state is kept"
            notify(self._server, title, rollout.readout.error or "", seconds=12.0)
        self._tell()
        if self._is_on:
            self._redraw()

    def _tell(self) -> None:
        """Write below the button what the right half is and how far it is simulated."""
        rollout, rival = self._rollout, self._rival
        if rollout is None or rival is None:
            return
        readout = rollout.readout
        lines = [
            f"Right: the same object held by {rival.source}, virtual springs as in the profile "
            "phystwin.",
            f"PhysTwin-style: simulated {readout.simulated_count}/{readout.frame_count} frames",
        ]
        lines += [rival.note] if rival.note else []
        lines += [f"**Stopped:** {readout.error.splitlines()[0]}"] if readout.error else []
        self._text.content = "<br/>".join(lines)
