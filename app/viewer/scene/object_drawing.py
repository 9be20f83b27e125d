"""One object in the scene: its nodes, the springs that join them, what holds it and how hard."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.color.coloring import Painted
from app.viewer.content.layers import (
    BLUE,
    GREY,
    PLAYING_SPRINGS,
    PURPLE,
    RED,
    TEAL,
    YELLOW,
    Layers,
)
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes
from app.viewer.scene.splat_groups import SplatGroups
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.object_surface import ObjectSurface

_PLAIN = (186, 190, 198)
"""Color of a surface that nothing has seen."""

RGB = tuple[int, int, int]

QUIET_FORCE = 1e-6
"""Weaker forces are no forces [N]."""
_SAMPLED_FRAMES = 8
_LEAST_ARROWS = 60
RECENT = 3
"""So many frames long it is shown that something has taken hold of a node, or let it go."""
_OF_RECORDING = 1.4
"""Diameter of control points where there is no object, as a part of the spacing."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Limits on what of an object is sent in a frame; None for no limit."""

    virtual: int | None = None
    """Most virtual springs."""
    springs: int | None = None
    """Most object springs."""
    nodes: int | None = None
    """Most object nodes."""
    arrows: int = 800
    """Most force arrows; the weakest are left out."""


def share_bytes(left: int, rollout: ObjectRollout, layers: Layers, arrows: int) -> Budget:
    """Divide what a playing frame may still weigh between virtual and object springs.

    Args:
        left: Bytes that are left when all points are sent.
        rollout: The rollout.
        layers: Tells whether there are object springs and arrows at all.
        arrows: Most force arrows.
    """
    each = 24 if layers.color == "plain" else 30
    arrows = min(arrows, max(left // (2 * 24), _LEAST_ARROWS))
    count = left // each - (arrows if layers.forces else 0)
    count = min(max(count, PLAYING_SPRINGS // 10), PLAYING_SPRINGS)
    virtual = min(rollout.model.virtual_spring_count, count)
    if layers.object_springs:
        virtual = min(virtual, count // 2)
    return Budget(virtual=max(virtual, 1), springs=max(count - virtual, 1), arrows=arrows)


def strengths(rollout: ObjectRollout) -> Float[ndarray, " node"]:
    """Sample how hard the hands pull and push the nodes that they touch, over the frames [N]."""
    frames = np.unique(np.linspace(0, rollout.ready - 1, _SAMPLED_FRAMES).astype(int))
    strength = np.concatenate([np.linalg.norm(rollout.forces(int(f)), axis=-1) for f in frames])
    return strength[strength > QUIET_FORCE]


def automatic_force_unit(rollout: ObjectRollout | None, framing: Framing) -> float:
    """Choose how long an arrow of 1 N is, so that the strong ones of a rollout are seen well."""
    if rollout is None:
        return 0.0
    strength = strengths(rollout)
    strong = float(np.quantile(strength, 0.9)) if len(strength) else 1.0
    return 0.07 * framing.extent / strong


@dataclass(frozen=True, kw_only=True)
class Style:
    """Drawing style of an object; sizes of nodes are parts of their spacing."""

    is_solid: bool = False
    """Whether nodes are shaded spheres instead of disks, which is heavier to show."""
    node: RGB = BLUE
    """Color of object nodes."""
    control: RGB = RED
    """Color of control nodes."""
    spring: RGB = GREY
    """Color of object springs."""
    virtual: RGB = YELLOW
    """Color of virtual springs."""
    arrow: RGB = RED
    """Color of force arrows."""
    node_size: float = 0.36
    """Diameter of object nodes."""
    control_size: float = 0.3
    """Diameter of control nodes that hold the object."""
    spring_width: float = 1.5
    """Width of object springs in pixels."""
    virtual_width: float = 2.0
    """Width of virtual springs in pixels."""
    arrow_width: float = 0.003
    """Width of force arrows as a part of the scene's extent."""


class ObjectDrawing:
    """Draws the frames of rollouts below one path of the scene; used by one thread."""

    def __init__(
        self, nodes: SceneNodes, framing: Framing, *, root: str = "", style: Style | None = None
    ) -> None:
        """Prepare; nothing is drawn yet.

        Args:
            nodes: The scene's nodes.
            framing: Sizes.
            root: Path below which everything is drawn.
            style: Colors and sizes.
        """
        self._nodes = nodes
        self._framing = framing
        self._root = root
        self._style = style or Style()
        self._balls = nodes.spheres if self._style.is_solid else nodes.points
        self._model_shown: tuple[ObjectRollout, int | None] | None = None
        self._attached: Int[ndarray, " control"] = np.zeros(0, np.int64)

    def attached(
        self, rollout: ObjectRollout, frame: int | None = None
    ) -> Int[ndarray, " control"]:
        """Find the control nodes that hold the object by a virtual spring in a frame, or in any."""
        model = rollout.model
        at = None if model.is_always_attached else frame
        if (rollout, at) != self._model_shown:
            springs = model.spring_nodes[virtual_springs_in(model, at)]
            self._attached = np.unique(springs.max(axis=1, initial=0) - model.node_count)
            self._model_shown = rollout, at
        return self._attached

    def hide(self) -> None:
        """Hide the object until it is drawn again."""
        parts = ("object/", "springs/", "controls/", "contact/", "forces")
        self._nodes.hide(*(f"{self._root}/{part}" for part in parts))

    def draw(
        self,
        rollout: ObjectRollout,
        frame: int,
        layers: Layers,
        budget: Budget,
        *,
        force_unit: float,
        longest: float,
        painted: Painted | None = None,
        surface: ObjectSurface | None = None,
        splats: SplatGroups | None = None,
    ) -> None:
        """Bring the object to a frame.

        Args:
            rollout: The rollout.
            frame: One of its frames.
            layers: What is shown.
            budget: How much may be sent.
            force_unit: Length of an arrow of 1 N.
            longest: No arrow is longer than this.
            painted: Colors of nodes, surface and springs; None for those of the style, and for
                what the surface looks like.
            surface: The object's surface; None if it has none.
            splats: The object's splats; None if it has none.
        """
        root, count = self._root, rollout.model.object_spring_count
        position = np.asarray(rollout.position[frame], dtype=np.float32)
        control = np.asarray(rollout.control[frame], dtype=np.float32)
        style = self._style
        size = style.node_size * self._framing.spacing
        shown = _thinned(len(position), budget.nodes)
        color = style.node if painted is None else painted.node[shown]
        is_visible = layers.nodes
        self._balls(f"{root}/object/nodes", position[shown], color, size, is_visible=is_visible)
        if surface is not None and surface.node_count == len(position):
            self._draw_surface(surface, position, painted, is_visible=layers.surface)
        if splats is not None:
            self._nodes.splats(f"{root}/object/splats", splats, position, is_visible=layers.splats)
        self.draw_controls(control, self.attached(rollout, frame), layers)
        point = np.concatenate([position, control])
        own = np.arange(count)[_thinned(count, budget.springs)]
        held = virtual_springs_in(rollout.model, frame)
        held = held[_thinned(len(held), budget.virtual)]
        for name, chosen, color, width, is_visible in (
            ("virtual", held, style.virtual, style.virtual_width, layers.virtual_springs),
            ("object", own, style.spring, style.spring_width, layers.object_springs),
        ):
            self._nodes.segments(
                f"{root}/springs/{name}",
                point[rollout.model.spring_nodes[chosen if is_visible else chosen[:0]]],
                painted.springs(chosen) if painted is not None else color,
                width,
                is_visible=is_visible,
            )
        self._draw_contact(rollout.model, frame, position, is_visible=layers.forces)
        arrows = np.zeros((0, 2, 3), np.float32)
        if layers.forces:
            unit = force_unit * layers.force_scale
            arrows = force_arrows(rollout, frame, unit, longest, budget.arrows)
        shortest = 0.004 * self._framing.extent
        arrows = arrows[np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=-1) > shortest]
        width = style.arrow_width * self._framing.extent
        self._nodes.arrows(f"{root}/forces", arrows, style.arrow, width)

    def _draw_contact(
        self,
        model: SpringMassModel,
        frame: int,
        position: Float[ndarray, "node 3"],
        *,
        is_visible: bool,
    ) -> None:
        """Mark the nodes that something has just taken hold of or let go."""
        none = np.zeros(0, np.int64)
        begins, ends = contact_changes(model, frame) if is_visible else (none, none)
        size = 0.5 * self._framing.spacing
        for name, node, color in (("begins", begins, TEAL), ("ends", ends, PURPLE)):
            self._nodes.points(
                f"{self._root}/contact/{name}", position[node], color, size, is_visible=is_visible
            )

    def _draw_surface(
        self,
        surface: ObjectSurface,
        position: Float[ndarray, "node 3"],
        painted: Painted | None,
        *,
        is_visible: bool,
    ) -> None:
        name = f"{self._root}/object/surface"
        if not is_visible:
            self._nodes.show(name, is_visible=False)
            return
        color = surface.color if painted is None else painted.vertices(surface)
        vertex = surface.place(position)
        shown = _PLAIN if color is None else color
        self._nodes.mesh(name, vertex, surface.face, shown, is_visible=True, opacity=None)

    def draw_controls(
        self,
        control: Float[ndarray, "control 3"],
        attached: Int[ndarray, " attached"] | None,
        layers: Layers,
    ) -> None:
        """Draw the control nodes, those that hold the object larger than the others."""
        spacing, root, style = self._framing.spacing, self._root, self._style
        held = control if attached is None else control[attached]
        size = (style.control_size if attached is not None else _OF_RECORDING) * spacing
        name = f"{root}/controls/attached"
        self._balls(name, held, style.control, size, is_visible=layers.controls)
        is_shown = layers.all_controls and attached is not None
        free = np.delete(control, attached, axis=0) if is_shown and attached is not None else None
        if free is not None or f"{root}/controls/free" in self._nodes:
            point = np.zeros((0, 3), np.float32) if free is None else free
            name = f"{root}/controls/free"
            self._nodes.points(name, point, style.control, 0.12 * spacing, is_visible=is_shown)


def contact_changes(
    model: SpringMassModel, frame: int
) -> tuple[Int[ndarray, " begun"], Int[ndarray, " ended"]]:
    """Find the nodes that are held in a frame and were not `RECENT` frames ago, and the reverse."""
    if model.is_always_attached:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    held = np.zeros((2, model.node_count), bool)
    for is_held, at in zip(held, (frame, max(frame - RECENT, 0)), strict=True):
        is_held[model.spring_nodes[virtual_springs_in(model, at)].min(axis=1)] = True
    now, before = held
    return np.flatnonzero(now & ~before), np.flatnonzero(before & ~now)


def virtual_springs_in(model: SpringMassModel, frame: int | None) -> Int[ndarray, " spring"]:
    """Find the virtual springs that are attached in a frame, or in any."""
    first = model.object_spring_count
    if frame is None:
        return np.arange(first, len(model.spring_nodes))
    return first + np.flatnonzero(model.acts_in(frame)[first:])


def force_arrows(
    rollout: ObjectRollout, frame: int, force_unit: float, longest: float, most: int
) -> Float[ndarray, "arrow 2 3"]:
    """Lay out the forces that the hands put on the object: through virtual springs, and pushes.

    Args:
        rollout: The rollout.
        frame: One of its frames.
        force_unit: Length of an arrow of 1 N.
        longest: No arrow is longer than this.
        most: The weakest forces beyond this number are left out.

    Returns:
        Start and end of the arrows, the strongest first.
    """
    force = rollout.forces(frame)
    strength = np.linalg.norm(force, axis=-1)
    node = np.flatnonzero(strength > QUIET_FORCE)
    node = node[np.argsort(-strength[node], kind="stable")[:most]]
    offset = force[node] * force_unit
    length = np.linalg.norm(offset, axis=-1, keepdims=True)
    offset *= np.minimum(1.0, longest / np.maximum(length, 1e-12))
    start = np.asarray(rollout.position[frame])[node]
    return np.stack([start, start + offset], axis=1).astype(np.float32)


def _thinned(count: int, most: int | None) -> slice:
    """Choose springs, thinned out evenly to at most `most`."""
    return slice(0, count, 1 if most is None else max(1, -(-count // most)))
