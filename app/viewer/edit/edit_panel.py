"""Editing: the mode that a key switches, what is selected in it, and what is done to that."""

import html
import math
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import numpy as np
import viser
from numpy import ndarray

from app.viewer.clock.playback import Playback
from app.viewer.content.content import Content
from app.viewer.edit.edit_preset_panel import EditPresetPanel
from app.viewer.edit.selection import (
    Cover,
    DrawnShape,
    Highlights,
    Polygon,
    ScreenView,
    Selection,
    SelectKind,
    SelectWay,
    Stroke,
    all_of,
    ends_of,
    of_springs,
    only,
    select,
    springs_between,
)
from app.viewer.physics.keep_panel import UserStorage
from app.viewer.physics.panel import PhysicsPanel
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind
from app.viewer.ui.tabs import Tabs
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.edits import (
    AnyEdit,
    Attach,
    Cut,
    Edits,
    Join,
    NodePair,
    Pin,
    Release,
    ScaleMaterial,
    apply_edits,
)

SELECTED = (255, 122, 0)
"""Color of what is selected."""
_OFFERED = (120, 128, 140)
"""Color of what can be selected."""
_START, _STOP = "Edit (B)", "Back to playback (B)"
_RECTANGLE, _LASSO, _BRUSH = "rectangle", "lasso", "brush"
_ALL, _INVERT, _NOTHING = "All", "Invert", "Nothing"
_STIFFNESS, _DAMPING = "Stiffness", "Damping"
_CUT, _JOIN = "Cut", "Join"
_PIN, _ATTACH, _RELEASE = "Pin", "Attach", "Release"
_PART_OF_SURFACE = 0.25
"""Depth behind the surface to which nodes still belong to it, in distances of nodes."""
_FACTORS = (0.001, 1000.0)
_MODIFIERS: dict[str | None, SelectWay] = {None: "replace", "shift": "add", "cmd/ctrl": "remove"}
_STYLE = "font-size:0.85em;line-height:1.5;padding:0.2em 0.9em 0.5em"
_HOW = (
    "Select nodes or springs in the scene and change them; every change is one step that Ctrl Z "
    "takes back."
)
_HOW_NOW = (
    "Drag in the scene, or click; <b>shift</b> adds, <b>ctrl</b> takes out. The right "
    "button still moves the camera."
)


