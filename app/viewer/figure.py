"""The paper's comparison of topologies: our result and PhysTwin's way, side by side."""

from dataclasses import dataclass, replace

import numpy as np
import viser
import viser.transforms
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content import Content
from app.viewer.framing import Framing
from app.viewer.layers import BLUE, RED, SKIN, YELLOW, Layers
from app.viewer.nodes import SceneNodes
from app.viewer.object_drawing import ObjectDrawing, share_bytes, strengths
from app.viewer.take import Take

ARROWS = 300
"""Most force arrows of one side."""
FIGURE_BYTES = 92_000
"""What a frame of both sides may weigh while the clock is running."""
SIDES = ("ours", "phystwin")
_SAMPLED_FRAMES = 10
_SAMPLED_POINTS = 300
_GAP = 1.04
_LONGEST = 0.3
_LINE = 0.034


@dataclass(frozen=True, kw_only=True, eq=False)
class Eye:
    """From where a client looks."""

    right: Float[ndarray, " 3"]
    """To the right of the picture."""
    up: Float[ndarray, " 3"]
    """To the top of the picture."""

    @classmethod
    def of(cls, wxyz: Float[ndarray, " 4"]) -> "Eye":
        """Read a camera's orientation; its y axis points down."""
        R_world_camera = viser.transforms.SO3(np.asarray(wxyz, dtype=np.float64)).as_matrix()
        return cls(right=R_world_camera[:, 0], up=-R_world_camera[:, 1])

    @property
    def ahead(self) -> Float[ndarray, " 3"]:
        """Into the picture."""
        return np.cross(self.up, self.right)


@dataclass(frozen=True, kw_only=True, eq=False)
class Side:
    """One half of the figure in one frame."""

    take: Take | None
    """The rollout; None while it is not there."""
    frame: int
    """One of its frames."""
    caption: str
    """What is written above it."""


