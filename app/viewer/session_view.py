"""One live session: a viser server with scene, panel and clock."""

import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

import rich
import viser
import viser._messages as messages

from app.viewer.content import Catalog, Content, open_run, open_sequence
from app.viewer.export_panel import ExportPanel, Snapshot
from app.viewer.framing import frame_content
from app.viewer.guard import Guard, notify, plain
from app.viewer.live import LiveSimulation
from app.viewer.panels import LayersPanel, TimelinePanel, add_legend, set_theme
from app.viewer.physics_panel import PhysicsPanel
from app.viewer.playback import Playback
from app.viewer.resimulation import Resimulation
from app.viewer.scene import Scene
from physhandi.simulation.model import SimulationParameters

Kind = Literal["run", "sequence"]


@dataclass(frozen=True, kw_only=True)
class SessionInfo:
    """What a listing says about a session."""

    id: str
    """Unguessable id, part of its address."""
    kind: Kind
    """Whether a run or a sequence is shown."""
    target: str
    """Id of the run or the sequence."""
    owner: str
    """Who opened it."""
    title: str
    """Name of what is shown."""
    client_count: int
    """Browsers that look at it."""
    created: float
    """When it was opened [s since 1970]."""
    idle: float
    """How long nobody has looked at it [s]."""


class Session:
    """What one browser tab looks at: a viser server with scene, panel and clock."""

    def __init__(
        self,
        session_id: str,
        *,
        kind: Kind,
        target: str,
        owner: str,
        catalog: Catalog,
        live: LiveSimulation,
    ) -> None:
        """Open a run or a sequence; raises the catalog's errors before a server is started."""
        self.id = session_id
        self.kind: Kind = kind
        self.target = target
        self.owner = owner
        self.created = time.time()
        self._catalog = catalog
        self._live = live
        self._seen = time.monotonic()
        self._has_played = False
        self._names: tuple[str, ...] = ()
        if kind == "run":
            self._names = tuple(catalog.run(target).sequence_names)
        self._content = self._load(None)
        self._lock = threading.RLock()
        self._server = _start_server(plain(self._content.title))
        self._guard = Guard(self._server)
        self._playback = Playback(self._content.frame_count, self._content.frame_rate, self._draw)
        self._physics: PhysicsPanel | None = None
        self._resimulation: Resimulation | None = None
        try:
            self._build()
        except BaseException:
            self._server.stop()
            raise
        self._playback.start()

    @property
    def port(self) -> int:
        """Loopback port of the viser server."""
        return self._server.get_port()

    @property
    def info(self) -> SessionInfo:
        """What a listing says about it."""
        return SessionInfo(
            id=self.id,
            kind=self.kind,
            target=self.target,
            owner=self.owner,
            title=self._content.title,
            client_count=len(self._server.get_clients()),
            created=self.created,
            idle=self.idle,
        )

    @property
    def idle(self) -> float:
        """How long nobody has looked at it [s]."""
        if self._server.get_clients():
            self._seen = time.monotonic()
        return time.monotonic() - self._seen

    def close(self) -> None:
        """Stop clock, simulation and server."""
        self._playback.close()
        if self._resimulation is not None:
            self._resimulation.close()
        self._server.stop()
        for view in self._content.views:
            view.close()

    def _load(self, sequence_name: str | None) -> Content:
        if self.kind == "run":
            return open_run(self._catalog, self.target, sequence_name)
        return open_sequence(self._catalog, self.target)

    def _build(self) -> None:
        server, guard = self._server, self._guard
        set_theme(server, dark=False)
        add_legend(server, self._content)
        if len(self._names) > 1:
            choice = server.gui.add_dropdown("Sequence", self._names)
            choice.on_update(guard.by_user(lambda event: self._switch(event.target.value)))
        self._timeline = TimelinePanel(server, self._playback, guard)
        self._physics_place = server.gui.add_folder(None)
        self._layers = LayersPanel(server, self._content, guard, self._playback.redraw)
        ExportPanel(server, guard, self._snapshot)
        self._fill()
        server.on_client_connect(guard(self._welcome))

    def _fill(self) -> None:
        """Build what belongs to the content: scene, switches and physics."""
        content = self._content
        framing = frame_content(content)
        self._scene = Scene(self._server, content, framing)
        self._layers.replace(content, self._scene.layers, framing)
        if content.fitted is None or self.kind != "run":
            return
        self._resimulation = Resimulation(
            self.id,
            self._live,
            content.fitted,
            run=self._catalog.run(self.target).folder,
            sequence=content.sequence_name,
            on_change=self._hear,
        )
        with self._physics_place:
            self._physics = PhysicsPanel(
                self._server, content, content.fitted, self._guard, self._simulate
            )
        self._physics.show(self._resimulation.readout, at_once=True)

    def _switch(self, sequence_name: str) -> None:
        content = self._load(sequence_name)
        with self._lock, self._server.atomic():
            self._playback.play(on=False)
            if self._resimulation is not None:
                self._resimulation.close()
                self._resimulation = None
            if self._physics is not None:
                self._physics.remove()
                self._physics = None
            self._scene.clear()
            self._content = content
            self._playback.replace(content.frame_count, content.frame_rate)
            self._timeline.replace(content.frame_count)
            self._fill()
        self._playback.play()

    def _welcome(self, _: Any) -> None:
        """Start playing when the first client is there."""
        self._seen = time.monotonic()
        if not self._has_played:
            self._has_played = True
            self._playback.play()

    def _draw(self, frame: int, is_playing: bool) -> None:
        with self._lock:
            take, take_frame = None, frame
            if self._resimulation is not None:
                take, take_frame = self._resimulation.at(frame)
            elif self._content.fitted is not None:
                take = self._content.fitted
                take_frame = min(frame, take.ready - 1)
            self._scene.draw(frame, take, take_frame, is_playing=is_playing)
            self._timeline.show(frame, is_playing=is_playing)

    def _snapshot(self) -> Snapshot:
        with self._lock:
            frame = self._playback.frame
            take, take_frame = self._content.fitted, frame
            if self._resimulation is not None:
                take, take_frame = self._resimulation.at(frame)
            return Snapshot(self._content, frame, take, take_frame)

    def _simulate(self, parameters: SimulationParameters, automatic_substeps: bool) -> None:
        resimulation, content, physics = self._resimulation, self._content, self._physics
        if resimulation is None or content.fitted is None or physics is None:
            return
        if parameters == content.fitted.parameters and not automatic_substeps:
            resimulation.show_fitted()
        else:
            resimulation.request(parameters, automatic_substeps=automatic_substeps)
            physics.show(resimulation.readout, at_once=True)

    def _hear(self, kind: str, ready: int) -> None:
        """Follow the live simulation; runs in its thread."""
        resimulation, physics = self._resimulation, self._physics
        if resimulation is None or physics is None:
            return
        readout = resimulation.readout
        physics.show(readout, at_once=kind != "frame")
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
            self._apologise(is_retried=readout.is_busy)

    def _follow(self, ready: int) -> None:
        """Let the running clock follow the frames that are ready, from the first one on."""
        playback = self._playback
        if playback.is_playing:
            playback.limit(ready)
            if ready == 1:
                playback.seek(0)
        elif playback.frame == ready - 1:
            playback.redraw()

    def _apologise(self, *, is_retried: bool) -> None:
        then = "Simulating again." if is_retried else "Move a slider to simulate again."
        notify(
            self._server, "The live simulation stopped and was started anew", then, color="orange"
        )


def _start_server(label: str) -> viser.ViserServer:
    rich.get_console().quiet = True  # viser would print its loopback address, which misleads.
    server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
    # Any client could ask for a public tunnel with this message.
    infrastructure: Any = server._websock_server  # pyright: ignore[reportPrivateUsage]  # no other way
    infrastructure.unregister_handler(messages.ShareUrlRequest)
    return server
