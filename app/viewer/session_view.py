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
from app.viewer.figure_mode import FigureMode
from app.viewer.framing import frame_content
from app.viewer.guard import Guard, plain
from app.viewer.live import LiveSimulation
from app.viewer.object_session import ObjectSession
from app.viewer.panels import LayersPanel, TimelinePanel, add_legend, set_theme
from app.viewer.playback import Playback
from app.viewer.scene import Scene
from app.viewer.take import Take

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
        self._object: ObjectSession | None = None
        self._is_figure_shown = False
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
        if self._object is not None:
            self._object.close()
        self._figure.close()
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
        self._figure = FigureMode(server, guard, self._live, self.id, self._playback.redraw)
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
        run = self._catalog.run(self.target).folder if self.kind == "run" else None
        self._figure.offer(content, framing, run)
        if content.fitted is None or run is None:
            return
        with self._physics_place:
            self._object = ObjectSession(
                self._server,
                self._guard,
                self._playback,
                session=self.id,
                live=self._live,
                content=content,
                fitted=content.fitted,
                run=run,
            )

    def _switch(self, sequence_name: str) -> None:
        content = self._load(sequence_name)
        with self._lock, self._server.atomic():
            self._playback.play(on=False)
            if self._object is not None:
                self._object.remove()
                self._object = None
            self._figure.close()
            self._is_figure_shown = False
            self._scene.clear()
            self._content = content
            self._playback.replace(content.frame_count, content.frame_rate)
            self._timeline.replace(content.frame_count)
            self._fill()
        self._playback.play()

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Start playing when the first client is there, and follow its camera."""
        self._seen = time.monotonic()
        self._figure.welcome(client)
        client.camera.on_update(self._guard(lambda _: self._figure.turn(client)))
        if not self._has_played:
            self._has_played = True
            self._playback.play()

    def _draw(self, frame: int, is_playing: bool) -> None:
        with self._lock:
            take, take_frame = self._take(frame)
            is_figure = self._figure.is_on and take is not None
            if is_figure != self._is_figure_shown:
                (self._scene if is_figure else self._figure).hide()
                self._is_figure_shown = is_figure
            if is_figure and take is not None:
                self._figure.draw(
                    take, take_frame, frame, self._scene.layers, is_playing=is_playing
                )
            else:
                self._scene.draw(frame, take, take_frame, is_playing=is_playing)
            self._timeline.show(frame, is_playing=is_playing)

    def _take(self, frame: int) -> tuple[Take | None, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        if self._object is not None:
            return self._object.at(frame)
        fitted = self._content.fitted
        return fitted, frame if fitted is None else min(frame, fitted.ready - 1)

    def _snapshot(self) -> Snapshot:
        with self._lock:
            frame = self._playback.frame
            take, take_frame = self._take(frame)
            is_figure = self._figure.is_on and take is not None
            sides = self._figure.sides(take, take_frame, frame) if is_figure and take else None
            picture = self._figure.picture if is_figure else None
            return Snapshot(
                content=self._content,
                frame=frame,
                take=take,
                take_frame=take_frame,
                sides=sides,
                picture=picture,
            )


def _start_server(label: str) -> viser.ViserServer:
    rich.get_console().quiet = True  # viser would print its loopback address, which misleads.
    server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
    # Any client could ask for a public tunnel with this message.
    infrastructure: Any = server._websock_server  # pyright: ignore[reportPrivateUsage]  # no other way
    infrastructure.unregister_handler(messages.ShareUrlRequest)
    return server