class EditPanel:
    """Edits the object of one content; controls, pointer and clock come in different threads."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        playback: Playback,
        *,
        tabs: Tabs,
        framing: Framing,
        content: Content,
        physics: PhysicsPanel,
        storage: UserStorage | None,
        rollout_at: Callable[[int], tuple[ObjectRollout, int]],
        leave_others: Callable[[], None],
    ) -> None:
        """Add the tab's controls.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            playback: The session's clock.
            tabs: Where the controls go.
            framing: Sizes.
            content: What is shown; behind its surface things can be left out.
            physics: Keeps the edits with its parameters, and has them simulated.
            storage: Where edits are kept under a name; None where nothing can be kept.
            rollout_at: Finds the rollout of a frame, and which of its frames.
            leave_others: Ends what else takes the pointer or shows another object.
        """
        self._server = server
        self._guard = guard
        self._playback = playback
        self._tabs = tabs
        self._spacing = framing.spacing
        self._surface = content.surface
        self._physics = physics
        self._rollout_at = rollout_at
        self._leave_others = leave_others
        self._lock = threading.RLock()
        self._nodes = SceneNodes(server)
        self._selection = Selection()
        self._highlights = Highlights()
        self._is_on = False
        self._sign = server.gui.add_html("")
        self._callbacks: list[Callable[[viser.SceneRectSelectEvent], None]] = []
        self._presets: EditPresetPanel | None = None
        self._add_controls(server.gui)
        if storage is not None and content.fitted is not None:
            with self._folder:
                self._presets = EditPresetPanel(
                    server.gui,
                    guard,
                    physics,
                    fitted=content.fitted,
                    recording=content.sequence_name,
                    storage=storage,
                )
        self._commands = bind(server, guard, "edit", lambda _, __: self.toggle())
        self._write()

    def _add_controls(self, gui: viser.GuiApi) -> None:
        guard = self._guard
        with self._tabs["Edit"]:
            self._folder = gui.add_folder(None)
        with self._folder:
            self._button = gui.add_button(_START, hint="B")
            self._status = gui.add_html("")
            self._tool: Any = gui.add_dropdown(
                "Tool", (_RECTANGLE, _LASSO, _BRUSH), hint="What a drag in the scene draws"
            )
            self._radius: Any = gui.add_slider(
                "Brush [%]",
                1.0,
                20.0,
                0.5,
                4.0,
                visible=False,
                hint="Radius of the brush, as a part of the height of the scene",
            )
            self._kind: Any = gui.add_dropdown(
                "Select", get_args(SelectKind), hint="What a rectangle or a click selects"
            )
            self._only_seen: Any = gui.add_checkbox(
                "Only what is seen",
                False,
                hint="Leaves out what lies behind the object's own surface",
                visible=self._surface is not None,
            )
            self._factor: Any = gui.add_number(
                "Factor",
                0.5,
                min=_FACTORS[0],
                max=_FACTORS[1],
                step=0.1,
                hint="What stiffness or damping is multiplied by",
            )
            groups = (
                ("Selection", (_ALL, _INVERT, _NOTHING), "Of what Select says"),
                (
                    "Multiply",
                    (_STIFFNESS, _DAMPING),
                    "Of the selected springs, or of those between selected nodes",
                ),
                (
                    "Springs",
                    (_CUT, _JOIN),
                    "Cut the selected springs, or those between selected nodes; join each selected "
                    "node to the nearest other one that it has no spring to",
                ),
                (
                    "Nodes",
                    (_PIN, _ATTACH, _RELEASE),
                    "From the frame on the screen on: hold nodes where they are, tie them to the "
                    "nearest point of the hand, or let hands and pins go",
                ),
            )
            for label, options, hint in groups:
                buttons = gui.add_button_group(label, options, hint=hint)
                buttons.on_click(guard(lambda event: self._press(event.target.value)))
            self._list = gui.add_html("")
        self._button.on_click(guard(lambda _: self.toggle()))
        self._tool.on_update(guard.by_user(lambda _: self._choose_tool()))
        self._radius.on_update(guard.by_user(lambda _: self._choose_tool()))
        self._kind.on_update(guard.by_user(lambda _: self._choose_kind()))

    @property
    def is_on(self) -> bool:
        """Whether the pointer selects."""
        return self._is_on

    @property
    def selection(self) -> Selection:
        """The selection."""
        return self._selection

    def toggle(self) -> None:
        """Let the pointer select, or return to playback."""
        if self.is_on:
            self.leave()
        else:
            self._enter()

    def leave(self) -> None:
        """Return to playback, with nothing selected."""
        with self._lock:
            if not self._is_on:
                return
            self._is_on = False
            self._selection = Selection()
            self._choose_tool()
            self._nodes.clear()
            self._write()

    def take_click(
        self, event: viser.SceneClickEvent, node: int | None, spring: int | None
    ) -> None:
        """Select what was clicked.

        Args:
            event: The click.
            node: Number of the node that it met, if it was one.
            spring: Place of the spring that it met in the model's list, if it was one.
        """
        with self._lock:
            if not self._is_on:
                return
            rollout, _ = self._shown()
            new = self._clicked(rollout, node, spring)
            if new or event.modifier is None:
                way: SelectWay = "toggle" if event.modifier == "shift" else "replace"
                self._selection = self._selection.changed(new, way)
        self._show_selection()

    def show(self, rollout: ObjectRollout, frame: int, *, is_hidden: bool) -> None:
        """Follow the clock: draw what can be selected, and what is.

        Args:
            rollout: The rollout that is drawn.
            frame: Which frame of it.
            is_hidden: Whether something else is shown instead of the scene.
        """
        with self._lock:
            self._write_list()
            if not self._is_on:
                return
            if is_hidden:
                self._nodes.hide()
                return
            present = self._selection.within(rollout.model)
            if present != self._selection:
                self._selection = present
                self._write()
            self._draw(rollout, frame)

    def remove(self) -> None:
        """Take the tab's controls away."""
        self.leave()
        self.close()
        for command in self._commands:
            command.remove()
        self._folder.remove()
        self._sign.remove()

    def close(self) -> None:
        """Stop listening to what others keep."""
        if self._presets is not None:
            self._presets.close()

    def _enter(self) -> None:
        self._playback.play(on=False)
        self._leave_others()
        with self._lock:
            if self._is_on:
                return
            self._is_on = True
            self._choose_tool()
            self._write()
        self._tabs.open("Edit")
        self._playback.redraw()

    def _shown(self) -> tuple[ObjectRollout, int]:
        """Find what is on the screen."""
        return self._rollout_at(self._playback.frame)

    def _take_rectangle(self, event: viser.SceneRectSelectEvent, way: SelectWay) -> None:
        shape = Polygon.rectangle(event.screen_min, event.screen_max)
        self._take_shape(ScreenView.of(event.client.camera), shape, way)

    def take_drawn(self, drawn: DrawnShape) -> None:
        """Select what is within what the page tells that somebody drew."""
        client = next(iter(self._server.get_clients().values()), None)
        if client is not None:
            self._take_shape(ScreenView.of(client.camera), drawn.shape, drawn.way)

    def _take_shape(self, eye: ScreenView, shape: Polygon | Stroke, way: SelectWay) -> None:
        """Select what is within a shape that was drawn."""
        with self._lock:
            if not self._is_on:
                return
            rollout, frame = self._shown()
            cover = self._cover(rollout, frame) if self._only_seen.value else None
            selected = select(eye, shape, rollout, frame, self._kind.value, cover=cover)
            self._selection = self._selection.changed(selected, way)
        self._show_selection()

    def _cover(self, rollout: ObjectRollout, frame: int) -> Cover | None:
        """Find what keeps the view of the object's other side: its own surface."""
        surface = self._surface
        if surface is None or surface.node_count != rollout.model.node_count:
            return None
        # Nodes of a rope are in its middle.
        radius = 0.0 if surface.tube is None else surface.tube.radius
        depth = _PART_OF_SURFACE * self._spacing + 2.0 * radius
        vertex = surface.place(np.asarray(rollout.position[frame]))
        return Cover(vertex=vertex, face=surface.face, depth=depth)

    def _clicked(self, rollout: ObjectRollout, node: int | None, spring: int | None) -> Selection:
        """Give what a click selects: one thing, the ends of a spring, or the springs of a node."""
        model, kind = rollout.model, self._kind.value
        if spring is not None:
            if kind != "nodes":
                return of_springs(model, np.array([spring]))
            ends = model.spring_nodes[spring]
            return Selection(nodes=frozenset(int(end) for end in ends if end < model.node_count))
        if node is None:
            return Selection()
        if kind == "nodes":
            return Selection(nodes=frozenset({node}))
        chosen = np.flatnonzero((model.spring_nodes == node).any(axis=1))
        return only(of_springs(model, chosen), kind)

    def _choose_tool(self) -> None:
        """Let viser draw rectangles, and our part of the page lassos and strokes, or nothing."""
        with self._lock:
            tool = self._tool.value
            scene: Any = self._server.scene
            self._radius.visible = tool == _BRUSH
            for callback in self._callbacks:
                scene.remove_rect_select_callback(callback)
            self._callbacks.clear()
            if self._is_on and tool == _RECTANGLE:
                for modifier, way in _MODIFIERS.items():
                    callback = self._guard(partial(self._take_rectangle, way=way))
                    self._callbacks.append(callback)
                    scene.on_rect_select(modifier=modifier)(callback)
            draws = self._is_on and tool != _RECTANGLE
            radius = 0.01 * float(self._radius.value)
            self._sign.content = (
                f'<i hidden data-draws="{tool}" data-radius="{radius:.4g}"></i>' if draws else ""
            )

    def _choose_kind(self) -> None:
        with self._lock:
            self._selection = Selection()
        self._show_selection()

    def _show_selection(self) -> None:
        with self._lock:
            self._write()
        self._playback.redraw()

    def _press(self, name: str) -> None:
        rollout, frame = self._shown()
        if name in {_ALL, _INVERT, _NOTHING}:
            if not self._is_on:
                self._enter()
            with self._lock:
                every = only(all_of(rollout.model), self._kind.value)
                new = Selection() if name == _NOTHING else every
                self._selection = self._selection.changed(
                    new, "toggle" if name == _INVERT else "replace"
                )
            self._show_selection()
            return
        if not self._selection:
            raise UsageError(
                "Nothing is selected. Press B, then drag a rectangle in the scene or click."
            )
        edit = self._edit(name, rollout, frame)
        # Refused here and not by the process that simulates, so that nothing has changed then.
        apply_edits(rollout.model, (edit,), rollout.parameters)
        self._physics.edit(edit)
        self._playback.redraw()

    def _edit(self, name: str, rollout: ObjectRollout, frame: int) -> AnyEdit:
        """Make the edit of a button."""
        if name in {_STIFFNESS, _DAMPING, _CUT}:
            springs, virtual = self._chosen_springs(rollout)
            if name == _CUT:
                return Cut(springs=springs, virtual=virtual)
            factor = float(self._factor.value)
            if not _FACTORS[0] <= factor <= _FACTORS[1] or math.isclose(factor, 1.0):
                raise UsageError("Type a factor from 0.001 to 1000 that is not 1 first.")
            quantity = "stiffness" if name == _STIFFNESS else "damping"
            return ScaleMaterial(quantity=quantity, factor=factor, springs=springs, virtual=virtual)
        nodes = np.array(sorted(ends_of(self._selection)), np.int64)
        if name == _JOIN:
            return Join(springs=pairs_to_join(rollout, nodes))
        position = np.asarray(rollout.position[frame], np.float64)
        numbers = tuple(int(node) for node in nodes)
        if name == _PIN:
            places = tuple((float(x), float(y), float(z)) for x, y, z in position[nodes])
            return Pin(nodes=numbers, places=places, frame=frame)
        if name == _ATTACH:
            return attach_to_nearest(rollout, frame, nodes)
        held = rollout.model.spring_nodes[rollout.model.object_spring_count :].min(axis=1)
        if not np.isin(nodes, held).any():
            raise UsageError("Nothing holds the selected nodes, so there is nothing to release.")
        return Release(nodes=numbers, frame=frame)

    def _chosen_springs(
        self, rollout: ObjectRollout
    ) -> tuple[tuple[NodePair, ...], tuple[NodePair, ...]]:
        """Give the selected springs, or those between the selected nodes."""
        chosen = self._selection
        springs = chosen.springs | springs_between(rollout.model, chosen.nodes)
        if not springs and not chosen.virtual:
            raise UsageError("No spring joins two of the selected nodes. Select more of them.")
        return tuple(sorted(springs)), tuple(sorted(chosen.virtual))

    def _draw(self, rollout: ObjectRollout, frame: int) -> None:
        model = rollout.model
        position = np.asarray(rollout.position[frame], np.float32)
        control = np.asarray(rollout.held_control(frame), np.float32)
        point = np.concatenate([position, control])
        node, spring = self._highlights.of(model, self._selection)
        spring = spring[model.acts_in(frame)[spring]]
        kind, own, count = self._kind.value, model.object_spring_count, len(model.spring_nodes)
        with self._server.atomic():
            self._nodes.points(
                "/edit/nodes", position, _OFFERED, 0.2 * self._spacing, is_visible=kind == "nodes"
            )
            offered = np.arange(own) if kind == "springs" else np.arange(own, count)
            offered = offered[model.acts_in(frame)[offered]]
            self._nodes.segments(
                "/edit/springs",
                point[model.spring_nodes[offered]],
                _OFFERED,
                1.0,
                is_visible=kind != "nodes",
            )
            self._nodes.points(
                "/edit/chosen_nodes",
                position[node],
                SELECTED,
                0.42 * self._spacing,
                is_visible=True,
            )
            self._nodes.segments(
                "/edit/chosen_springs",
                point[model.spring_nodes[spring]],
                SELECTED,
                4.0,
                is_visible=True,
            )

    def _write(self) -> None:
        """Write the button and what is selected; called under the lock or before anybody asks."""
        label = _STOP if self._is_on else _START
        if self._button.label != label:
            self._button.label = label
        text = _HOW_NOW if self._is_on else _HOW
        if self._is_on:
            text += f"<br/>Selected: <b data-selected>{self._selection.text}</b>"
        content = f'<div style="{_STYLE}">{text}</div>'
        if self._status.content != content:
            self._status.content = content

    def _write_list(self) -> None:
        """List the edits that are in force."""
        content = edits_html(self._physics.history.setting.edits)
        if self._list.content != content:
            self._list.content = content


