"""A live session that shows two runs together, on one clock and for one camera."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from app.viewer.clock.playback import TURN, Playback
from app.viewer.clock.timeline_panel import TimelinePanel
from app.viewer.compare.camera import ComparisonCameras
from app.viewer.compare.drawing import Look
from app.viewer.compare.pair import open_pair, pairing_of
from app.viewer.compare.request import CompareAsk
from app.viewer.compare.sides import SIDE_KEYS, ComparedSide, Sides, compared_rollouts
from app.viewer.compare.view import CompareView
from app.viewer.content.content import Content, ContentSource
from app.viewer.content.layers import Layers, default_layers
from app.viewer.content.session_state import Kind, Pose, SessionState
from app.viewer.export.export_panel import ExportPanel
from app.viewer.export.snapshot import Snapshot
from app.viewer.scene.framing import Framing, frame_content
from app.viewer.scene.layers_panel import LayersPanel, set_theme
from app.viewer.scene.scene_server import SceneServer
from app.viewer.ui.guard import without_markup
from app.viewer.ui.keyboard import bind
from app.viewer.ui.tabs import Tabs


class CompareSession(SceneServer):
    """Live scene that compares two runs, in one viser server with one panel and clock."""

    kind: Kind = "comparison"

    def __init__(
        self,
        session_id: str,
        *,
        target: str,
        owner: str,
        catalog: ContentSource,
        state: SessionState | None = None,
    ) -> None:
        """Open both runs; raises the catalog's errors before a server is started.

        Args:
            session_id: Unguessable id.
            target: Query of a `CompareAsk`.
            owner: Whose session it is.
            catalog: Finds the runs.
            state: What to begin with, as `state` of another session told it.
        """
        self._ask = CompareAsk.parse(target)
        self._pair = open_pair(catalog, self._ask)
        self._has_played = False
        self._cameras = ComparisonCameras(lambda: self.pixel_ratio)
        super().__init__(session_id, owner=owner, title=self._pair.title)
        clock = self._pair.clock
        self._playback = Playback(clock.tick_count, clock.rate, self._draw)
        try:
            self._build()
            self._restore(state)
        except BaseException:
            self._server.stop()
            raise
        self._playback.start()

    @property
    def target(self) -> str:
        """Query of what is shown now, for ``/compare?…``."""
        look = self._view.look
        now = {"mode": look.mode, "color": look.tint, "f": self._playback.frame}
        return self._ask.model_copy(update=now).query

    @property
    def title(self) -> str:
        """The names of both runs."""
        return self._pair.title

    @property
    def state(self) -> SessionState:
        """Settings of the user besides `target`, for a copy of this session."""
        theme, prefers_dark = self._layers_panel.theme
        clients = list(self._server.get_clients().values())
        return SessionState(
            sequence_name=self._pair.contents[0].sequence_name,
            frame=self._playback.frame,
            is_playing=self._playback.is_playing,
            speed=self._playback.speed,
            does_loop=self._playback.does_loop,
            part=self._playback.part,
            layers=replace(self._layers),
            theme=theme,
            prefers_dark=prefers_dark,
            parameters=None,
            automatic_substeps=False,
            is_figure=False,
            pose=self._cameras.before(clients[0]) if clients else None,
        )

    @property
    def link(self) -> str:
        """Address on this server that shows the same."""
        return f"/compare?{self.target}"

    def go(self, frame: int) -> None:
        """Stop at a frame."""
        self._timeline.go(frame)

    def prefer_dark(self, *, on: bool) -> None:
        """Follow the browser's color scheme, unless the user has chosen a background."""
        self._layers_panel.prefer_dark(on=on)

    def snapshot(self) -> Snapshot:
        """Collect what is on the screen, for the export panel."""
        with self._lock:
            tick = self._playback.frame
            sides = self._sides(tick)
            first = sides["a"]
            return Snapshot(
                content=first.content,
                frame=first.content_frame,
                rollout=first.rollout,
                rollout_frame=first.frame,
                compared=compared_rollouts(sides),
                picture=self._view.picture(),
                layers=replace(self._layers),
                link=self.link,
            )

    def close(self) -> None:
        """Stop clock, measuring and server."""
        self._begin_to_close()
        self._playback.close()
        self._view.curve.close()
        self._server.stop()
        for content in self._pair.contents:
            content.close()

    def _build(self) -> None:
        server, guard, pair = self._server, self._guard, self._pair
        set_theme(server, dark=False)
        shown = replace(pair.contents[0], views=())
        framing = frame_content(shown)
        self._layers = _first_layers(shown)
        _place_first(server, framing)
        rollouts = [content.fitted for content in pair.contents if content.fitted is not None]
        tabs = Tabs(server.gui, "Play", "Look", "Export")
        self._timeline = TimelinePanel(server, self._playback, guard, pace=tabs["Play"])
        with tabs["Play"]:
            self._view = CompareView(
                server,
                guard,
                content=shown,
                framing=framing,
                rollouts=rollouts,
                cameras=self._cameras,
                look=Look(mode=self._ask.mode, tint=self._ask.color),
                redraw=self._playback.redraw,
            )
        with tabs["Look"]:
            self._layers_panel = LayersPanel(server, guard, self._playback.redraw)
        self._layers_panel.replace(shown, self._layers, framing)
        with tabs["Export"]:
            export = ExportPanel(server, guard, self.snapshot)
        bind(server, guard, "color", lambda _, __: self._view.panel.next_tint(1))
        bind(server, guard, "color_back", lambda _, __: self._view.panel.next_tint(-1))
        bind(server, guard, "reset", lambda event, _: self._reset_view(event))
        bind(server, guard, "snapshot", lambda event, _: export.save("PNG", event.client))
        names = {
            side: without_markup(c.title) for side, c in zip(SIDE_KEYS, pair.contents, strict=True)
        }
        unit = pair.contents[0].length_unit
        self._view.panel.name(names, pair.notes, unit=unit, tick_count=pair.clock.tick_count)
        self._view.follow(pairing_of(pair))
        server.on_client_connect(guard(self._welcome))
        server.on_client_disconnect(guard(self._part))

    def _restore(self, state: SessionState | None) -> None:
        """Go to the frame that is asked for, or on where another session stands."""
        self._playback.seek(self._ask.f)
        self._has_played = self._ask.f > 0
        if state is None:
            return
        self._has_played = True
        self._timeline.restore(state.speed, does_loop=state.does_loop, part=state.part)
        if state.layers is not None:
            self._layers_panel.restore(state.layers, state.theme, prefers_dark=state.prefers_dark)
        if state.pose is not None:
            state.pose.give_first(self._server.initial_camera)
        self._playback.hold()
        self._playback.play(on=state.is_playing)

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Start playing when the first client is there, and follow its camera."""
        self._seen = time.monotonic()
        # At once: a user who is quick may have stopped the clock before the rest is done.
        if not self._has_played:
            self._has_played = True
            self._playback.play()
        self._playback.release()
        self._let_in(client, self._view)

    def _reset_view(self, event: Any) -> None:
        if not self._view.reset_view(event.client):
            self._layers_panel.reset_view(event)

    def _forget(self, client: viser.ClientHandle) -> Pose:
        return self._cameras.forget(client)

    def _draw(self, tick: int, is_playing: bool) -> None:
        with self._lock, TURN:
            self._view.draw(tick, self._sides(tick), self._layers, is_playing=is_playing)
            self._timeline.show(is_playing=is_playing)

    def _sides(self, tick: int) -> Sides:
        frames = self._pair.clock.frames(tick)
        parts = zip(SIDE_KEYS, self._pair.contents, frames, strict=True)
        return {key: _side(key, content, frame) for key, content, frame in parts}


def _side(key: str, content: Content, frame: int) -> ComparedSide:
    rollout = content.fitted
    detail = "no object"
    if rollout is not None:
        detail = f"{rollout.model.node_count} nodes · frame {frame}"
    return ComparedSide(
        name=key,
        title=f"{key.upper()} · {content.title}",
        detail=detail,
        rollout=rollout,
        frame=min(frame, rollout.ready - 1) if rollout is not None else 0,
        content=content,
        content_frame=frame,
    )


def _first_layers(content: Content) -> Layers:
    """Show objects and hands; what holds the object would hide how two of them differ."""
    return replace(
        default_layers(content),
        controls=False,
        virtual_springs=False,
        forces=False,
        cameras=False,
        looks_from=None,
    )


def _place_first(server: viser.ViserServer, framing: Framing) -> None:
    """Put the cameras of new clients where everything is seen."""
    camera = server.initial_camera
    camera.near, camera.far = 0.005 * framing.extent, 200.0 * framing.extent
    up = np.array([0.0, 0.0, 1.0])
    first = Pose(position=framing.camera, look_at=framing.look_at, up=up, fov=framing.fov)
    first.give_first(camera)
