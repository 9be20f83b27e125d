"""The nodes of one session's scene and how they follow the frames."""

from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.cameras import CameraNodes
from app.viewer.content import Content
from app.viewer.framing import Framing
from app.viewer.nodes import SceneNodes
from app.viewer.skeleton import BONES
from app.viewer.take import Take

BLUE = (47, 111, 222)
RED = (214, 39, 40)
GREEN = (46, 160, 67)
YELLOW = (245, 190, 20)
GREY = (120, 130, 145)
SKIN = {"right": (224, 172, 140), "left": (205, 150, 122)}

PLAYING_SPRINGS = 2_000
"""Most springs that are streamed while the clock is running."""
FRAME_BYTES = 92_000
"""What a frame may weigh while the clock is running; springs and arrows give way."""
_ARROWS = 800
_PLAYING_ARROWS = 400
_PLAYING_OBSERVED = 2_000
_QUIET_FORCE = 1e-6


@dataclass
class Layers:
    """Which parts of the scene are shown."""

    hands: bool = True
    """Hand meshes."""
    nodes: bool = True
    """Object nodes."""
    controls: bool = True
    """Control nodes that hold the object by a virtual spring."""
    all_controls: bool = False
    """Control nodes that hold nothing."""
    virtual_springs: bool = True
    """Springs between control nodes and object nodes."""
    object_springs: bool = False
    """Springs between object nodes."""
    forces: bool = True
    """Sum of the virtual springs' forces on each object node."""
    observed: bool = False
    """Observed points."""
    cameras: bool = True
    """Camera frustums with the frame's image."""
    ground: bool = True
    """Grid on the ground, or below everything if the ground is not known."""
    looks_from: str | None = None
    """View whose image is the backdrop."""
    dark: bool = False
    """Dark background."""
    force_scale: float = 1.0
    """Length of the force arrows, relative to the automatic one."""


