"""The paper's comparison of topologies: our result and PhysTwin's way, side by side."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.compare.figure_camera import Eye
from app.viewer.content.content import Content
from app.viewer.content.layers import SKIN, YELLOW, Layers
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes
from app.viewer.scene.object_drawing import ObjectDrawing, Style, share_bytes, strengths
from physhandi.object_rollout import ObjectRollout

GAP = 1.08
"""Distance of the middles of two halves, as a multiple of a half's width."""
_SAMPLED_FRAMES = 10
_SAMPLED_POINTS = 300


class Extents:
    """Sampled points of all that moves in a half, without its few farthest ones."""

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

    def seen(self, eye: Eye) -> tuple[Float[ndarray, " 3"], float, float]:
        """Measure it as it is seen: its middle, width and height."""
        middle, extents = np.zeros(3), list[float]()
        for axis in (eye.right, eye.up, eye.ahead):
            along = self._point @ axis
            middle += 0.5 * (along.min() + along.max()) * axis
            extents.append(float(np.ptp(along)))
        return middle, extents[0], extents[1]


ARROWS = 300
"""Most force arrows of one side."""
FIGURE_BYTES = 92_000
"""What a frame of both sides may weigh while the clock is running."""
SIDES = ("ours", "phystwin")
_NARROWEST = 13.0
_ABOVE, _BELOW = 4.0, 2.6
_LONGEST = 0.3
_LINE = 0.034
_STYLE = Style(
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Side:
    """One half of the figure in one frame."""

    rollout: ObjectRollout | None
    """The rollout; None while it is not there."""
    frame: int
    """One of its frames."""
    caption: str
    """What is written above it."""


class Figure:
    """Draws both halves around the middle of the scene, along the client's right hand.

    The thread of the clock draws; a camera may turn the figure from another one.
    """

    def __init__(
        self, server: viser.ViserServer, content: Content, fitted: ObjectRollout, framing: Framing
    ) -> None:
        """Measure what has to fit; nothing is drawn yet."""
        self._server = server
        self._content = content
        self._framing = framing
        self._nodes = SceneNodes(server)
        self._drawings = {
            side: ObjectDrawing(self._nodes, framing, root=f"/figure/{side}", style=_STYLE)
            for side in SIDES
        }
        self._extents = Extents([fitted.position, fitted.control], fitted.ready)
        self._eye = Eye(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 0.0, 1.0]))
        self._captions = dict.fromkeys(SIDES, "")
        self._placed: tuple[tuple[float, ...], tuple[str, ...]] | None = None
        self._lock = threading.RLock()
        self.force_unit = 0.0
        """Length of an arrow of 1 N, before the arrow scale of the panel."""
        self._force_scale = 1.0
        self.measure_forces(fitted)

    def measure_forces(self, *rollouts: ObjectRollout) -> None:
        """Choose one arrow scale, in which the strongest force of all rollouts is seen whole."""
        strongest = max(
            (float(strengths(rollout).max(initial=0.0)) for rollout in rollouts), default=0.0
        )
        self.force_unit = _LONGEST * self._framing.extent / strongest if strongest > 0 else 0.0

    @property
    def scale_force(self) -> float:
        """Force of the arrow in the legend [N]: 1, 2 or 5 times a power of ten."""
        unit = self.force_unit * self._force_scale
        if unit <= 0:
            return 0.0
        wanted = 0.16 * self._framing.extent / unit
        power = 10.0 ** np.floor(np.log10(wanted * 1.000001))
        return float(max(step * power for step in (1, 2, 5) if step * power <= wanted * 1.000001))

    def box(self, eye: Eye) -> tuple[Float[ndarray, " 3"], float, float]:
        """Measure the whole figure with captions and legend, as it is seen.

        Returns:
            Middle, width and height.
        """
        middle, wide, high = self._extents.seen(eye)
        line = self._line
        middle = middle + 0.5 * (_ABOVE - _BELOW) * line * eye.up
        return middle, 2 * GAP * max(wide, _NARROWEST * line), high + (_ABOVE + _BELOW) * line

    @property
    def _line(self) -> float:
        return _LINE * self._framing.extent

    def hide(self) -> None:
        """Hide the figure until it is drawn again."""
        with self._lock, self._server.atomic():
            self._placed = None
            self._nodes.hide()

    def clear(self) -> None:
        """Remove the figure."""
        with self._lock:
            self._placed = None
            self._nodes.clear()

    def turn(self, eye: Eye) -> None:
        """Keep the halves left and right, captions above and legend below, as the camera turns."""
        with self._lock, self._server.atomic():
            self._eye = eye
            if self._placed is not None:
                self._place()

    def draw(self, sides: dict[str, Side], frame: int, layers: Layers, *, is_playing: bool) -> None:
        """Bring both halves to a frame.

        Args:
            sides: The halves by their names, ``ours`` on the left and ``phystwin`` on the right.
            frame: Frame of the hands.
            layers: What is shown.
            is_playing: Whether the clock is running, so that less may be sent.
        """
        left = FIGURE_BYTES // 2 - (12 * self._hand_size() if layers.hands else 0)
        with self._lock, self._server.atomic():
            self._force_scale = layers.force_scale
            self._captions = {name: side.caption for name, side in sides.items()}
            self._place()
            for name, side in sides.items():
                self._draw_hands(f"/figure/{name}", frame, layers)
                if side.rollout is None:
                    continue
                points = 12 * (
                    side.rollout.model.node_count + len(self._attached(name, side.rollout))
                )
                budget = share_bytes(left - points, side.rollout, layers, ARROWS)
                if not is_playing:
                    budget = replace(budget, virtual=None, springs=None)
                self._drawings[name].draw(
                    side.rollout,
                    side.frame,
                    layers,
                    budget,
                    force_unit=self.force_unit,
                    longest=self._framing.extent,
                )

    def _attached(self, name: str, rollout: ObjectRollout) -> ndarray:
        return self._drawings[name].attached(rollout)

    def _hand_size(self) -> int:
        return sum(hand.vertex.shape[1] for hand in self._content.hands)

    def _draw_hands(self, root: str, frame: int, layers: Layers) -> None:
        for hand in self._content.hands:
            if hand.face is not None:
                vertex = np.asarray(hand.vertex[min(frame, len(hand.vertex) - 1)], np.float32)
                name, color = f"{root}/hand/{hand.side}", SKIN[hand.side]
                is_visible = layers.hands
                self._nodes.mesh(name, vertex, hand.face, color, is_visible=is_visible, opacity=0.3)

    def _place(self) -> None:
        """Put the halves, their captions and the legend where the camera sees them."""
        eye, nodes, line = self._eye, self._nodes, self._line
        looks = (*eye.right, *eye.up, self.force_unit * self._force_scale)
        placed = (looks, tuple(self._captions.values()))
        if placed == self._placed:
            return
        self._placed = placed
        middle, wide, high = self._extents.seen(eye)
        wide = max(wide, _NARROWEST * line)
        for sign, name in zip((-1.0, 1.0), SIDES, strict=True):
            aside = 0.5 * sign * GAP * wide * eye.right
            nodes.frame(f"/figure/{name}", aside)
            title, _, detail = self._captions[name].partition("\n")
            for part, text, size, lines in (
                ("title", title, 1.2, 2.9),
                ("detail", detail, 0.9, 1.5),
            ):
                nodes.label(
                    f"/figure/{part}_{name}",
                    text,
                    middle + aside + (0.5 * high + lines * line) * eye.up,
                    anchor="center-center",
                    height=size * line,
                )
        self._place_legend(middle - (0.5 * high + 1.6 * line) * eye.up, line)

    def _place_legend(self, middle: Float[ndarray, " 3"], line: float) -> None:
        """Tell below the halves what the colors mean and how strong a force an arrow is."""
        eye, nodes, root = self._eye, self._nodes, "/figure/legend"
        force = self.scale_force
        texts = ("object nodes", "control nodes", "virtual springs", f"force, {force:g} N")
        length = force * self.force_unit * self._force_scale
        widths = (0.7 * line, 0.7 * line, 1.8 * line, length)
        letters = [0.36 * len(text) * line for text in texts]
        spans = [w + 0.5 * line + letter for w, letter in zip(widths, letters, strict=True)]
        x = -0.5 * (sum(spans) + 3 * line)
        for index, (text, width, span) in enumerate(zip(texts, widths, spans, strict=True)):
            start, end = (middle + at * eye.right for at in (x, x + width))
            if index < 2:
                color = (_STYLE.node, _STYLE.control)[index]
                ball = ((start + end) / 2)[None]
                nodes.spheres(f"{root}/ball_{index}", ball, color, width, is_visible=True)
            elif index == 2:
                segment = np.stack([start, end])[None]
                nodes.segments(f"{root}/spring", segment, YELLOW, 3.0, is_visible=True)
            elif force > 0:
                arrow = np.stack([start, end])[None].astype(np.float32)
                thick = _STYLE.arrow_width * self._framing.extent
                nodes.arrows(f"{root}/force", arrow, _STYLE.arrow, thick)
            place = middle + (x + width + 0.5 * line) * eye.right
            name = f"{root}/text_{index}"
            nodes.label(name, text, place, anchor="center-left", height=0.75 * line)
            x += span + line
