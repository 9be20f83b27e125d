"""Cameras while two sides are shown beside each other, and their way back."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser.transforms
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.session_state import Pose
from physhandi.rotations import unit

PICTURE_WIDTH = 1_600
"""Width of an exported picture of both sides [px]."""
_PANEL_WIDTH = 345
"""Width that the panel covers, in pixels of the page."""
_FOV = float(np.deg2rad(14.0))
_SAME_FOV = 1e-3
"""Fields of view that differ by less are the same [rad]."""


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

    @classmethod
    def at(cls, pose: Pose) -> "Eye":
        """Find the orientation of a camera that looks at a point."""
        ahead = pose.look_at - pose.position
        right = unit(np.cross(ahead, pose.up))
        return cls(right=right, up=unit(np.cross(right, ahead)))

    @property
    def ahead(self) -> Float[ndarray, " 3"]:
        """Into the picture."""
        return np.cross(self.up, self.right)


Box = tuple[Float[ndarray, " 3"], float, float]
"""Middle, width and height of something as it is seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Aim:
    """Where a camera was told to stand."""

    position: Float[ndarray, " 3"]
    look_at: Float[ndarray, " 3"]
    size: tuple[int, int]
    """Width and height of the client's picture at that time [px]."""


class ComparisonCameras:
    """Moves the cameras of the clients to both sides and back."""

    def __init__(self, pixel_ratio: Callable[[], float]) -> None:
        """Begin with no client.

        Args:
            pixel_ratio: Gives how many pixels in a row the screen has for each of the page; those
                of the screen are what viser says the size of a picture in.
        """
        self._pixel_ratio = pixel_ratio
        self._poses: dict[int, Pose] = {}
        self._aims: dict[int, _Aim] = {}

    def aim(
        self,
        client: viser.ClientHandle,
        pose: Pose,
        box: Box,
    ) -> None:
        """Move a camera back along its view until both sides fit beside the panel.

        The lens becomes a long one, so that both sides are seen from nearly the same side.

        Args:
            client: Whose camera.
            pose: Where it stands, or is about to stand if the client has just come.
            box: Both sides as they are seen.
        """
        camera = client.camera
        self._poses.setdefault(client.client_id, pose)
        eye = Eye.at(pose)
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        hidden = self._covered(width)
        slope = float(np.tan(_FOV / 2))
        center, wide, high = box
        distance = max(high / 2, wide / 2 * height / (width - hidden)) / slope
        aside = 0.5 * hidden * (2 * slope * distance / height) * eye.right
        place = center + aside - distance * eye.ahead
        size = camera.image_width, camera.image_height
        self._aims[client.client_id] = _Aim(position=place, look_at=center + aside, size=size)
        with client.atomic():
            camera.up_direction, camera.fov = pose.up, _FOV
            camera.position, camera.look_at = place, center + aside

    def has_lost(self, client: viser.ClientHandle) -> bool:
        """Tell whether a camera that was aimed no longer shows both sides, and no user did that.

        A browser may hear of its first camera after it was told to look at both sides, of all of it
        or of its place, direction or lens alone; and the window may have got another size.
        """
        aim, before = self._aims.get(client.client_id), self._poses.get(client.client_id)
        if aim is None or before is None:
            return False
        camera = client.camera
        near = 1e-3 * float(np.linalg.norm(aim.position - aim.look_at))

        def is_at(position: Float[ndarray, " 3"], place: Float[ndarray, " 3"]) -> bool:
            return float(np.linalg.norm(position - place)) < near

        stands, looks = is_at(camera.position, aim.position), is_at(camera.look_at, aim.look_at)
        if stands and looks:
            size = camera.image_width, camera.image_height
            return size != aim.size or abs(camera.fov - _FOV) > _SAME_FOV
        stood = is_at(camera.position, before.position)
        looked = is_at(camera.look_at, before.look_at)
        return (stands or stood) and (looks or looked)

    def before(self, client: viser.ClientHandle) -> Pose:
        """Find where a camera stands, or stood before it was moved to both sides."""
        return self._poses.get(client.client_id) or Pose.of(client.camera)

    def forget(self, client: viser.ClientHandle) -> Pose:
        """Find where a camera stood, and forget it."""
        self._aims.pop(client.client_id, None)
        return self._poses.pop(client.client_id, None) or Pose.of(client.camera)

    def restore(self, server: viser.ViserServer) -> None:
        """Let all cameras stand again where they stood before."""
        for client in server.get_clients().values():
            pose = self._poses.get(client.client_id)
            if pose is not None:
                pose.give(client)
        self._poses.clear()
        self._aims.clear()

    def picture(self, client: viser.ClientHandle, box: Box) -> dict[str, Any]:
        """Find camera and size of a picture of both sides as a client sees it beside the panel.

        What is empty above and below is cut off evenly, so that the middle stays.

        Args:
            client: Who looks.
            box: Both sides as they are seen.

        Returns:
            Arguments of viser's ``get_render``.
        """
        camera = client.camera
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        hidden = self._covered(width)
        pixel = 2 * np.tan(camera.fov / 2) / height
        distance = float(np.linalg.norm(camera.look_at - camera.position))
        eye = Eye.of(camera.wxyz)
        aside = 0.5 * hidden * pixel * distance * eye.right
        reach = abs(float((box[0] - camera.look_at) @ eye.up)) + 0.5 * box[2]
        shown_height = min(2 * reach / (pixel * distance), height)
        return {
            "width": PICTURE_WIDTH,
            "height": max(round(shown_height * PICTURE_WIDTH / (width - hidden)), 1),
            "wxyz": camera.wxyz,
            "position": camera.position - aside,
            "fov": 2 * float(np.arctan(np.tan(camera.fov / 2) * shown_height / height)),
        }

    def _covered(self, width: int) -> float:
        """Guess how many pixels of a picture the panel covers."""
        panel = _PANEL_WIDTH * self._pixel_ratio()
        return panel if width > 2 * panel else 0.0