class Scene:
    """Draws frames into a viser server; used by one thread."""

    def __init__(self, server: viser.ViserServer, content: Content, framing: Framing) -> None:
        self._server = server
        self._content = content
        self._framing = framing
        self.layers = default_layers(content)
        self._nodes = SceneNodes(server)
        self._model_shown: Take | None = None
        self._attached: Int[ndarray, " control"] = np.zeros(0, np.int64)
        self._force_unit = self._choose_force_unit()
        self._cameras = CameraNodes(server, content.views, framing)
        self._aim()
        self._add_ground()

    def clear(self) -> None:
        """Remove everything, to make room for another content."""
        self._nodes.clear()
        self._cameras.remove()

    def draw(self, frame: int, take: Take | None, take_frame: int, *, is_playing: bool) -> None:
        """Bring the scene to a frame.

        Args:
            frame: Frame of hands, observation and cameras.
            take: The object's rollout; None without an object.
            take_frame: Frame of the rollout, which may lag behind while it is being computed.
            is_playing: Whether the clock is running, so that less may be sent.
        """
        with self._server.atomic():
            self._draw_hands(frame)
            self._draw_observed(frame, is_playing)
            if take is not None and take.ready > 0:
                self._draw_object(take, take_frame, is_playing)
            elif self._content.control is not None:
                self._draw_controls(np.asarray(self._content.control[frame]), None)
            self._cameras.draw(
                frame,
                is_visible=self.layers.cameras,
                looks_from=self.layers.looks_from,
                is_playing=is_playing,
            )
            self._nodes.show("/ground", is_visible=self.layers.ground)
            self._nodes.color_ground("/ground", is_dark=self.layers.dark)

    def _aim(self) -> None:
        camera = self._server.initial_camera
        camera.fov = self._framing.fov
        camera.near = 0.005 * self._framing.extent
        camera.far = 200.0 * self._framing.extent
        camera.look_at = self._framing.look_at
        camera.position = self._framing.camera

    def _choose_force_unit(self) -> float:
        """Choose how long an arrow of 1 N is, from the fitted rollout."""
        take = self._content.fitted
        if take is None:
            return 0.0
        frames = np.unique(np.linspace(0, take.ready - 1, 8).astype(int))
        strength = np.concatenate([np.linalg.norm(take.forces(int(f)), axis=-1) for f in frames])
        strength = strength[strength > _QUIET_FORCE]
        strong = float(np.quantile(strength, 0.9)) if len(strength) else 1.0
        return 0.07 * self._framing.extent / strong

    def _add_ground(self) -> None:
        height, extent = self._content.ground_height, self._framing.extent
        if height is None:
            height = self._framing.low - 0.02 * extent
        power = 10.0 ** float(np.floor(np.log10(extent / 3)))
        cell = max(step * power for step in (1, 2, 5) if step * power <= extent / 3)
        x, y = (round(float(self._framing.center[axis]) / cell) * cell for axis in (0, 1))
        count = int(np.ceil(4 * extent / cell))
        self._nodes.ground("/ground", (x, y, float(height) - 0.001 * extent), cell, count)

    def _draw_hands(self, frame: int) -> None:
        is_visible = self.layers.hands
        for hand in self._content.hands:
            vertex = np.asarray(hand.vertex[min(frame, len(hand.vertex) - 1)], dtype=np.float32)
            name, color = f"/hand/{hand.side}", SKIN[hand.side]
            if hand.face is None:
                size = 0.006 * self._framing.extent
                self._nodes.points(name, vertex, color, size, is_visible=is_visible)
            else:
                self._nodes.mesh(name, vertex, hand.face, color, is_visible=is_visible)
        for index, skeleton in enumerate(self._content.skeletons):
            bones = skeleton[frame][BONES]
            bones = bones[np.isfinite(bones).all(axis=(1, 2))]
            self._nodes.segments(
                f"/hand/skeleton_{index}", bones, SKIN["right"], 4.0, is_visible=is_visible
            )

    def _draw_observed(self, frame: int, is_playing: bool) -> None:
        observed = self._content.observed
        if observed is None or not self.layers.observed:
            self._nodes.show("/observed", is_visible=False)
            return
        point = observed.points(frame)
        color = observed.colors()
        every = max(1, -(-len(point) // _PLAYING_OBSERVED)) if is_playing else 1
        color = color[::every] if color.ndim == 2 else color
        size = 0.4 * self._framing.spacing
        self._nodes.points("/observed", point[::every], color, size, is_visible=True)

    def _draw_object(self, take: Take, frame: int, is_playing: bool) -> None:
        position = np.asarray(take.position[frame], dtype=np.float32)
        control = np.asarray(take.control[frame], dtype=np.float32)
        if take is not self._model_shown:
            springs = take.model.spring_nodes[take.model.object_spring_count :]
            self._attached = np.unique(springs.max(axis=1) - take.model.node_count)
            self._model_shown = take
        size = 0.36 * self._framing.spacing
        self._nodes.points("/object/nodes", position, BLUE, size, is_visible=self.layers.nodes)
        self._draw_controls(control, self._attached)
        point = np.concatenate([position, control])
        count = take.model.object_spring_count
        virtual_most, object_most = self._spring_budget(take) if is_playing else (None, None)
        self._nodes.segments(
            "/springs/virtual",
            _ends(point, take.model.spring_nodes[count:], virtual_most),
            YELLOW,
            2.0,
            is_visible=self.layers.virtual_springs,
        )
        self._nodes.segments(
            "/springs/object",
            _ends(point, take.model.spring_nodes[:count], object_most)
            if self.layers.object_springs
            else np.zeros((0, 2, 3), np.float32),
            GREY,
            1.5,
            is_visible=self.layers.object_springs,
        )
        self._draw_forces(take, frame, position, _PLAYING_ARROWS if is_playing else _ARROWS)

    def _spring_budget(self, take: Take) -> tuple[int, int]:
        """Share what is left of a frame's bytes between virtual and object springs."""
        layers = self.layers
        point_count = len(self._attached)
        point_count += take.model.node_count if layers.nodes else 0
        point_count += take.model.control_count if layers.all_controls else 0
        point_count += _PLAYING_OBSERVED if layers.observed else 0
        if layers.hands:
            point_count += sum(hand.vertex.shape[1] for hand in self._content.hands)
        arrow_count = _PLAYING_ARROWS if layers.forces else 0
        left = (FRAME_BYTES - 12 * point_count) // 24 - arrow_count
        left = min(max(left, PLAYING_SPRINGS // 10), PLAYING_SPRINGS)
        virtual = min(take.model.virtual_spring_count, left)
        if layers.object_springs:
            virtual = min(virtual, left // 2)
        return max(virtual, 1), max(left - virtual, 1)

    def _draw_controls(
        self, control: Float[ndarray, "control 3"], attached: Int[ndarray, " attached"] | None
    ) -> None:
        spacing = self._framing.spacing
        held = control if attached is None else control[attached]
        self._nodes.points(
            "/controls/attached", held, RED, 0.3 * spacing, is_visible=self.layers.controls
        )
        is_shown = self.layers.all_controls and attached is not None
        free = np.delete(control, attached, axis=0) if is_shown and attached is not None else None
        if free is not None or "/controls/free" in self._nodes:
            point = np.zeros((0, 3), np.float32) if free is None else free
            self._nodes.points("/controls/free", point, RED, 0.12 * spacing, is_visible=is_shown)

    def _draw_forces(
        self, take: Take, frame: int, position: Float[ndarray, "node 3"], most: int
    ) -> None:
        arrows = np.zeros((0, 2, 3), np.float32)
        if self.layers.forces:
            force = take.forces(frame)
            strength = np.linalg.norm(force, axis=-1)
            node = np.flatnonzero(strength > _QUIET_FORCE)
            node = node[np.argsort(-strength[node], kind="stable")[:most]]
            offset = force[node] * (self._force_unit * self.layers.force_scale)
            length = np.linalg.norm(offset, axis=-1, keepdims=True)
            longest = 0.22 * self._framing.extent
            offset *= np.minimum(1.0, longest / np.maximum(length, 1e-12))
            arrows = np.stack([position[node], position[node] + offset], axis=1)
            arrows = arrows[length[:, 0] > 0.004 * self._framing.extent].astype(np.float32)
        self._nodes.arrows("/forces", arrows, RED, 0.0022 * self._framing.extent)


def default_layers(content: Content) -> Layers:
    """Choose what is shown at first: the result if there is one, else the recording."""
    has_object = content.fitted is not None
    return Layers(
        observed=not has_object,
        cameras=not has_object and bool(content.views),
        object_springs=content.fitted is not None and _has_few_springs(content.fitted),
    )


def _has_few_springs(take: Take) -> bool:
    """Tell whether all springs fit into a playing frame; they make nodes read as cloth or rope."""
    return take.model.object_spring_count <= PLAYING_SPRINGS


def _ends(
    point: Float[ndarray, "point 3"], spring_nodes: Int[ndarray, "spring 2"], most: int | None
) -> Float[ndarray, "segment 2 3"]:
    """Look up the end points of springs, thinned out evenly to at most `most`."""
    every = 1 if most is None else max(1, -(-len(spring_nodes) // most))
    return point[spring_nodes[::every]]
