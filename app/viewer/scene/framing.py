"""Initial camera of a scene, and sizes of points and arrows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.content import Content
from app.viewer.content.session_state import Pose
from physhandi.data.view import View

_SAMPLED_FRAMES = 12
_SAMPLED_POINTS = 2_000
_FOV = float(np.deg2rad(45.0))
_AZIMUTH = float(np.deg2rad(-61.0))
_ELEVATION = float(np.deg2rad(26.0))
_MARGIN = 1.1
_FARTHEST = 2.6
_FARTHEST_OF_HANDS = 1.3
"""Reconstructed hands are what is looked at; cameras may reach out of the picture."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Framing:
    """Sizes of the scene, in its own unit of length."""

    center: Float[ndarray, " 3"]
    """Middle of all that moves."""
    extent: float
    """Diagonal of the box around all that moves."""
    low: float
    """Height of the lowest point."""
    spacing: float
    """Typical distance of neighboring object nodes."""
    frustum: float
    """Scale of the camera frustums."""
    azimuth: float = _AZIMUTH
    """Direction from the middle to the camera, about the vertical [rad]."""
    elevation: float = _ELEVATION
    """Direction from the middle to the camera, above the horizon [rad]."""
    reach: float = 0.0
    """Diagonal of what should be in the picture, if that is more than what moves."""

    @property
    def fov(self) -> float:
        """Vertical field of view of the camera [rad]."""
        return _FOV

    @property
    def look_at(self) -> Float[ndarray, " 3"]:
        """Point in the middle of the picture, right of the center: the panel covers that side."""
        right = np.array([-np.sin(self.azimuth), np.cos(self.azimuth), 0.0])
        return self.center + 0.1 * max(self.extent, self.reach) * right

    @property
    def camera(self) -> Float[ndarray, " 3"]:
        """Position of the camera from which everything fits into the picture."""
        flat = np.array([np.cos(self.azimuth), np.sin(self.azimuth), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        direction = np.cos(self.elevation) * flat + np.sin(self.elevation) * up
        half = 0.5 * _MARGIN * max(self.extent, self.reach)
        return self.look_at + direction * half / np.tan(0.5 * _FOV)


def frame_content(content: Content) -> Framing:
    """Measure what a content needs of the screen.

    Args:
        content: What is going to be shown.
    """
    parts = [part for part in _parts(content) if len(part)]
    point = np.concatenate(parts) if parts else _seen_place(content)
    low, high = np.quantile(point, [0.005, 0.995], axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-6)
    around = (
        _around_cameras(content, (low + high) / 2, extent) if parts else _behind_cameras(content)
    )
    return Framing(
        center=(low + high) / 2,
        extent=extent,
        low=float(point[:, 2].min()),
        spacing=_spacing(content, extent),
        frustum=0.08 * max(around.get("reach", 0.0), extent) if parts else 0.13 * extent,
        **around,
    )


def _seen_place(content: Content) -> Float[ndarray, "point 3"]:
    """Guess a place around what the cameras look at, when nothing is known in 3-D."""
    if not content.views:
        return np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
    pose = np.array([view.camera.T_world_camera for view in content.views])
    ahead, eye = pose[:, :3, 2], pose[:, :3, 3]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    # The point nearest to all optical axes; the small weight decides if they are parallel.
    weak = 1e-3 * np.eye(3)
    target = (across @ eye[..., None]).sum(0)[:, 0] + weak @ (eye + ahead).mean(0)
    weights, axes = np.linalg.eigh(across.sum(0) + weak)
    center = axes @ ((axes.T @ target) / weights)
    half = float(np.linalg.norm(eye - center, axis=1).mean()) / 4
    return np.concatenate([[center - half, center + half], eye])


def _behind_cameras(content: Content) -> dict[str, float]:
    """Stand behind the recording cameras, so that their images are seen as they were taken."""
    if not content.views:
        return {}
    back = -np.mean([view.camera.T_world_camera[:3, 2] for view in content.views], axis=0)
    elevation = float(np.arctan2(back[2], np.hypot(back[0], back[1])))
    return {
        "azimuth": float(np.arctan2(back[1], back[0])),
        "elevation": min(max(elevation, 0.1), 1.3),
    }


def _around_cameras(
    content: Content, center: Float[ndarray, " 3"], extent: float
) -> dict[str, float]:
    """Stand where no recording camera hides the scene, far enough to see them all."""
    if content.fitted is not None or not content.views:
        return {}
    offset = np.array([view.camera.T_world_camera[:3, 3] for view in content.views]) - center
    taken = np.arctan2(offset[:, 1], offset[:, 0])
    azimuth = _AZIMUTH + np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    gap = np.abs(np.angle(np.exp(1j * (azimuth[:, None] - taken)))).min(axis=1)
    farthest = _FARTHEST_OF_HANDS if content.hands else _FARTHEST
    reach = min(2 * float(np.linalg.norm(offset, axis=1).max()), farthest * extent)
    return {"azimuth": float(azimuth[np.argmax(gap)]), "reach": reach}


def _parts(content: Content) -> list[Float[ndarray, "point 3"]]:
    """Sample points of everything that moves."""
    frames = np.unique(np.linspace(0, content.frame_count - 1, _SAMPLED_FRAMES).astype(int))
    tracks = [hand.vertex for hand in content.hands] + list(content.skeletons)
    if content.control is not None:
        tracks.append(content.control)
    if content.fitted is not None:
        tracks.append(content.fitted.position)
    parts = [_thin(np.asarray(track[min(f, len(track) - 1)])) for track in tracks for f in frames]
    if content.observed is not None:
        parts += [_thin(content.observed.points(int(frame))) for frame in frames[::4]]
    return parts


def _thin(point: Float[ndarray, "point 3"]) -> Float[ndarray, "point 3"]:
    point = point[np.isfinite(point).all(axis=-1)]
    return point[:: max(1, len(point) // _SAMPLED_POINTS)]


def _spacing(content: Content, extent: float) -> float:
    if content.fitted is not None and content.fitted.model.object_spring_count > 0:
        model = content.fitted.model
        short = float(np.quantile(model.rest_length[: model.object_spring_count], 0.05))
        least = min(max(1.0 / model.node_count, 0.006), 0.025)
        return min(max(short, least * extent), 0.05 * extent)
    return 0.012 * extent


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
