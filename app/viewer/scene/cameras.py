"""Camera frustums with the frame's image in them.

A frustum is that of a pinhole camera: images are straightened, so that what is reconstructed lies
over what they show.
"""

import time
from collections.abc import Callable
from collections.abc import Sequence as Listing

import cv2
import numpy as np
import viser
import viser.transforms
from jaxtyping import UInt8
from numpy import ndarray

from app.viewer.scene.framing import Framing
from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View

_WIDTH = 320
_BACKDROP_WIDTH = 480
_PAUSED_WIDTH = 640
BACKDROP_BYTES = 30_000
"""About what the image of a backdrop weighs in a playing frame."""
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
        self._shown: tuple[int, int, str | None] | None = None
        self._lenses: dict[tuple[str, int], Lens] = {}
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
        """Show the images of a frame; while playing only every now and then, but a backdrop always.

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
        playing_width = _WIDTH if looks_from is None else _BACKDROP_WIDTH
        width = playing_width if is_playing else _PAUSED_WIDTH
        now = self._clock()
        is_soon = is_playing and looks_from is None and now - self._time < _IMAGE_INTERVAL
        if not is_visible or is_soon or self._shown == (frame, width, looks_from):
            return
        self._time, self._shown = now, (frame, width, looks_from)
        for view, node in zip(self._views, self._nodes, strict=True):
            if view.has_color and looks_from in {None, view.name}:
                node.image = self._lens(view, width).straighten(view.color(frame))

    def _lens(self, view: View, width: int) -> "Lens":
        """Find how images of a view are straightened, which takes longer than to do it."""
        key = view.name, min(width, view.camera.width)
        if key not in self._lenses:
            self._lenses[key] = Lens(view.camera, key[1])
        return self._lenses[key]

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


class Lens:
    """Makes a camera's images smaller, and those of a pinhole that looks through their middle."""

    def __init__(self, camera: PinholeCamera, width: int) -> None:
        height = max(1, round(camera.height * width / camera.width))
        self._size = width, height
        scale = np.array([width / camera.width, height / camera.height])
        K = camera.K.copy()
        K[:2] *= scale[:, None]
        K[:2, 2] += 0.5 * scale - 0.5  # Whole numbers are the middles of pixels.
        straight = np.diag([*(scale * camera.K[1, 1]), 1.0])
        straight[:2, 2] = 0.5 * (width - 1), 0.5 * (height - 1)
        is_straight = not camera.distortion.any() and np.allclose(K, straight, atol=0.05)
        self._maps = (
            None
            if is_straight
            else cv2.initUndistortRectifyMap(
                K, camera.distortion, None, straight, self._size, cv2.CV_16SC2
            )
        )

    def straighten(self, image: UInt8[ndarray, "row column 3"]) -> UInt8[ndarray, "row column 3"]:
        """Give the image that the pinhole would have taken; its rim goes on where the lens ends."""
        if image.shape[1] > self._size[0]:
            image = np.asarray(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA))
        if self._maps is None:
            return image
        return np.asarray(
            cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )
