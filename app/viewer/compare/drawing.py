"""The scene of a comparison: two rollouts beside each other, or one over the other."""

import threading
from dataclasses import replace

import numpy as np
import viser
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.color.coloring import Painted
from app.viewer.color.difference import Way, rollout_difference
from app.viewer.compare.figure import ARROWS, FIGURE_BYTES, GAP, Extents, Side
from app.viewer.compare.figure_camera import Box, Eye
from app.viewer.compare.look import GHOST, SIDES, STYLES, Look, difference_paint, shade
from app.viewer.compare.recorded import PLAYING_OBSERVED, Halves, RecordedDrawing, have_same_hands
from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import ClippedNodes, Plane
from app.viewer.scene.object_drawing import ObjectDrawing, share_bytes, strengths
from app.viewer.scene.scene import add_ground
from physhandi.object_rollout import ObjectRollout

_NARROWEST = 13.0
_ABOVE, _BELOW = 4.0, 0.6
_LINE = 0.034
_LONGEST = 0.22
_ROOT = "/compare"
_GROUND = f"{_ROOT}/ground"


class CompareDrawing:
    """Draws both sides around the middle of the scene; both are seen by one camera.

    The thread of the clock draws; a camera may turn the sides from another one.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        framing: Framing,
        rollouts: list[ObjectRollout],
    ) -> None:
        """Measure what has to fit; nothing is drawn yet.

        Args:
            server: Where to.
            content: Tells the ground, and what has to fit if there are no rollouts.
            framing: Sizes.
            rollouts: The rollouts that are complete.
        """
        self._server = server
        self._content = content
        self._framing = framing
        self._nodes = ClippedNodes(server)
        self._drawings = {
            name: ObjectDrawing(self._nodes, framing, root=f"{_ROOT}/{name}", style=STYLES[name])
            for name in SIDES
        }
        self._recorded = {
            name: RecordedDrawing(self._nodes, framing, f"{_ROOT}/{name}") for name in SIDES
        }
        self._extents = _measure(content, framing, rollouts)
        self._eye = Eye(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 0.0, 1.0]))
        self._lock = threading.RLock()
        self._captions = dict.fromkeys(SIDES, "")
        self._shown: Float[ndarray, "node 3"] = np.zeros((0, 3))
        self._look = Look()
        self._way: Way | None = None
        known = [float(np.quantile(s, 0.9)) for s in map(strengths, rollouts) if len(s)]
        self._force_unit = 0.07 * framing.extent / max(known, default=1.0)
        self._is_ground_laid = False

    def box(self, eye: Eye) -> Box:
        """Measure both sides with their captions, as they are seen beside each other."""
        middle, wide, high = self._extents.seen(eye)
        line = self._line
        middle = middle + 0.5 * (_ABOVE - _BELOW) * line * eye.up
        return middle, 2 * GAP * max(wide, _NARROWEST * line), high + (_ABOVE + _BELOW) * line

    def hide(self) -> None:
        """Hide everything until it is drawn again."""
        with self._lock, self._server.atomic():
            self._nodes.hide()

    def clear(self) -> None:
        """Remove everything."""
        with self._lock:
            self._nodes.clear()
            self._is_ground_laid = False
            # A camera that is heard late turns nothing any more.
            self._captions = dict.fromkeys(SIDES, "")

    def turn(self, eye: Eye) -> None:
        """Keep the sides left and right as the camera turns."""
        with self._lock, self._server.atomic():
            self._eye = eye
            if self._captions["a"]:
                self._place()

    def draw(
        self, halves: Halves, look: Look, layers: Layers, way: Way | None, *, is_playing: bool
    ) -> None:
        """Bring both sides to a moment.

        Args:
            halves: What is on both sides.
            look: What the panel chose.
            layers: What is shown.
            way: How the rollouts are compared; None if they cannot be.
            is_playing: Whether the clock is running, so that less may be sent.
        """
        has_one_hand = look.mode != "side" and have_same_hands(halves)
        with self._lock, self._server.atomic():
            self._look, self._way = replace(look), way
            self._remember(halves)
            self._captions = {name: half.side.caption for name, half in halves.items()}
            if not self._is_ground_laid:
                self._is_ground_laid = True
                add_ground(self._nodes, self._content, self._framing, _GROUND)
            self._nodes.show(_GROUND, is_visible=layers.ground)
            self._nodes.color_ground(_GROUND, is_dark=layers.dark)
            self._place()
            for name, half in halves.items():
                is_shown = look.strength(name) > 0.0
                is_lone = not (has_one_hand and name == "b")
                is_seen = layers.hands and is_shown and is_lone
                self._recorded[name].draw_hands(half, is_visible=is_seen)
                is_observed = layers.observed and is_shown and is_lone
                self._nodes.plane = self._plane(name)
                self._recorded[name].draw_observed(
                    half, is_playing=is_playing, is_visible=is_observed
                )
                self._draw_object(name, halves, layers, is_playing=is_playing)
                self._nodes.plane = None

    def _draw_object(self, name: str, halves: Halves, layers: Layers, *, is_playing: bool) -> None:
        half, other = halves[name], halves["b" if name == "a" else "a"].side
        rollout, drawing, strength = (
            half.side.rollout,
            self._drawings[name],
            self._look.strength(name),
        )
        if rollout is None or rollout.ready == 0:
            return
        # Springs would hide the other side long before they have faded.
        is_strong = strength > 0.5 and not self._look.is_ghost(name)
        shown = replace(
            layers,
            nodes=False,
            surface=False,
            color="plain",
            all_controls=False,
            controls=layers.controls and is_strong,
            virtual_springs=layers.virtual_springs and is_strong,
            object_springs=layers.object_springs and is_strong,
            forces=layers.forces and is_strong,
        )
        hands = sum(hand.vertex.shape[1] for hand in half.content.hands) if layers.hands else 0
        observed = PLAYING_OBSERVED if layers.observed else 0
        points = rollout.model.node_count + len(drawing.attached(rollout)) + hands + observed
        budget = share_bytes(FIGURE_BYTES // 2 - 15 * points, rollout, layers, ARROWS)
        if not is_playing:
            budget = replace(budget, virtual=None, springs=None)
        painted = self._painted(name, half.side, other)
        drawing.draw(
            rollout,
            half.side.frame,
            shown,
            budget,
            force_unit=self._force_unit,
            longest=_LONGEST * self._framing.extent,
            painted=painted,
        )
        point = np.asarray(rollout.position[half.side.frame], dtype=np.float32)
        color = self._colors(name, half.side, painted, is_dark=layers.dark)
        size = self._look.node_size(name) * self._framing.spacing
        is_visible = layers.nodes and strength > 0.0
        path = f"{_ROOT}/{name}/object/compared"
        self._nodes.points(path, point, color, size, is_visible=is_visible)

    def _painted(self, name: str, side: Side, other: Side) -> Painted | None:
        """Choose the colors that tell the difference; None for those of the side."""
        rollout, look, way = side.rollout, self._look, self._way
        if rollout is None or other.rollout is None or other.rollout.ready == 0 or way is None:
            return None
        if look.tint != "difference" or look.is_ghost(name):
            return None
        distance = rollout_difference(rollout, side.frame, other.rollout, other.frame, way)
        return difference_paint(rollout, distance, look.scale)

    def _colors(
        self, name: str, side: Side, painted: Painted | None, *, is_dark: bool
    ) -> UInt8[ndarray, "node 3"]:
        """Choose the color of every node."""
        strength = self._look.strength(name)
        if painted is not None:
            return shade(painted.node, strength, is_dark=is_dark)
        color = GHOST if self._look.is_ghost(name) else STYLES[name].node
        count = 0 if side.rollout is None else side.rollout.model.node_count
        return shade(np.tile(np.array(color, np.uint8), (count, 1)), strength, is_dark=is_dark)

    @property
    def _line(self) -> float:
        """Height of a line of text."""
        return _LINE * self._framing.extent

    def _plane(self, name: str) -> Plane | None:
        """Find the part of the scene that belongs to a side."""
        if self._look.mode != "wipe":
            return None
        sign = 1.0 if (name == "a") != self._look.is_swapped else -1.0
        return Plane(
            direction=(sign * self._eye.right).astype(np.float32),
            limit=sign * self._border(),
            has_border=name == "a",
        )

    def _border(self) -> float:
        """Find where the line of the wipe is along the camera's right hand."""
        along = self._shown @ self._eye.right
        if len(along) == 0:
            return 0.0
        low, high = float(along.min()), float(along.max())
        return low + (1.02 * self._look.wipe - 0.01) * (high - low)

    def _remember(self, halves: Halves) -> None:
        """Keep the nodes of a moment, over which the line of the wipe moves."""
        sides = [half.side for half in halves.values()]
        shown = [
            s.rollout.position[s.frame] for s in sides if s.rollout is not None and s.rollout.ready
        ]
        self._shown = np.concatenate([np.zeros((0, 3)), *map(np.asarray, shown)])

    def _place(self) -> None:
        """Put sides, captions and the line of the wipe where the camera sees them."""
        eye, nodes, line, look = self._eye, self._nodes, self._line, self._look
        middle, wide, high = self._extents.seen(eye)
        wide = max(wide, _NARROWEST * line)
        is_side = look.mode == "side"
        for name in SIDES:
            sign = -1.0 if (name == "a") != look.is_swapped else 1.0
            aside = 0.5 * sign * GAP * wide * eye.right if is_side else np.zeros(3)
            nodes.frame(f"{_ROOT}/{name}", aside)
            title, _, detail = self._captions[name].partition("\n")
            for part, text, size, lines in (
                ("title", title, 1.2, 2.9),
                ("detail", detail, 0.9, 1.5),
            ):
                path = f"{_ROOT}/{part}_{name}"
                if is_side:
                    place = middle + aside + (0.5 * high + lines * line) * eye.up
                    height = size * line
                    nodes.label(path, text, place, anchor="center-center", height=height)
                nodes.show(path, is_visible=is_side and bool(text))
        foot = middle + (self._border() - float(middle @ eye.right)) * eye.right
        ends = [foot + sign * 0.55 * high * eye.up for sign in (-1.0, 1.0)]
        segment = np.stack(ends)[None].astype(np.float32)
        nodes.segments(f"{_ROOT}/wipe", segment, GHOST, 2.0, is_visible=look.mode == "wipe")


def _measure(content: Content, framing: Framing, rollouts: list[ObjectRollout]) -> Extents:
    tracks: list[Float[ndarray, "frame point 3"]] = []
    for rollout in rollouts:
        tracks += [rollout.position, rollout.control]
    if not tracks:
        tracks = [hand.vertex for hand in content.hands]
    count = min((len(track) for track in tracks), default=0)
    if count == 0:
        corners = framing.center + 0.35 * framing.extent * np.array([[-1.0] * 3, [1.0] * 3])
        return Extents([corners[None]], 1)
    return Extents(tracks, count)
