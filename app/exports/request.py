"""Request for a file to export, as the process that makes it gets it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from app.exports.permalink import state_from_query
from app.viewer.content.camera_path import CameraMotion, CameraPath, Turntable, parse_camera_path
from app.viewer.content.session_state import SessionState
from physhandi.errors import UsageError

Format = Literal[
    "ply",
    "gltf",
    "npz",
    "csv",
    "yaml",
    "png",
    "mp4",
    "gif",
    "zip",
    "viser",
    "html",
    "usd",
    "mjcf",
    "newton",
    "rrd",
    "splat-ply",
]
Beside = Literal["none", "recording", "difference"]
"""Pictures beside a film from a recorded camera: none, the recording, or that and how much both
differ."""
_SUFFIXES = {"gltf": "glb", "ply": "zip", "mjcf": "zip", "newton": "zip", "splat-ply": "ply"}
"""File suffixes of formats, where they differ from the format's name."""
SMALLEST, LARGEST = 16, 4_096
"""Shortest and longest side of a picture [px]."""
LARGEST_TURN = 3_600.0
"""Largest angle by which the camera of a film goes round [degrees]."""


@dataclass(frozen=True, kw_only=True)
class FileRequest:
    """A file that is to be made."""

    kind: Literal["run", "sequence"]
    """Kind of the exported item."""
    folder: str
    """Folder of the run or the sequence."""
    format: Format
    """File format."""
    query: Mapping[str, str] = field(default_factory=dict[str, str])
    """Query of the scene's permalink; see `app.exports.permalink`."""
    frame: int | None = None
    """Only this frame, as one file (PLY); None for all, or for splats where they were fitted."""
    recordings: Mapping[str, str] = field(default_factory=dict[str, str])
    """Folders of recordings by name, for runs whose recording has moved."""
    rollout: str = ""
    """Folder with a rollout that was simulated elsewhere; see `store_rollout`."""
    width: int = 1280
    """Width of a picture or film [px]."""
    height: int = 720
    """Height of a picture or film [px]."""
    turn: float = 0.0
    """Angle by which the camera of a film goes round [degrees]."""
    camera_path: str = ""
    """Camera path of a film, as JSON; see `parse_camera_path`."""
    view: str = ""
    """Camera of the recording from which a film is taken; empty for the one that the link looks
    from, else the first."""
    beside: Beside | None = None
    """Of a film from a recorded camera: what is beside it. None without `view` films the scene."""
    device: str = "cpu"
    """Warp device, if parameters were changed."""
    link: str = ""
    """Address that shows the same, for people."""

    @property
    def suffix(self) -> str:
        """File suffix, without the dot."""
        is_one = self.format == "ply" and self.frame is not None
        return "ply" if is_one else _SUFFIXES.get(self.format, self.format)

    @property
    def is_from_recorded_view(self) -> bool:
        """Whether a film is taken from one of the recording's cameras."""
        return bool(self.view) or self.beside is not None

    @property
    def motion(self) -> CameraMotion | None:
        """Camera motion of a film, by default that of the link; None for a camera at rest.

        Raises:
            UsageError: If the camera path makes no sense, or there is a turn, too.
        """
        if not self.camera_path:
            if self.turn:
                return Turntable(self.turn)
            keys = state_from_query(self.query).camera_keys
            return CameraPath(keys) if keys else None
        if self.turn:
            raise UsageError("turn: a film has a camera path or a turn, not both.")
        return parse_camera_path(self.camera_path)

    def check(self) -> SessionState:
        """Find out early what cannot work.

        Returns:
            What is to be shown.

        Raises:
            UsageError: If a field of the query or a size makes no sense; names it.
        """
        for name, size in (("width", self.width), ("height", self.height)):
            if not SMALLEST <= size <= LARGEST:
                raise UsageError(f"{name}: {size} is not between {SMALLEST} and {LARGEST} pixels.")
        if not abs(self.turn) <= LARGEST_TURN:
            raise UsageError(
                f"turn: {self.turn} is not between -{LARGEST_TURN:g} and {LARGEST_TURN:g} degrees."
            )
        if self.motion is not None and self.camera_path and self.format not in {"mp4", "gif"}:
            raise UsageError(f"camera_path: mp4 and gif have one, {self.format} has none.")
        if self.is_from_recorded_view:
            self._check_view()
        state = state_from_query(self.query)
        if self.format == "yaml" and state.is_changed:
            raise UsageError(
                "format: yaml describes the run itself; leave changed parameters out of the link."
            )
        if state.is_figure:
            raise UsageError(
                "fig: the comparison with PhysTwin is saved from a live scene, where it is shown."
            )
        return state

    def _check_view(self) -> None:
        if self.format not in {"mp4", "gif"}:
            raise UsageError(
                f"view, beside: mp4 and gif are filmed from a recorded camera, {self.format} is "
                "not."
            )
        if self.turn or self.camera_path:
            raise UsageError("view: a recorded camera stands where it stood; it has no turn.")

    def to_text(self) -> str:
        """Write the order on one line."""
        return json.dumps(asdict(self), sort_keys=True)
