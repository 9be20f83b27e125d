"""The nodes of one session's scene and how they follow the frames."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.color.coloring import Painted, Painter
from app.viewer.color.hand_coloring import HandPainter
from app.viewer.content.content import Content
from app.viewer.content.layers import (
    GREEN,
    GREY,
    SKIN,
    Layers,
    default_layers,
    with_surface_for_splats,
)
from app.viewer.content.observed import BONES
from app.viewer.scene.cameras import BACKDROP_BYTES, CameraNodes
from app.viewer.scene.framing import Framing, pose_of_view
from app.viewer.scene.nodes import SceneNodes
from app.viewer.scene.object_drawing import (
    Budget,
    ObjectDrawing,
    automatic_force_unit,
    share_bytes,
)
from app.viewer.scene.splat_groups import SplatGroups
from physhandi.object_rollout import ObjectRollout

FRAME_BYTES = 92_000
"""Largest size of a frame while playing [bytes]; springs and arrows are left out first."""
_ARROWS = 800
_PLAYING_ARROWS = 400
_PLAYING_OBSERVED = 2_000
_SUNK, _SUNK_FOR_SPLATS = 0.001, 0.015
"""Distance of the grid below the ground, in the scene's extent: splats of what lies there reach
below it, and lines would be seen through them."""
_GROUP_BYTES = 70
"""Size of the packed pose of a group of splats [bytes]."""
_LEAST_BYTES = 12_000
"""Springs and arrows get at least this much of a playing frame."""
_OBSERVED = 0.1
"""Diameter of other observed points, in distances between nodes: through them all is seen."""
_SEE_THROUGH = 0.62
"""Opacity of hands through which nodes and springs are seen."""
_FEW_POINTS = 100
"""So few observed points are markers, and drawn larger."""


class SceneDrawing:
    """Draws frames into a viser server; used by one thread."""

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        framing: Framing,
        *,
        frame_bytes: int = FRAME_BYTES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare to draw.

        Args:
            server: Where to.
            content: What can be shown.
            framing: Sizes.
            frame_bytes: What a frame may weigh while the clock is running.
            clock: Tells when the pictures of the cameras are due again [s].
        """
        self._frame_bytes = frame_bytes
        self._server = server
        self._content = content
        self._framing = framing
        self.layers = default_layers(content)
        self._nodes = SceneNodes(server)
        self._object = ObjectDrawing(self._nodes, framing)
        self._splats: SplatGroups | None = None
        self._force_unit = automatic_force_unit(content.fitted, framing)
        self.painter = Painter(content)
        self.hand_painter = HandPainter(content)
        self._cameras = CameraNodes(server, content.views, framing, clock)
        self._aim()
        add_ground(self._nodes, content, framing)

    def clear(self) -> None:
        """Remove everything, to make room for another content."""
        self._nodes.clear()
        self._cameras.remove()

    def draw(
        self,
        frame: int,
        rollout: ObjectRollout | None,
        rollout_frame: int,
        *,
        is_playing: bool,
        hands: Mapping[str, Float[ndarray, "vertex 3"]] | None = None,
    ) -> None:
        """Bring the scene to a frame.

        Args:
            frame: Frame of hands, observation and cameras.
            rollout: The object's rollout; None without an object.
            rollout_frame: Frame of the rollout, which may lag behind while it is being computed.
            is_playing: Whether the clock is running, so that less may be sent.
            hands: Where hands are that are steered, by their sides [m]; what was observed is not
                shown beside them, since nobody has seen that.
        """
        rollout = rollout if rollout is not None and rollout.ready > 0 else None
        self.painter.weigh(self.layers.mass)
        layers = self.layers if hands is None else _without_observed(self.layers)
        if layers.splats and not self._has_splats(rollout, layers):
            layers = with_surface_for_splats(layers)
        painted = None if rollout is None else self.painter.paint(rollout, rollout_frame, layers)
        with self._server.atomic():
            self._draw_hands(frame, hands)
            if layers.observed:
                self._draw_observed(frame, is_playing, painted, rollout, rollout_frame)
            else:
                self._nodes.hide("/observed", "/markers")
            if rollout is not None:
                self._object.draw(
                    rollout,
                    rollout_frame,
                    layers,
                    self._budget(rollout, layers) if is_playing else Budget(arrows=_ARROWS),
                    force_unit=self._force_unit,
                    longest=0.22 * self._framing.extent,
                    painted=painted,
                    surface=self._content.surface,
                    splats=self._splats,
                )
            elif self._content.control is not None:
                control = np.asarray(self._content.control[frame], dtype=np.float32)
                self._object.draw_controls(control, None, self.layers)
            self._cameras.draw(
                frame,
                is_visible=self.layers.cameras,
                looks_from=self.layers.looks_from,
                is_playing=is_playing,
            )
            self._draw_ground(rollout, has_splats=layers.splats)
            self._nodes.color_ground("/ground", is_dark=self.layers.dark)

    def hide(self) -> None:
        """Hide everything until the next frame is drawn."""
        with self._server.atomic():
            self._nodes.hide()
            self._cameras.hide()

    def _aim(self) -> None:
        camera = self._server.initial_camera
        camera.fov = self._framing.fov
        camera.near = 0.005 * self._framing.extent
        camera.far = 200.0 * self._framing.extent
        camera.look_at = self._framing.look_at
        camera.position = self._framing.camera
        for view in self._content.views:
            if view.name == self.layers.looks_from:
                pose_of_view(view, self._framing).give_first(camera)

    def _draw_ground(self, rollout: ObjectRollout | None, *, has_splats: bool) -> None:
        """Lay the grid where the rollout's ground is; a grid that is mere decoration stays.

        Before a picture of the scene there is none: that shows what the hands are above.
        """
        recorded = self._content.ground_height
        height = recorded if rollout is None else rollout.parameters.ground_height
        is_there = height is not None or recorded is None
        if height is not None:
            sunk = _SUNK_FOR_SPLATS if has_splats else _SUNK
            self._nodes.lift("/ground", height - sunk * self._framing.extent)
        is_visible = self.layers.ground and is_there and self.layers.looks_from is None
        self._nodes.show("/ground", is_visible=is_visible)

    def _draw_hands(
        self, frame: int, steered: Mapping[str, Float[ndarray, "vertex 3"]] | None
    ) -> None:
        is_visible = self.layers.hands
        painted = self.hand_painter.paint(frame, self.layers)
        for hand in self._content.hands:
            recorded = hand.vertex[min(frame, len(hand.vertex) - 1)]
            vertex = np.asarray(
                recorded if steered is None else steered[hand.side], dtype=np.float32
            )
            name, color = f"/hand/{hand.side}", SKIN[hand.side]
            if hand.face is None:
                size = 0.006 * self._framing.extent
                self._nodes.points(name, vertex, color, size, is_visible=is_visible)
            else:
                of_hand = painted.get(hand.side)
                is_plain = is_visible and of_hand is None
                self._nodes.mesh(
                    name, vertex, hand.face, color, is_visible=is_plain, opacity=self._hand_opacity
                )
                is_painted = is_visible and of_hand is not None
                color = SKIN[hand.side] if of_hand is None else of_hand.node
                name = f"/skin/{hand.side}"
                self._nodes.mesh(
                    name, vertex, hand.face, color, is_visible=is_painted, opacity=None
                )
        for index, skeleton in enumerate(self._content.skeletons):
            bones = skeleton[frame][BONES]
            bones = bones[np.isfinite(bones).all(axis=(1, 2))]
            self._nodes.segments(
                f"/hand/skeleton_{index}", bones, SKIN["right"], 4.0, is_visible=is_visible
            )

    @property
    def _hand_opacity(self) -> float | None:
        """Opacity of hands; None if nothing, overlay or video, is to be seen through them."""
        layers = self.layers
        has_overlay = layers.nodes or layers.controls or layers.virtual_springs
        has_overlay = self._content.fitted is not None and (has_overlay or layers.all_controls)
        is_over = has_overlay or layers.looks_from is not None
        return _SEE_THROUGH if is_over else None

    def _draw_observed(
        self,
        frame: int,
        is_playing: bool,
        painted: Painted | None,
        rollout: ObjectRollout | None,
        rollout_frame: int,
    ) -> None:
        """Draw what was seen; colored by error, its points tell their own."""
        observed = self._content.observed
        self._draw_lines_of_markers(frame, rollout, rollout_frame)
        if observed is None:
            return
        point = observed.points(frame)
        color = observed.colors()
        every = max(1, -(-len(point) // _PLAYING_OBSERVED)) if is_playing else 1
        color = color[::every] if color.ndim == 2 else color
        if painted is not None and rollout is not None and self.layers.color == "error":
            distance = self.painter.errors.points(point[::every], rollout, rollout_frame)
            color = painted.scale.paint(distance)
        is_few = len(point) <= _FEW_POINTS
        size = 0.012 * self._framing.extent if is_few else _OBSERVED * self._framing.spacing
        self._nodes.points("/observed", point[::every], color, size, is_visible=True)

    def _draw_lines_of_markers(
        self, frame: int, rollout: ObjectRollout | None, rollout_frame: int
    ) -> None:
        """Join the markers of a recording, or each one with the node that should be there."""
        markers, tracks = self._content.markers, self._content.tracks
        is_visible = self.layers.observed
        if markers is not None:
            line = markers.segments(frame)
            self._nodes.segments("/markers/line", line, GREY, 2.5, is_visible=is_visible)
        if rollout is None or tracks is None or tracks.node is None or frame >= len(tracks.point):
            self._nodes.show("/markers/offset", is_visible=False)
            return
        marker = np.asarray(tracks.point[frame], dtype=np.float32)
        node = np.asarray(rollout.position[rollout_frame], dtype=np.float32)[tracks.node]
        is_seen = np.asarray(tracks.is_visible[frame]) & np.isfinite(marker).all(axis=-1)
        line = np.stack([marker, node], axis=1)[is_seen]
        self._nodes.segments("/markers/offset", line, GREEN, 2.0, is_visible=is_visible)

    def _has_splats(self, rollout: ObjectRollout | None, layers: Layers) -> bool:
        """Tell whether the object can be shown as splats, and get them ready."""
        splats = self._content.splats
        if splats is None or rollout is None or layers.color != "plain":
            return False
        if self._splats is None:
            self._splats = SplatGroups.of(splats)
        return len(splats.rest_node) == rollout.model.node_count

    def _budget(self, rollout: ObjectRollout, layers: Layers) -> Budget:
        """Share what the points of a playing frame leave of its bytes."""
        point_count = len(self._object.attached(rollout))
        colored = 0 if layers.color == "plain" else rollout.model.node_count // 4
        point_count += rollout.model.node_count + colored if layers.nodes else 0
        point_count += rollout.model.control_count if layers.all_controls else 0
        point_count += _PLAYING_OBSERVED if layers.observed else 0
        if layers.hands:
            point_count += sum(hand.vertex.shape[1] for hand in self._content.hands)
        surface = self._content.surface
        if layers.surface and surface is not None:
            point_count += surface.vertex_count
            point_count += 0 if layers.color == "plain" else surface.vertex_count // 4
        left = self._frame_bytes - 12 * point_count
        if layers.splats and self._splats is not None:
            left -= _GROUP_BYTES * self._splats.count
        left -= BACKDROP_BYTES if layers.looks_from is not None else 0
        budget = share_bytes(left, rollout, layers, _PLAYING_ARROWS)
        if left >= _LEAST_BYTES or not layers.surface:
            return budget
        # Nodes on a surface are seen by its color anyway.
        most = max(rollout.model.node_count - (_LEAST_BYTES - left) // 12, 1)
        return replace(budget, nodes=most)


def _without_observed(layers: Layers) -> Layers:
    """Leave out what was observed, and colors that compare with it or with what was fitted."""
    is_compared = layers.color in {"error", "difference"}
    return replace(layers, observed=False, color="plain" if is_compared else layers.color)


def grid_cell(extent: float) -> float:
    """Choose the distance of the grid's lines: a round number below a third of the scene."""
    power = 10.0 ** float(np.floor(np.log10(extent / 3)))
    return max(step * power for step in (1, 2, 5) if step * power <= extent / 3)


def add_ground(
    nodes: SceneNodes, content: Content, framing: Framing, name: str = "/ground"
) -> None:
    """Draw a grid on the ground; below everything if the ground is not known."""
    height, extent = content.ground_height, framing.extent
    if height is None:
        height = framing.low - 0.02 * extent
    cell = grid_cell(extent)
    x, y = (round(float(framing.center[axis]) / cell) * cell for axis in (0, 1))
    count = int(np.ceil(4 * extent / cell))
    nodes.ground(name, (x, y, float(height) - _SUNK * extent), cell, count)