def edits_html(edits: Edits) -> str:
    """List edits in the order in which they are made."""
    items = "".join(f"<li>{html.escape(edit.title)}</li>" for edit in edits)
    if not items:
        return f'<div style="{_STYLE}">No edits.</div>'
    return (
        f'<div style="{_STYLE}">Edits in force, undone by Ctrl Z or in <i>Physics</i>, kept as a '
        f'run in <i>Export</i>:<ol style="margin:0;padding-left:1.6em">{items}</ol></div>'
    )


def pairs_to_join(rollout: ObjectRollout, nodes: ndarray) -> tuple[NodePair, ...]:
    """Find for each node the nearest other one of them that it has no spring to.

    Args:
        rollout: Where they are at rest, and what joins them.
        nodes: Two nodes or more.

    Raises:
        UsageError: If there are too few, or all are joined already.
    """
    model = rollout.model
    if len(nodes) < 2:
        raise UsageError("Select two nodes or more to join them.")
    place = np.asarray(model.object_node, np.float64)[nodes]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    number = np.full(model.node_count, -1)
    number[nodes] = np.arange(len(nodes))
    ends = number[model.spring_nodes[: model.object_spring_count]]
    first, second = ends[(ends >= 0).all(axis=1)].T
    apart[first, second] = apart[second, first] = np.inf
    np.fill_diagonal(apart, np.inf)
    nearest = np.argmin(apart, axis=1)
    free = np.flatnonzero(np.isfinite(apart.min(axis=1)))
    if not len(free):
        raise UsageError("The selected nodes are joined to each other already.")
    pair = np.sort(np.stack([nodes[free], nodes[nearest[free]]], axis=1), axis=1)
    return tuple(sorted({(int(a), int(b)) for a, b in pair}))


def attach_to_nearest(rollout: ObjectRollout, frame: int, nodes: ndarray) -> Attach:
    """Tie nodes to the control nodes that are nearest to them in a frame.

    Raises:
        UsageError: If no control node moves.
    """
    model = rollout.model
    moving = model.control_count - model.pin_count
    if not moving:
        raise UsageError("Nothing moves this object, so there is no hand to attach nodes to.")
    control = np.asarray(rollout.held_control(frame), np.float64)[:moving]
    place = np.asarray(rollout.position[frame], np.float64)[nodes]
    apart = [np.linalg.norm(control - its, axis=1) for its in place]
    return Attach(
        nodes=tuple(int(node) for node in nodes),
        controls=tuple(int(np.argmin(its)) for its in apart),
        lengths=tuple(float(its.min()) for its in apart),
        frame=frame,
    )
