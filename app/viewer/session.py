"""One live session: a viser server with scene, panel and clock."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.clock.playback import TURN, Playback
from app.viewer.clock.restart_mark import RestartMark
from app.viewer.clock.timeline_panel import TimelinePanel
from app.viewer.color.color_panel import ColorPanel
from app.viewer.compare.live import LiveComparison
from app.viewer.content.camera_path import CameraPath
from app.viewer.content.content import (
    Content,
    ContentSource,
    open_run_content,
    open_sequence_content,
)
from app.viewer.content.layers import default_layers
from app.viewer.content.session_state import Kind, Pose, SessionState
from app.viewer.edit.edit_panel import EditPanel
from app.viewer.edit.selection import DrawnShape
from app.viewer.export.camera_path_panel import CameraPathPanel
from app.viewer.export.export_panel import ExportPanel
from app.viewer.export.snapshot import Snapshot
from app.viewer.inspect.inspector import Inspector, TakeClick
from app.viewer.live.client import SimulationClient
from app.viewer.physics.keep_panel import SavedRun, UserStorage, run_changes
from app.viewer.physics.object_session import FrameStrip, ObjectSession
from app.viewer.restoring import complete_state
from app.viewer.scene.framing import frame_content
from app.viewer.scene.layers_panel import LayersPanel, legend_of, set_theme
from app.viewer.scene.scene import SceneDrawing
from app.viewer.scene.scene_server import SceneServer
from app.viewer.steer.key_channel import KeyChannel
from app.viewer.steer.steer_panel import SteerPanel
from app.viewer.ui.keyboard import bind
from app.viewer.ui.tabs import TabName, Tabs
from physhandi.data.exporters.scene_data import read_skins
from physhandi.fitting.stored_take import StoredTake
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.parameters import parameter_changes
from physhandi.simulation.steering import SteeredMotion


class Session(SceneServer):
    """The scene of one browser tab: a viser server with scene, panel and clock."""

    def __init__(
        self,
        session_id: str,
        *,
        kind: Kind,
        target: str,
        owner: str,
        catalog: ContentSource,
        live: SimulationClient,
        state: SessionState | None = None,
        storage: UserStorage | None = None,
    ) -> None:
        """Open a run or a sequence; raises the catalog's errors before a server is started.

        Args:
            session_id: Unguessable id.
            kind: What `target` is the id of.
            target: Id of a run or a sequence.
            owner: Whose session it is.
            catalog: Finds runs and sequences.
            live: The process that simulates.
            state: What to begin with, such as the `state` of another session.
            storage: Where presets and runs are kept.
        """
        self.kind: Kind = kind
        self._target = target
        self.link_of: Callable[[Session], str] = lambda _: ""
        self._catalog = catalog
        self._live = live
        self._storage = storage
        self._has_played = False
        self._gone = threading.Event()
        self.keys = KeyChannel()
        """Tells which keys are held on the page."""
        self._names: tuple[str, ...] = ()
        if kind == "run":
            self._names = tuple(catalog.run(target).sequence_names)
        self._content = self._load(state.sequence_name if state is not None else None)
        state = None if state is None else complete_state(state, self._content)
        super().__init__(session_id, owner=owner, title=self._content.title)
        self._playback = Playback(self._content.frame_count, self._content.frame_rate, self._draw)
        self._object: ObjectSession | None = None
        self._steer: SteerPanel | None = None
        self._edit: EditPanel | None = None
        try:
            self._build()
            if state is not None:
                self._restore(state)
        except BaseException:
            self._server.stop()
            raise
        self._playback.start()

    @property
    def target(self) -> str:
        """Id of the run or the sequence."""
        return self._target

    @property
    def can_keep(self) -> bool:
        """Whether presets and runs may be kept from it."""
        return self._storage is not None

    @property
    def title(self) -> str:
        """Its name."""
        return self._content.title

    @property
    def state(self) -> SessionState:
        """Everything that the user has set, for a copy of this session."""
        with self._lock:
            history = self._object.panel.history if self._object is not None else None
            setting = history.setting if history is not None else None
            theme, prefers_dark = self._layers.theme
            return SessionState(
                sequence_name=self._content.sequence_name,
                frame=self._playback.frame,
                is_playing=self._playback.is_playing,
                speed=self._playback.speed,
                does_loop=self._playback.does_loop,
                part=self._playback.part,
                layers=replace(self._view.scene.layers),
                theme=theme,
                prefers_dark=prefers_dark,
                parameters=setting.parameters if setting is not None else None,
                automatic_substeps=setting is not None and setting.is_automatic,
                is_figure=self._comparison.is_figure,
                pose=self._comparison.pose(),
                camera_keys=() if self._path.path is None else self._path.path.keys,
                parameter_changes=parameter_changes(history.start, setting.parameters)
                if history is not None and setting is not None
                else {},
                edits=setting.edits
                if history is not None
                and setting is not None
                and setting.edits != history.begin.edits
                else None,
            )

    @property
    def offers(self) -> tuple[str, ...]:
        """Features that it has; see `SessionInfo`."""
        features = {
            "object": self._content.fitted is not None,
            "colors": self._colors.is_there,
            "figure": self._comparison.offers_figure,
            "recorded": any(view.has_color for view in self._content.views),
            "splats": self._content.splats is not None,
            "video": default_layers(self._content).looks_from is not None,
        }
        return tuple(name for name, is_there in features.items() if is_there)

    def snapshot(self) -> Snapshot:
        """Collect what is on the screen, to be saved."""
        run = self._catalog.run(self._target) if self.kind == "run" else None
        with self._lock:
            frame = self._playback.frame
            rollout, rollout_frame = self._rollout_at(frame)
            compared = None
            if rollout is not None:
                compared = self._comparison.rollouts(rollout, rollout_frame, frame)
            return Snapshot(
                content=self._content,
                frame=frame,
                rollout=rollout,
                rollout_frame=rollout_frame,
                compared=compared,
                picture=self._comparison.framed_picture,
                run=run,
                layers=replace(self._view.scene.layers),
                link="" if self.state.edits is not None else self.link_of(self),
            )

    @property
    def camera_path(self) -> CameraPath | None:
        """Path of a film's camera; None if it stands still."""
        return self._path.path

    def go(self, frame: int) -> None:
        """Stop at a frame."""
        self._timeline.go(frame)

    def prefer_dark(self, *, on: bool) -> None:
        """Follow the browser's color scheme, unless the user has chosen a background."""
        self._layers.prefer_dark(on=on)

    def close(self) -> None:
        """Stop clock, simulation and server."""
        self._begin_to_close()
        self._gone.set()
        self._playback.close()
        if self._steer is not None:
            self._steer.close()
        if self._edit is not None:
            self._edit.close()
        if self._object is not None:
            self._object.close()
        self._comparison.close()
        self._server.stop()
        self._content.close()

    def _load(self, sequence_name: str | None) -> Content:
        if self.kind == "run":
            return open_run_content(self._catalog, self._target, sequence_name)
        return open_sequence_content(self._catalog, self._target)

    def _build(self) -> None:
        server, guard = self._server, self._guard
        set_theme(server, dark=False)
        has_object = self._content.fitted is not None
        simulated: tuple[TabName, ...] = ("Physics", "Edit", "Steer") if has_object else ()
        tabs = self._tabs = Tabs(server.gui, "Play", "Look", *simulated, "Inspect", "Export")
        with tabs["Play"]:
            self._legend = server.gui.add_html("")
        if len(self._names) > 1:
            now = self._content.sequence_name
            choice = server.gui.add_dropdown("Sequence", self._names, initial_value=now)
            choice.on_update(guard.by_user(lambda _: self._switch(choice)))
        self._timeline = TimelinePanel(server, self._playback, guard, pace=tabs["Play"])
        self._restart = RestartMark(server, self._timeline.behind_slider)
        self._strip = FrameStrip(server, self._timeline.behind_slider + 0.1)
        with tabs["Play"]:
            self._comparison = LiveComparison(
                server,
                guard,
                self._live,
                self.id,
                newest=self._newest,
                redraw=self._playback.redraw,
                pixel_ratio=lambda: self.pixel_ratio,
            )
        with tabs["Look"]:
            self._colors = ColorPanel(
                server, guard, self._playback.redraw, color_instead=self._comparison.next_tint
            )
            self._layers = LayersPanel(server, guard, self._playback.redraw)
        with tabs["Inspect"]:
            self._inspector = Inspector(
                server,
                guard,
                self._playback.redraw,
                open_tab=lambda: tabs.open("Inspect"),
                instead=self._takes_clicks,
            )
        with tabs["Export"]:
            export = self._export = ExportPanel(server, guard, self.snapshot)
            self._path = CameraPathPanel(server, guard, lambda: self._playback.frame, self.go)
        bind(server, guard, "reset", lambda event, _: self._reset_view(event))
        bind(server, guard, "snapshot", lambda event, _: export.save("PNG", event.client))
        self._fill()
        server.on_client_connect(guard(self._welcome))
        server.on_client_disconnect(guard(self._part))

    def _fill(self) -> None:
        """Build what belongs to the content: scene, switches and physics."""
        content = self._content
        framing = frame_content(content)
        scene = SceneDrawing(self._server, content, framing)
        self._view = ViewSwitch(scene, self._comparison)
        self._layers.replace(content, scene.layers, framing)
        painter = scene.painter if content.fitted is not None else scene.hand_painter
        self._colors.replace(content, scene.layers, painter)
        self._inspector.replace(content, scene, framing)
        self._restart.replace(content)
        run = self._catalog.run(self._target) if self.kind == "run" else None
        self._export.offer(content)
        self._path.replace(framing.frustum)
        self._comparison.offer(content, framing, run.folder if run is not None else None)
        if content.fitted is None or run is None:
            return
        self._object = ObjectSession(
            self._server,
            self._guard,
            self._playback,
            tabs=self._tabs,
            session=self.id,
            live=self._live,
            content=content,
            fitted=content.fitted,
            run=run,
            strip=self._strip,
            storage=self._storage,
        )
        self._steer = SteerPanel(
            self._server,
            self._guard,
            self._playback,
            tabs=self._tabs,
            live=self._live,
            session=self.id,
            content=content,
            framing=framing,
            channel=self.keys,
            rollout_at=self._object.at,
            stop_comparing=self._comparison.stop,
            newtons=lambda: scene.painter.force_factor,
            skins=partial(read_skins, run, content.sequence_name),
            keep=None if self._storage is None else self._keep_motion,
        )
        self._edit = EditPanel(
            self._server,
            self._guard,
            self._playback,
            tabs=self._tabs,
            framing=framing,
            content=content,
            physics=self._object.panel,
            storage=self._storage,
            rollout_at=self._object.at,
            leave_others=self._leave_others,
        )

    def select(self, drawn: DrawnShape) -> None:
        """Select what is within a shape that somebody drew, if the object is being edited."""
        if self._edit is not None:
            self._edit.take_drawn(drawn)

    def _takes_clicks(self) -> TakeClick | None:
        """Give what selects what is clicked, while the object is edited."""
        edit = self._edit
        return edit.take_click if edit is not None and edit.is_on else None

    def _leave_others(self) -> None:
        """End what else takes the pointer or shows another object."""
        if self._steer is not None:
            self._steer.leave()
        self._comparison.stop()

    def _keep_motion(
        self, motion: SteeredMotion, frame: int, name: str, report: Callable[[SavedRun], None]
    ) -> None:
        """Have a run and a recording made of what was steered."""
        storage, fitted = self._storage, self._content.fitted
        if storage is None or fitted is None:
            return
        source = self._catalog.run(self._target)
        changes = run_changes(source, fitted.parameters, motion.parameters, is_automatic=False)
        stored = StoredTake(take=motion, sequence=self._content.sequence_name, frame=frame)
        run = storage.saver.save_take(self._target, stored, name, changes)
        storage.tell("keep a take", run)
        storage.saver.follow(run, report, self._gone)

    def _restore(self, state: SessionState) -> None:
        """Go on where another session stands."""
        self._has_played = True
        self._timeline.restore(state.speed, does_loop=state.does_loop, part=state.part)
        if state.layers is not None:
            self._layers.restore(state.layers, state.theme, prefers_dark=state.prefers_dark)
            self._colors.restore()
        if self._object is not None and state.parameters:
            self._object.panel.restore(
                state.parameters, is_automatic=state.automatic_substeps, edits=state.edits
            )
        self._path.take(state.camera_keys)
        if state.pose is not None:
            state.pose.give_first(self._server.initial_camera)
        if state.is_figure:
            self._comparison.toggle_figure()
        self._playback.hold()
        self._playback.seek(state.frame)
        self._playback.play(on=state.is_playing)

    def _switch(self, choice: viser.GuiDropdownHandle[str]) -> None:
        self._has_played = True
        sequence_name = choice.value
        content = self._load(sequence_name)
        with self._lock, self._server.atomic():
            if choice.value != sequence_name:  # Another one was chosen while this one was read.
                content.close()
                return
            self._playback.play(on=False)
            if self._edit is not None:
                self._edit.remove()
                self._edit = None
            if self._steer is not None:
                self._steer.remove()
                self._steer = None
            if self._object is not None:
                self._object.remove()
                self._object = None
            self._view.clear()
            self._content.close()
            self._content = content
            self._playback.replace(content.frame_count, content.frame_rate)
            self._timeline.replace(content.frame_count)
            self._fill()
            if self._view.scene.layers.looks_from is not None:
                for client in self._server.get_clients().values():
                    self._layers.place(client)
        self._playback.play()

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Start playing when the first client is there, and follow its camera."""
        self._seen = time.monotonic()
        # At once: a user who is quick may have stopped the clock before the rest is done.
        if not self._has_played:
            self._has_played = True
            self._playback.play(on=self._content.plays_at_once)
        self._playback.release()
        self._let_in(client, self._comparison)

    def _reset_view(self, event: Any) -> None:
        if not self._comparison.reset_view(event.client):
            self._layers.reset_view(event)

    def _forget(self, client: viser.ClientHandle) -> Pose:
        if self._steer is not None and not self._server.get_clients():
            self._steer.leave()  # Nobody is left to steer.
        return self._comparison.part(client)

    def _draw(self, frame: int, is_playing: bool) -> None:
        with self._lock, TURN:
            if self._steer is not None and self._comparison.is_on:
                self._steer.leave()  # Two rollouts are shown on the clock.
            steered = None if self._steer is None else self._steer.shown()
            if self._edit is not None and (steered is not None or self._comparison.is_on):
                self._edit.leave()
            if steered is None:
                rollout, rollout_frame = self._rollout_at(frame)
                self._view.draw(frame, rollout, rollout_frame, is_playing=is_playing)
            else:
                rollout, rollout_frame, hands = steered
                self._view.draw(frame, rollout, rollout_frame, is_playing=True, hands=hands)
            self._path.follow(frame)
            self._timeline.show(is_playing=is_playing)
            self._restart.follow(rollout)
            is_hidden = self._comparison.is_on and rollout is not None
            if self._edit is not None and rollout is not None:
                self._edit.show(rollout, rollout_frame, is_hidden=is_hidden)
            if self._legend.visible == is_hidden:
                self._legend.visible = not is_hidden
            written = legend_of(self._content, self._view.scene.layers)
            if self._legend.content != written:
                self._legend.content = written
            self._colors.show(is_playing=is_playing, is_hidden=is_hidden)
            if steered is None:
                self._inspector.show(
                    rollout, frame, rollout_frame, is_playing=is_playing, is_hidden=is_hidden
                )
            elif self._steer is not None and rollout is not None:
                steer = self._steer
                self._inspector.rest(
                    rollout, rollout_frame, steer.grab, steer.dots, steer.choose_dot
                )
            if self._object is not None:
                self._object.show(frame, is_playing=is_playing)
        self._server.flush()  # viser would wait for more, up to 17 ms.

    def _newest(self) -> ObjectRollout | None:
        """Find the rollout that was asked for last, as far as it is there."""
        return self._object.newest if self._object is not None else self._content.fitted

    def _rollout_at(self, frame: int) -> tuple[ObjectRollout | None, int]:
        """Find the rollout to show in a frame, and which of its frames."""
        if self._object is not None:
            return self._object.at(frame)
        fitted = self._content.fitted
        return fitted, frame if fitted is None else min(frame, fitted.ready - 1)


class ViewSwitch:
    """Draws the scene or a comparison, and hides the other; used by the clock."""

    def __init__(self, scene: SceneDrawing, comparison: LiveComparison) -> None:
        self.scene = scene
        self._comparison = comparison
        self._shown: SceneDrawing | LiveComparison = scene

    def draw(
        self,
        frame: int,
        rollout: ObjectRollout | None,
        rollout_frame: int,
        *,
        is_playing: bool,
        hands: Mapping[str, Float[ndarray, "vertex 3"]] | None = None,
    ) -> None:
        """Bring what is seen to a frame.

        Args:
            frame: Frame of hands, observation and cameras.
            rollout: The object's rollout; None without an object.
            rollout_frame: Frame of the rollout, which may lag behind while it is being computed.
            is_playing: Whether the clock is running.
            hands: Where hands are that are steered [m]; see `SceneDrawing.draw`.
        """
        shown = self._comparison if self._comparison.is_on and rollout is not None else self.scene
        if shown is not self._shown:
            self._shown.hide()
            self._shown = shown
        if isinstance(shown, SceneDrawing):
            shown.draw(frame, rollout, rollout_frame, is_playing=is_playing, hands=hands)
        elif rollout is not None:
            layers = self.scene.layers
            shown.draw(rollout, rollout_frame, frame, layers, is_playing=is_playing)

    def clear(self) -> None:
        """Remove everything, to make room for another content."""
        self._comparison.close()
        self.scene.clear()
