"""A session as lists show it, and its state as a copy or a link takes it over."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.layers import Layers, Theme
from physhandi.data.camera import PinholeCamera
from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import SimulationParameters

if TYPE_CHECKING:
    import viser  # Files are made by processes that show nothing.

Kind = Literal["run", "sequence", "comparison"]


@dataclass(frozen=True, kw_only=True)
class SessionInfo:
    """One entry of the list of sessions."""

    id: str
    """Unguessable id, part of its address."""
    kind: Kind
    """Whether a run, a sequence or two runs together are shown."""
    target: str
    """Id of the run or the sequence; of a comparison the query after ``/compare?``."""
    owner: str
    """Visitor who opened it."""
    title: str
    """Name of what is shown."""
    client_count: int
    """Browsers that look at it."""
    created: float
    """Time of opening [s since 1970]."""
    idle: float
    """Time since a browser was connected [s]."""
    offers: tuple[str, ...] = ()
    """Features that it has: ``object`` (which can be simulated), ``colors``, ``figure``,
    ``recorded`` (a camera has pictures), ``video`` (behind the hands at first)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Pose of a camera: its position and the point that it looks at."""

    position: Float[ndarray, " 3"]
    """Of the camera."""
    look_at: Float[ndarray, " 3"]
    """Point in the middle of the picture, about which the camera turns."""
    up: Float[ndarray, " 3"]
    """Direction that is upwards in the picture."""
    fov: float
    """Vertical field of view [rad]."""

    @classmethod
    def of(cls, camera: "viser.CameraHandle") -> "Pose":
        """Read a client's camera."""
        return cls(
            position=camera.position.copy(),
            look_at=camera.look_at.copy(),
            up=camera.up_direction.copy(),
            fov=camera.fov,
        )

    @classmethod
    def first(cls, camera: "viser.InitialCameraConfig") -> "Pose":
        """Read where the cameras of new clients are put."""
        up = np.array([0.0, 0.0, 1.0]) if camera.up is None else camera.up
        return cls(position=camera.position, look_at=camera.look_at, up=up, fov=camera.fov)

    def camera(self, width: int, height: int) -> PinholeCamera:
        """Give the camera that takes a picture of so many columns and rows."""
        ahead = self.look_at - self.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, self.up)
        right = right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(ahead, right), ahead, self.position], axis=1)
        focal = 0.5 * height / float(np.tan(self.fov / 2))
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        return PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)

    def give(self, client: "viser.ClientHandle") -> None:
        """Put a client's camera here."""
        camera = client.camera
        with client.atomic():
            camera.fov, camera.up_direction = self.fov, self.up
            camera.position, camera.look_at = self.position, self.look_at

    def give_first(self, camera: "viser.InitialCameraConfig") -> None:
        """Put the cameras of new clients here."""
        camera.fov, camera.up = self.fov, self.up
        camera.position, camera.look_at = self.position, self.look_at


@dataclass(frozen=True, eq=False, kw_only=True)
class KeyFrame:
    """Pose of a film's camera in one frame."""

    frame: int
    """The frame."""
    pose: Pose
    """The camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SessionState:
    """Everything that a user has set in a session; a copy of it begins with this."""

    sequence_name: str | None
    """Sequence of the run; None for its first."""
    frame: int
    """Frame that is due."""
    is_playing: bool
    """Whether the clock is running."""
    speed: float
    """Sequence seconds per second."""
    does_loop: bool
    """Whether playing starts over at the end."""
    layers: Layers | None
    """Shown layers; None for the content's default."""
    theme: Theme
    """Chosen background."""
    prefers_dark: bool
    """Whether the browser asks for a dark one."""
    parameters: SimulationParameters | None
    """Parameters of the last simulation; None without an object."""
    automatic_substeps: bool
    """Whether the number of substeps is chosen automatically."""
    is_figure: bool
    """Whether the figure is shown instead of the scene."""
    pose: Pose | None
    """Camera of the first client; None if nobody looked."""
    part: tuple[int, int] | None = None
    """First and last frame of the part that is played; None for all."""
    layer_changes: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Without `layers`: fields of `Layers` that differ from what suits the content."""
    parameter_changes: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Parameters that differ from the fitted ones; they count if there are no `parameters`."""

    camera_keys: tuple[KeyFrame, ...] = ()
    """Key frames of the path that the camera of a film follows; see `CameraPath`."""
    edits: Edits | None = None
    """Edits of single springs and nodes; None for the object's own edits."""

    @property
    def is_changed(self) -> bool:
        """Whether the object of a run is to be simulated anew."""
        return bool(self.parameter_changes) or self.automatic_substeps
