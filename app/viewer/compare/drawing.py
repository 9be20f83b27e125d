"""The scene of a comparison: A and B beside each other, or in one place; one camera sees both."""

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.color.coloring import Painted
from app.viewer.color.difference import Way, rollout_difference
from app.viewer.color.legend import ColorScale
from app.viewer.color.quantities import QUANTITIES, Values, from_nodes, in_length_unit
from app.viewer.compare.camera import Box, Eye
from app.viewer.compare.request import Mode, Tint
from app.viewer.compare.sides import SIDE_KEYS, ComparedSide, Sides
from app.viewer.content.content import Content
from app.viewer.content.layers import (
    GREEN,
    SKIN,
    YELLOW,
    Layers,
    has_few_springs,
    with_surface_for_splats,
)
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import ClippedNodes, Plane
from app.viewer.scene.object_drawing import RGB, ObjectDrawing, Style, share_bytes, strengths
from app.viewer.scene.scene import FRAME_BYTES, add_ground
from physhandi.data.object_mass import given_mass
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.object_surface import ObjectSurface

MODES: Mapping[Mode, str] = {"side": "side by side", "overlay": "overlay", "wipe": "wipe"}
"""Ways of placing A and B, as the panel names them."""
TINTS: Mapping[Tint, str] = {
    "side": "of A and B",
    "difference": "of their difference",
    "parts": "of the paper's figure",
}
"""Colorings of A and B, as the panel names them."""
STYLES = {
    "a": Style(
        node=(47, 111, 222),
        control=(19, 60, 140),
        spring=(152, 182, 236),
        virtual=(92, 178, 236),
        arrow=(24, 70, 170),
        spring_width=1.0,
    ),
    "b": Style(
        node=(232, 118, 24),
        control=(150, 66, 8),
        spring=(243, 196, 150),
        virtual=(244, 176, 40),
        arrow=(196, 78, 6),
        spring_width=1.0,
    ),
}
"""Colors of both sides, which people who confuse red and green tell apart too."""
FIGURE_STYLE = Style(
    is_solid=True,
    node=(18, 66, 170),
    control=(170, 14, 16),
    spring=(190, 198, 209),
    node_size=0.42,
    control_size=0.36,
    spring_width=1.0,
    arrow=(165, 10, 12),
    arrow_width=0.0032,
)
"""Style of the paper's figure, in which the colors of both sides mean the object's parts."""
_COLOR_NAMES = {"a": "blue", "b": "orange"}
"""Words for the colors of `STYLES`."""
GHOST: RGB = (140, 148, 160)
"""Color of A's nodes where B shows the difference from them."""
ARROWS = 300
"""Most force arrows of one side."""
GAP = 1.08
"""Distance of the middles of two sides, as a multiple of a side's width."""
PLAYING_OBSERVED = 1_000
"""Most observed points of a side that are sent while the clock is running."""
_BACKGROUND = {False: (255, 255, 255), True: (24, 25, 28)}
_ROOT = "/compare"
_GROUND = f"{_ROOT}/ground"
_SAMPLED_FRAMES = 10
_SAMPLED_POINTS = 300
_LINE = 0.034
"""Height of a line of text, as a part of the scene's extent."""
_NARROWEST = 13.0
"""Least width of a side in lines of text."""
_ABOVE = 4.0
"""Room for captions above the sides in lines of text."""
_SMALLER = 0.7
"""Size of captions above sides that are in one place, as a part of others."""
_BELOW = {False: 0.6, True: 2.6}
"""Room below the sides in lines of text, without and with the figure's legend."""
_LONGEST_ARROW = 0.22
_LONGEST_ARROW_OF_FIGURE = 0.3
_HAND_OPACITY = 0.35
_OVERLAY_OPACITY = 0.7
_SAME_HAND = 1e-5
_LIGHTNESS = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the lightness of a color."""


@dataclass(kw_only=True)
class Look:
    """Display of A and B together, as the panel of the comparison chooses it."""

    mode: Mode = "side"
    """Arrangement of both."""
    tint: Tint = "side"
    """Meaning of the nodes' colors."""
    fade: float = 0.5
    """In an overlay: 0 shows A alone, 1 shows B alone, 0.5 shows both."""
    wipe: float = 0.5
    """Place of the line of a wipe, as a part of the width from the left."""
    is_swapped: bool = False
    """Whether B is on the left."""
    scale: float = 0.0
    """Difference at the end of the color scale [m]; 0 if it is not known yet."""

    @property
    def is_figure(self) -> bool:
        """Whether both are shown as in the paper's figure; in one place they need own colors."""
        return self.mode == "side" and self.tint == "parts"

    def is_ghost(self, side: str) -> bool:
        """Tell whether a side is only the shadow from which the other one's difference counts."""
        is_over = self.mode == "overlay" and self.fade > 0.0
        return side == "a" and self.tint == "difference" and is_over

    def node_size(self, side: str) -> float:
        """Diameter of nodes, as a part of their spacing; in one place both must be seen."""
        if self.is_ghost(side):
            return 0.14
        return 0.22 if self.mode == "overlay" and self.tint != "difference" else 0.36

    def strength(self, side: str) -> float:
        """Tell how strongly a side is drawn: 0 for not at all, 1 for in its own colors."""
        if self.mode != "overlay":
            return 1.0
        part = 1.0 - self.fade if side == "a" else self.fade
        return min(1.0, 2.0 * part)

    def opacity(self, side: str) -> float | None:
        """Tell how opaque a side's surface is, so that both are seen in one place; None if it is.

        Where colors mean the difference, A is a shadow of nodes.
        """
        if self.mode != "overlay" or self.fade in {0.0, 1.0} or self.tint == "difference":
            return None
        return _OVERLAY_OPACITY * self.strength(side)


