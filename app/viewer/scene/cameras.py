"""Camera frustums with the frame's image in them."""

import time
from collections.abc import Callable
from collections.abc import Sequence as Listing

import cv2
import numpy as np
import viser
import viser.transforms
from jaxtyping import UInt8
from numpy import ndarray

from app.viewer.content.session_state import Pose
from app.viewer.scene.framing import Framing
from physhandi.data.view import View

_WIDTH = 320
_PAUSED_WIDTH = 640
_IMAGE_INTERVAL = 0.15
_COLOR = (90, 100, 118)


class CameraNodes:
    """The frustums of all views; used by one thread."""

    def __init__(
        self,
        server: viser.ViserServer,
        views: Listing[View],
        framing: Framing,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._server = server
        self._views = list(views)
        self._framing = framing
        self._scale = framing.frustum
        self._nodes: list[viser.CameraFrustumHandle] = []
        self._shown: tuple[int, int] | None = None
        self._time = 0.0

    def remove(self) -> None:
        """Take the frustums out of the scene."""
        for node in self._nodes:
            node.remove()
        self._nodes.clear()
        self._shown = None

    def hide(self) -> None:
        """Hide the frustums."""
        for node in self._nodes:
            node.visible = False

    def draw(
        self, frame: int, *, is_visible: bool, looks_from: str | None, is_playing: bool
    ) -> None:
        """Show the images of a frame; while playing, only every now and then.

        Args:
            frame: The frame.
            is_visible: Whether the frustums are shown.
            looks_from: View that the user looks from: its image is moved behind the scene, and
                the other frustums are hidden.
            is_playing: Whether the clock is running.
        """
        is_visible = is_visible or looks_from is not None
        if is_visible and not self._nodes:
            self._nodes = [self._add(view) for view in self._views]
        for view, node in zip(self._views, self._nodes, strict=False):
            node.visible = is_visible and looks_from in {None, view.name}
            node.scale = self._backdrop(view) if view.name == looks_from else self._scale
        width = _WIDTH if is_playing else _PAUSED_WIDTH
        now = self._clock()
        is_soon = is_playing and now - self._time < _IMAGE_INTERVAL
        if not is_visible or is_soon or self._shown == (frame, width):
            return
        self._time, self._shown = now, (frame, width)
        for view, node in zip(self._views, self._nodes, strict=True):
            if view.has_color:
                node.image = _shrink(view.color(frame), width)

    def _backdrop(self, view: View) -> float:
        """Scale of a frustum whose image lies behind everything that is in the view."""
        camera, framing = view.camera, self._framing
        distance = float(
            (framing.center - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, 2]
        )
        half_height = 0.5 * camera.height / camera.K[1, 1]
        half_width = half_height * camera.width / camera.height
        # Frustums of one scale have one volume, whatever their field of view.
        return (max(distance, 0.0) + framing.extent) * float(np.cbrt(half_width * half_height / 3))

    def _add(self, view: View) -> viser.CameraFrustumHandle:
        camera = view.camera
        return self._server.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=self._scale,
            thickness=1.5,
            thickness_units="screen",
            color=_COLOR,
            format="jpeg",
            jpeg_quality=75,
            wxyz=viser.transforms.SO3.from_matrix(camera.T_world_camera[:3, :3]).wxyz,
            position=camera.T_world_camera[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
        )


def _shrink(image: UInt8[ndarray, "row column 3"], width: int) -> UInt8[ndarray, "row column 3"]:
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def pose_of_view(view: View, framing: Framing) -> Pose:
    """Stand where a view's camera stood, looking its way, with its field of view.

    Args:
        view: The view.
        framing: Tells how far away the middle of the scene is, about which the camera turns.
    """
    camera = view.camera
    _, down, ahead, origin = camera.T_world_camera[:3].T
    distance = max(float((framing.center - origin) @ ahead), 0.1 * framing.extent)
    return Pose(
        position=origin,
        look_at=origin + distance * ahead,
        up=-down,
        fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
    )