class Figure:
    """Draws both halves around the middle of the scene, along the client's right hand."""

    def __init__(
        self, server: viser.ViserServer, content: Content, fitted: Take, framing: Framing
    ) -> None:
        """Measure what has to fit; nothing is drawn yet."""
        self._server = server
        self._content = content
        self._framing = framing
        self._nodes = SceneNodes(server)
        self._drawings = {
            side: ObjectDrawing(self._nodes, framing, root=f"/figure/{side}", is_solid=True)
            for side in SIDES
        }
        frames = np.unique(np.linspace(0, fitted.ready - 1, _SAMPLED_FRAMES).astype(int))
        tracks = [fitted.position, fitted.control]
        parts = [np.asarray(track[f]) for track in tracks for f in frames]
        parts = [part[:: max(1, len(part) // _SAMPLED_POINTS)] for part in parts]
        point = np.concatenate(parts).astype(np.float64)
        low, high = np.quantile(point, [0.002, 0.998], axis=0)
        self.center: Float[ndarray, " 3"] = (low + high) / 2
        """Middle of what one half shows, before it is moved aside."""
        self._point = np.clip(point, low, high) - self.center
        self.radius = float(np.linalg.norm(self._point[:, :2], axis=1).max())
        """Half the width of one half, from wherever one looks."""
        self._eye = Eye(right=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 0.0, 1.0]))
        self._captions = dict.fromkeys(SIDES, "")
        self.force_unit = 0.0
        """Length of an arrow of 1 N, before the arrow scale of the panel."""
        self._force_scale = 1.0
        self.measure_forces(fitted)

    def measure_forces(self, *takes: Take) -> None:
        """Choose one arrow scale, in which the strongest force of all rollouts is seen whole."""
        strongest = max((float(strengths(take).max(initial=0.0)) for take in takes), default=0.0)
        self.force_unit = _LONGEST * self._framing.extent / strongest if strongest > 0 else 0.0

    @property
    def scale_force(self) -> float:
        """Force of the arrow in the legend [N]: 1, 2 or 5 times a power of ten."""
        unit = self.force_unit * self._force_scale
        if unit <= 0:
            return 0.0
        wanted = 0.16 * self._framing.extent / unit
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(max(step * power for step in (1, 2, 5) if step * power <= wanted))

    def half_height(self, eye: Eye) -> float:
        """Half the height of one half, as it is seen."""
        return float(np.abs(self._point @ eye.up).max())

    def size(self, eye: Eye) -> tuple[float, float]:
        """Width and height of the whole figure with captions and legend."""
        line = _LINE * self._framing.extent
        return 4 * _GAP * self.radius, 2 * self.half_height(eye) + 9 * line

    def hide(self) -> None:
        """Hide the figure until it is drawn again."""
        with self._server.atomic():
            self._nodes.hide()

    def clear(self) -> None:
        """Remove the figure."""
        self._nodes.clear()

    def turn(self, eye: Eye) -> None:
        """Keep the halves left and right, captions above and legend below, as the camera turns."""
        self._eye = eye
        with self._server.atomic():
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
        self._force_scale = layers.force_scale
        with self._server.atomic():
            self._captions = {name: side.caption for name, side in sides.items()}
            self._place()
            for name, side in sides.items():
                self._draw_hands(f"/figure/{name}", frame, layers)
                if side.take is None:
                    continue
                points = 12 * (side.take.model.node_count + len(self._attached(name, side.take)))
                budget = share_bytes(left - points, side.take, layers, ARROWS)
                if not is_playing:
                    budget = replace(budget, virtual=None, springs=None)
                self._drawings[name].draw(
                    side.take,
                    side.frame,
                    layers,
                    budget,
                    force_unit=self.force_unit,
                    longest=self._framing.extent,
                )

    def _attached(self, name: str, take: Take) -> ndarray:
        return self._drawings[name].attached(take)

    def _hand_size(self) -> int:
        return sum(hand.vertex.shape[1] for hand in self._content.hands)

    def _draw_hands(self, root: str, frame: int, layers: Layers) -> None:
        for hand in self._content.hands:
            if hand.face is not None:
                vertex = np.asarray(hand.vertex[min(frame, len(hand.vertex) - 1)], np.float32)
                name, color = f"{root}/hand/{hand.side}", SKIN[hand.side]
                is_visible = layers.hands
                self._nodes.mesh(
                    name, vertex, hand.face, color, is_visible=is_visible, opacity=0.35
                )

    def _place(self) -> None:
        """Put the halves, their captions and the legend where the camera sees them."""
        eye, nodes, line = self._eye, self._nodes, _LINE * self._framing.extent
        height = self.half_height(eye)
        for sign, name in zip((-1.0, 1.0), SIDES, strict=True):
            aside = sign * _GAP * self.radius * eye.right
            nodes.frame(f"/figure/{name}", aside)
            above = self.center + aside + (height + 2.2 * line) * eye.up
            nodes.label(
                f"/figure/caption_{name}",
                self._captions[name],
                above,
                anchor="center-center",
                height=line,
            )
        self._place_legend(self.center - (height + 2.2 * line) * eye.up, line)

    def _place_legend(self, middle: Float[ndarray, " 3"], line: float) -> None:
        """Tell below the halves what the colors mean and how strong a force an arrow is."""
        eye, nodes, root = self._eye, self._nodes, "/figure/legend"
        force = self.scale_force
        length = force * self.force_unit * self._force_scale
        entries = ["object nodes", "control nodes", "virtual springs", f"force, {force:g} N"]
        widths = [1.0 * line, 1.0 * line, 2.0 * line, length]
        texts = [0.52 * line * len(text) for text in entries]
        total = sum(widths) + sum(texts) + 1.6 * line * 3 + 0.7 * line * 4
        x = -total / 2
        for index, (text, width) in enumerate(zip(entries, widths, strict=True)):
            start = middle + x * eye.right
            end = start + width * eye.right
            if index < 2:
                ball = ((start + end) / 2)[None]
                color = (BLUE, RED)[index]
                nodes.spheres(f"{root}/ball_{index}", ball, color, 0.7 * line, is_visible=True)
            elif index == 2:
                nodes.segments(
                    f"{root}/spring", np.stack([start, end])[None], YELLOW, 3.0, is_visible=True
                )
            elif force > 0:
                arrow = np.stack([start, end])[None].astype(np.float32)
                nodes.arrows(f"{root}/force", arrow, RED, 0.0022 * self._framing.extent)
            x += width + 0.7 * line
            nodes.label(
                f"{root}/text_{index}",
                text,
                middle + x * eye.right,
                anchor="center-left",
                height=0.8 * line,
            )
            x += texts[index] + 1.6 * line