class CompareDrawing:
    """Draws both sides around the middle of the scene.

    The thread of the clock draws; a camera may turn the sides from another one.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        framing: Framing,
        rollouts: Iterable[ObjectRollout],
        look: Look,
    ) -> None:
        """Measure what has to fit; nothing is drawn yet.

        Args:
            server: Where to.
            content: Gives the ground, and what has to fit if there are no rollouts.
            framing: Sizes.
            rollouts: Complete rollouts, which have to fit and give the scale of the arrows.
            look: How both are shown; the panel changes it.
        """
        rollouts = list(rollouts)
        self._server = server
        self._content = content
        self._framing = framing
        self._nodes = ClippedNodes(server)
        self._drawings = {
            key: ObjectDrawing(self._nodes, framing, root=f"{_ROOT}/{key}", style=STYLES[key])
            for key in SIDE_KEYS
        }
        self._figure_drawings = {
            key: ObjectDrawing(
                self._nodes, framing, root=f"{_ROOT}/{key}/figure", style=FIGURE_STYLE
            )
            for key in SIDE_KEYS
        }
        self._extents = _measure(content, framing, rollouts)
        self._eye = Eye(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 0.0, 1.0]))
        self._lock = threading.RLock()
        self._sides: Sides = {}
        self._chosen = look
        self._look = replace(look)
        self._way: Way | None = None
        self._force_scale = 1.0
        self._newtons: dict[str, float] = dict.fromkeys(SIDE_KEYS, 1.0)
        self._force_units = {False: 0.0, True: 0.0}
        self._is_ground_laid = False
        self._legend_placed: tuple[Any, ...] | None = None
        self.measure_forces(rollouts)

    def measure_forces(self, rollouts: Iterable[ObjectRollout]) -> None:
        """Choose the length of an arrow of 1 N, the same for both sides.

        In the figure the strongest force of all rollouts is seen whole; elsewhere arrows of strong
        forces may be cut, so that weaker ones are seen.
        """
        force = [newtons for newtons in map(strengths, rollouts) if len(newtons)]
        extent = self._framing.extent
        strongest = max((float(newtons.max()) for newtons in force), default=np.inf)
        strong = max((float(np.quantile(newtons, 0.9)) for newtons in force), default=1.0)
        self._force_units = {
            False: 0.07 * extent / strong,
            True: _LONGEST_ARROW_OF_FIGURE * extent / strongest,
        }

    def box(self, eye: Eye) -> Box:
        """Measure both sides with captions and legend, as they are seen beside each other."""
        middle, wide, high = self._extents.seen(eye)
        line, below = self._line, _BELOW[self._chosen.is_figure]
        middle = middle + 0.5 * (_ABOVE - below) * line * eye.up
        return middle, 2 * GAP * max(wide, _NARROWEST * line), high + (_ABOVE + below) * line

    def hide(self) -> None:
        """Hide everything until it is drawn again."""
        with self._lock, self._server.atomic():
            self._legend_placed = None
            self._nodes.hide()

    def clear(self) -> None:
        """Remove everything."""
        with self._lock:
            self._nodes.clear()
            self._is_ground_laid = False
            self._legend_placed = None
            self._sides = {}  # A camera that is heard late turns nothing any more.

    def turn(self, eye: Eye) -> None:
        """Keep the sides left and right, captions above and legend below, as the camera turns."""
        with self._lock, self._server.atomic():
            self._eye = eye
            if self._sides:
                self._place()

    def draw(self, sides: Sides, layers: Layers, way: Way | None, *, is_playing: bool) -> None:
        """Bring both sides to a moment.

        Args:
            sides: What both show.
            layers: What is shown.
            way: How the rollouts are compared; None if they cannot be.
            is_playing: Whether the clock is running, so that less may be sent.
        """
        look, layers = replace(self._chosen), with_surface_for_splats(layers)
        has_one_hand = look.mode != "side" and have_same_hands(sides)
        with self._lock, self._server.atomic():
            self._look, self._way = look, way
            self._sides, self._force_scale = sides, layers.force_scale
            self._newtons = written_newtons(sides, layers.mass)
            if not self._is_ground_laid:
                self._is_ground_laid = True
                add_ground(self._nodes, self._content, self._framing, _GROUND)
            self._nodes.show(_GROUND, is_visible=layers.ground and not look.is_figure)
            self._nodes.color_ground(_GROUND, is_dark=layers.dark)
            self._place()
            for key, side in sides.items():
                is_shown = look.strength(key) > 0.0 and not (has_one_hand and key == "b")
                self._draw_hands(key, side, layers, is_visible=layers.hands and is_shown)
                is_observed = layers.observed and is_shown and not look.is_figure
                self._nodes.plane = self._plane(key)
                self._draw_observed(key, side, is_playing=is_playing, is_visible=is_observed)
                self._draw_object(key, layers, is_playing=is_playing)
                self._nodes.plane = None

    def _draw_hands(
        self, key: str, side: ComparedSide, layers: Layers, *, is_visible: bool
    ) -> None:
        is_alone = side.rollout is None and self._look.mode == "side"
        has_surface = self._surface_of(key, layers) is not None
        opacity = None if is_alone or has_surface else _HAND_OPACITY
        for hand in side.content.hands:
            path, color = f"{_ROOT}/{key}/hand/{hand.side}", SKIN[hand.side]
            frame = min(side.content_frame, len(hand.vertex) - 1)
            vertex = np.asarray(hand.vertex[frame], np.float32)
            if hand.face is None:
                size = 0.006 * self._framing.extent
                self._nodes.points(path, vertex, color, size, is_visible=is_visible)
            else:
                self._nodes.mesh(
                    path, vertex, hand.face, color, is_visible=is_visible, opacity=opacity
                )

    def _draw_observed(
        self, key: str, side: ComparedSide, *, is_playing: bool, is_visible: bool
    ) -> None:
        observed, path = side.content.observed, f"{_ROOT}/{key}/observed"
        if observed is None or not is_visible:
            self._nodes.show(path, is_visible=False)
            return
        point = observed.points(side.content_frame)
        every = max(1, -(-len(point) // PLAYING_OBSERVED)) if is_playing else 1
        size = 0.4 * self._framing.spacing
        self._nodes.points(path, point[::every], GREEN, size, is_visible=True)

    def _draw_object(self, key: str, layers: Layers, *, is_playing: bool) -> None:
        side, other, look = self._sides[key], self._sides["b" if key == "a" else "a"], self._look
        rollout, strength = side.rollout, look.strength(key)
        colored_path = f"{_ROOT}/{key}/object/compared"
        used, unused = self._drawings[key], self._figure_drawings[key]
        if look.is_figure:
            used, unused = unused, used
        unused.hide()
        if rollout is None or rollout.ready == 0:
            used.hide()
            return
        # Springs would hide the other side long before they have faded.
        is_strong = strength > 0.5 and not look.is_ghost(key)
        surface = self._surface_of(key, layers)
        # Figures are of nodes and springs.
        has_object = layers.nodes or (layers.surface and surface is None)
        has_parts = look.is_figure and layers.surface
        has_springs = layers.object_springs or (
            layers.surface and surface is None and has_few_springs(rollout)
        )
        shown = replace(
            layers,
            nodes=has_object and look.is_figure,
            surface=False,
            color="plain",
            all_controls=layers.all_controls and look.is_figure,
            controls=(layers.controls or has_parts) and is_strong,
            virtual_springs=(layers.virtual_springs or has_parts) and is_strong,
            object_springs=has_springs and is_strong,
            forces=layers.forces and is_strong,
        )
        hands = sum(hand.vertex.shape[1] for hand in side.content.hands) if layers.hands else 0
        observed = PLAYING_OBSERVED if layers.observed and not look.is_figure else 0
        points = rollout.model.node_count + len(used.attached(rollout)) + hands + observed
        points += 0 if surface is None else surface.vertex_count
        point_bytes = 12 if look.is_figure else 15
        budget = share_bytes(FRAME_BYTES // 2 - point_bytes * points, rollout, shown, ARROWS)
        if not is_playing:
            budget = replace(budget, virtual=None, springs=None)
        painted = self._painted(key, side, other)
        longest = 1.0 if look.is_figure else _LONGEST_ARROW
        used.draw(
            rollout,
            side.frame,
            shown,
            budget,
            force_unit=self._force_units[look.is_figure] * self._newtons[key] / self._newtons["a"],
            longest=longest * self._framing.extent,
            painted=painted,
        )
        self._draw_surface(key, rollout, surface, painted)
        if look.is_figure:
            return
        point = np.asarray(rollout.position[side.frame], dtype=np.float32)
        color = self._colors(key, rollout, painted, is_dark=layers.dark)
        size = look.node_size(key) * self._framing.spacing
        is_visible = has_object and strength > 0.0
        self._nodes.points(colored_path, point, color, size, is_visible=is_visible)

    def _surface_of(self, key: str, layers: Layers) -> ObjectSurface | None:
        """Find the surface by which a side is shown, if it is."""
        side, look = self._sides[key], self._look
        surface, rollout = side.content.surface, side.rollout
        if surface is None or rollout is None or look.is_figure or look.is_ghost(key):
            return None
        if look.strength(key) == 0.0:
            return None
        has_its_nodes = surface.node_count == rollout.model.node_count
        return surface if layers.surface and has_its_nodes else None

    def _draw_surface(
        self,
        key: str,
        rollout: ObjectRollout,
        surface: ObjectSurface | None,
        painted: Painted | None,
    ) -> None:
        path = f"{_ROOT}/{key}/object/surface"
        if surface is None:
            self._nodes.show(path, is_visible=False)
            return
        color = tinted(surface.color, STYLES[key].node)
        if painted is not None:
            color = painted.vertices(surface)
        vertex = surface.place(rollout.position[self._sides[key].frame])
        opacity = self._look.opacity(key)
        self._nodes.mesh(path, vertex, surface.face, color, is_visible=True, opacity=opacity)

    def _painted(self, key: str, side: ComparedSide, other: ComparedSide) -> Painted | None:
        """Choose the colors of the difference; None for those of the side."""
        rollout, compared, look, way = side.rollout, other.rollout, self._look, self._way
        if rollout is None or compared is None or compared.ready == 0 or way is None:
            return None
        if look.tint != "difference" or look.is_ghost(key):
            return None
        distance = rollout_difference(rollout, side.frame, compared, other.frame, way)
        return Painted(
            values=Values(node=distance, spring=from_nodes(rollout, distance)),
            scale=difference_scale(look.scale, "m"),
        )

    def _colors(
        self, key: str, rollout: ObjectRollout, painted: Painted | None, *, is_dark: bool
    ) -> UInt8[ndarray, "node 3"]:
        """Choose the color of every node, faded into the background as far as the side is."""
        if painted is not None:
            color = painted.node
        else:
            plain = GHOST if self._look.is_ghost(key) else STYLES[key].node
            color = np.tile(np.array(plain, np.uint8), (rollout.model.node_count, 1))
        strength = self._look.strength(key)
        faded = strength * color + (1.0 - strength) * np.array(_BACKGROUND[is_dark])
        return np.round(faded).astype(np.uint8)

    @property
    def _line(self) -> float:
        """Height of a line of text."""
        return _LINE * self._framing.extent

    def _plane(self, key: str) -> Plane | None:
        """Find the part of the scene that belongs to a side of a wipe."""
        if self._look.mode != "wipe":
            return None
        sign = 1.0 if (key == "a") != self._look.is_swapped else -1.0
        return Plane(
            direction=(sign * self._eye.right).astype(np.float32),
            limit=sign * self._border(),
            has_border=key == "a",
        )

    def _border(self) -> float:
        """Find the line of the wipe along the camera's right hand, over the nodes on the screen."""
        ends: list[float] = []
        for side in self._sides.values():
            if side.rollout is not None and side.rollout.ready:
                along = np.asarray(side.rollout.position[side.frame]) @ self._eye.right
                ends += [float(along.min()), float(along.max())] if len(along) else []
        if not ends:
            return 0.0
        return min(ends) + (1.02 * self._look.wipe - 0.01) * (max(ends) - min(ends))

    def _place(self) -> None:
        """Put sides, captions, legend and the line of a wipe into the camera's view."""
        eye, nodes, line, look = self._eye, self._nodes, self._line, self._look
        middle, wide, high = self._extents.seen(eye)
        wide = max(wide, _NARROWEST * line)
        is_side = look.mode == "side"
        for key, side in self._sides.items():
            sign = -1.0 if (key == "a") != look.is_swapped else 1.0
            beside = 0.5 * sign * GAP * wide * eye.right
            nodes.frame(f"{_ROOT}/{key}", beside if is_side else np.zeros(3))
            # In one place sides are told apart by their colors, or by the line between them.
            is_named = look.mode == "overlay" and look.tint == "side"
            title = f"{side.title} ({_COLOR_NAMES[key]})" if is_named else side.title
            for name, text, size, lines in (
                ("title", title, 1.2, 2.9),
                ("detail", side.detail, 0.9, 1.5),
            ):
                path = f"{_ROOT}/{name}_{key}"
                part = 1.0 if is_side else _SMALLER
                place = middle + part * beside + (0.5 * high + part * lines * line) * eye.up
                height = part * size * line
                nodes.label(path, text, place, anchor="center-center", height=height)
                nodes.show(path, is_visible=bool(text))
        self._place_legend(middle - (0.5 * high + 1.6 * line) * eye.up)
        foot = middle + (self._border() - float(middle @ eye.right)) * eye.right
        ends = [foot + sign * 0.55 * high * eye.up for sign in (-1.0, 1.0)]
        segment = np.stack(ends)[None].astype(np.float32)
        nodes.segments(f"{_ROOT}/wipe", segment, GHOST, 2.0, is_visible=look.mode == "wipe")

    def _place_legend(self, middle: Float[ndarray, " 3"]) -> None:
        """Write below the figure what its colors mean, and how strong a force an arrow is."""
        eye, nodes, root, line = self._eye, self._nodes, f"{_ROOT}/legend", self._line
        is_shown = self._look.is_figure
        force_unit = self._force_units[True] * self._force_scale / self._newtons["a"]
        placed = (is_shown, force_unit, *eye.right, *eye.up)
        if placed == self._legend_placed:
            return
        self._legend_placed = placed
        force = legend_force(force_unit, self._framing.extent)
        texts = ("object nodes", "control nodes", "virtual springs", f"force, {force:g} N")
        widths = (0.7 * line, 0.7 * line, 1.8 * line, force * force_unit)
        letters = [0.43 * len(text) * line for text in texts]
        spans = [w + 0.5 * line + letter for w, letter in zip(widths, letters, strict=True)]
        x = -0.5 * (sum(spans) + 3 * line)
        for index, (text, width, span) in enumerate(zip(texts, widths, spans, strict=True)):
            start, end = (middle + at * eye.right for at in (x, x + width))
            segment = np.stack([start, end])[None].astype(np.float32)
            if index < 2:
                color = (FIGURE_STYLE.node, FIGURE_STYLE.control)[index]
                ball = ((start + end) / 2)[None]
                nodes.spheres(f"{root}/ball_{index}", ball, color, width, is_visible=is_shown)
            elif index == 2:
                nodes.segments(f"{root}/spring", segment, YELLOW, 3.0, is_visible=is_shown)
            else:
                arrow = segment if force > 0 and is_shown else segment[:0]
                thick = FIGURE_STYLE.arrow_width * self._framing.extent
                nodes.arrows(f"{root}/force", arrow, FIGURE_STYLE.arrow, thick)
            path = f"{root}/text_{index}"
            if is_shown:
                place = middle + (x + width + 0.5 * line) * eye.right
                nodes.label(path, text, place, anchor="center-left", height=0.75 * line)
            nodes.show(path, is_visible=is_shown)
            x += span + line


class Extents:
    """Sampled points of all that moves in a side, without its few farthest ones."""

    def __init__(self, tracks: Iterable[Float[ndarray, "frame point 3"]], frame_count: int) -> None:
        """Sample the points.

        Args:
            tracks: What has to fit; at least one with a frame and a point.
            frame_count: How many frames of the tracks count.
        """
        frames = np.unique(np.linspace(0, frame_count - 1, _SAMPLED_FRAMES).astype(int))
        parts = [np.asarray(track[f]) for track in tracks for f in frames]
        parts = [part[:: max(1, len(part) // _SAMPLED_POINTS)] for part in parts]
        point = np.concatenate(parts).astype(np.float64)
        low, high = np.quantile(point, [0.002, 0.998], axis=0)
        self._point = np.clip(point, low, high)

    def seen(self, eye: Eye) -> Box:
        """Measure it as it is seen: its middle, width and height."""
        middle, extents = np.zeros(3), list[float]()
        for axis in (eye.right, eye.up, eye.ahead):
            along = self._point @ axis
            middle += 0.5 * (along.min() + along.max()) * axis
            extents.append(float(np.ptp(along)))
        return middle, extents[0], extents[1]


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


def have_same_hands(sides: Sides) -> bool:
    """Tell whether both sides show the same hands, so that one is enough in one place."""
    first, second = (
        {
            hand.side: np.asarray(hand.vertex[min(side.content_frame, len(hand.vertex) - 1)])
            for hand in side.content.hands
        }
        for side in sides.values()
    )
    return first.keys() == second.keys() and all(
        first[hand].shape == second[hand].shape
        and np.allclose(first[hand], second[hand], rtol=0.0, atol=_SAME_HAND)
        for hand in first
    )


def written_newtons(sides: Sides, kilograms: float | None) -> dict[str, float]:
    """Find what is written for one newton of each side's model.

    Both sides are of one object, whose models may have different numbers of nodes of 1 kg.

    Args:
        sides: The sides.
        kilograms: What the object weighs; None for what the sides' contents say. If one of them
            does not know, forces of both are written as the models have them.
    """
    newtons: dict[str, float] = dict.fromkeys(SIDE_KEYS, 1.0)
    for key, side in sides.items():
        mass = side.content.mass if kilograms is None else given_mass(kilograms)
        if mass is None:
            return dict.fromkeys(SIDE_KEYS, 1.0)
        if side.rollout is not None:
            newtons[key] = mass.force_factor(side.rollout.model.node_count)
    return newtons


def tinted(color: UInt8[ndarray, "vertex 3"] | None, side: RGB) -> Any:
    """Give a surface the color of its side; its own pattern is seen as lighter and darker parts."""
    if color is None:
        return side
    light = color @ _LIGHTNESS
    middle = float(np.clip(np.median(light), 1.0, 254.0))
    dark = np.minimum(light / middle, 1.0)[:, None]
    bright = np.maximum((light - middle) / (255.0 - middle), 0.0)[:, None]
    return np.round((1.0 - bright) * dark * np.array(side) + 255.0 * bright).astype(np.uint8)


def difference_scale(end: float, length_unit: str) -> ColorScale:
    """Color scale of the difference of A and B, from dark blue (none) to yellow.

    Args:
        end: Distance at the end of the scale [m].
        length_unit: Unit of the content's lengths.
    """
    quantity = in_length_unit(QUANTITIES["difference"], length_unit)
    quantity = replace(quantity, about="Distance of a node from the other side")
    return ColorScale(quantity=quantity, limits=(0.0, end), is_open=True)


def legend_force(force_unit: float, extent: float) -> float:
    """Choose the force of the legend's arrow [N]: 1, 2 or 5 times a power of ten.

    Args:
        force_unit: Length of an arrow of 1 N; 0 where there are no forces, which gives 0 N.
        extent: Size of the scene; the arrow gets at most 0.16 of it.
    """
    if force_unit <= 0:
        return 0.0
    longest = 0.16 * extent / force_unit * 1.000001
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest))
