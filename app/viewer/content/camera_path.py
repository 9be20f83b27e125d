"""The way of a film's camera: through key frames, or round what it looks at."""

import json
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from app.viewer.content.session_state import KeyFrame, Pose
from physhandi.data.files import named_fields
from physhandi.errors import UsageError

PATH_FORMAT = "physhandi-camera-path/1"
MOST_KEYS = 1_000
_STEEPEST = 3.0
"""Largest ratio of the camera's speed at a key frame to that on either side: more overshoots."""
_FIELDS = {"frame", "position", "look_at", "up", "fov"}
_SAME = 1e-9


@dataclass(frozen=True)
class Turntable:
    """The camera goes round what it looks at, at one speed."""

    turn: float
    """Angle by which it goes round from the first frame to one after the last [degrees]."""

    def pose(self, frame: int, own: Pose, frames: range) -> Pose:
        """Find the camera in a frame of a film; see `CameraPath.pose`."""
        part = (frame - frames.start) / len(frames)
        return turned_pose(own, math.radians(self.turn) * part)

    def check(self, frame_count: int, sequence: str) -> None:
        """Do nothing: a turntable fits every sequence."""


class CameraPath:
    """A camera that passes through key frames, and rests before the first and after the last.

    Its place, orientation, distance of what it looks at, and field of view are cubic between key
    frames, with the same speed on both sides of each. That speed is the mean of those on both
    sides, weighted as in Catmull-Rom splines, but at most three times the slower one, so that
    nothing overshoots: between equal key frames the camera rests, and between two it goes straight
    at one speed. It turns the shortest way round.
    """

    def __init__(self, keys: tuple[KeyFrame, ...]) -> None:
        """Lay the path.

        Args:
            keys: Key frames, at least one, each of another frame, in any order.

        Raises:
            UsageError: If there is none, or two are of the same frame.
        """
        self.keys = tuple(sorted(keys, key=lambda key: key.frame))
        if not keys:
            raise UsageError("keys: a camera path needs at least one key frame.")
        for before, after in pairwise(self.keys):
            if before.frame == after.frame:
                raise UsageError(f"keys: there are two key frames of frame {after.frame}.")
        self._frame = np.array([key.frame for key in self.keys], np.float64)
        poses = [key.pose for key in self.keys]
        self._position = np.stack([np.asarray(pose.position, np.float64) for pose in poses])
        self._turn = [_orientation(pose) for pose in poses]
        reach = [np.linalg.norm(pose.look_at - pose.position) for pose in poses]
        self._lens = np.array(
            [[math.log(r), pose.fov] for r, pose in zip(reach, poses, strict=True)]
        )
        steps = np.diff(self._frame)[:, None]
        turns = [(a.inv() * b).as_rotvec() for a, b in pairwise(self._turn)]
        self._speed = _key_speeds(np.diff(self._position, axis=0) / steps, steps)
        self._lens_speed = _key_speeds(np.diff(self._lens, axis=0) / steps, steps)
        self._spin = _key_speeds(np.reshape(turns, (-1, 3)) / steps, steps)

    def check(self, frame_count: int, sequence: str) -> None:
        """Refuse key frames that a sequence does not have.

        Raises:
            UsageError: If there is one; names it.
        """
        for index, key in enumerate(self.keys):
            if not 0 <= key.frame < frame_count:
                raise UsageError(
                    f"key frame {index}: frame: '{sequence}' has frames 0 to {frame_count - 1}, "
                    f"not {key.frame}."
                )

    def pose(self, frame: float, own: Pose, frames: range) -> Pose:
        """Find the camera in a frame of a film.

        Args:
            frame: The frame, or a time between two.
            own: Camera of the scene; not used.
            frames: Frames of the film; not used.
        """
        del own, frames
        return self.at(frame)

    def at(self, frame: float) -> Pose:
        """Find the camera in a frame, or at a time between two frames."""
        time = min(max(float(frame), self._frame[0]), self._frame[-1])
        left = int(np.clip(np.searchsorted(self._frame, time, "right") - 1, 0, len(self.keys) - 1))
        right = min(left + 1, len(self.keys) - 1)
        if time == self._frame[left]:
            return self.keys[left].pose
        span = self._frame[right] - self._frame[left]
        part = (time - self._frame[left]) / span
        ends = (left, right)
        position = _bezier(self._position, self._speed, ends, span, part)
        lens = _bezier(self._lens, self._lens_speed, ends, span, part)
        turn = self._turn_at(ends, span, part).as_matrix()
        # Columns of an orientation: to the right, up, and back.
        look_at = position - math.exp(float(lens[0])) * turn[:, 2]
        return Pose(position=position, look_at=look_at, up=turn[:, 1], fov=float(lens[1]))

    def _turn_at(self, ends: tuple[int, int], span: float, part: float) -> Rotation:
        """De Casteljau's construction on the sphere (Shoemake 1985)."""
        left, right = ends
        first, last = self._turn[left], self._turn[right]
        turns = [
            first,
            first * Rotation.from_rotvec(self._spin[left] * span / 3.0),
            last * Rotation.from_rotvec(-self._spin[right] * span / 3.0),
            last,
        ]
        while len(turns) > 1:
            turns = [_slerp(a, b, part) for a, b in pairwise(turns)]
        return turns[0]

    def to_text(self) -> str:
        """Write the path as a file holds it; fields of view are in degrees."""
        keys = [
            {
                "frame": key.frame,
                "position": [float(f"{x:.9g}") for x in key.pose.position],
                "look_at": [float(f"{x:.9g}") for x in key.pose.look_at],
                "up": [float(f"{x:.9g}") for x in key.pose.up],
                "fov": float(f"{math.degrees(key.pose.fov):.9g}"),
            }
            for key in self.keys
        ]
        lines = ",\n  ".join(json.dumps(key) for key in keys)
        return f'{{"format": "{PATH_FORMAT}", "kind": "keys", "keys": [\n  {lines}\n]}}\n'


CameraMotion = CameraPath | Turntable
"""Motion of a film's camera."""


def read_camera_path(path: Path) -> CameraMotion:
    """Read how a camera moves from a JSON file; docs/formats.md describes it.

    Raises:
        UsageError: If it cannot be read; names file, key frame and field.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: this camera path cannot be read: {error}.") from error
    try:
        return parse_camera_path(text)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error


def parse_camera_path(text: str) -> CameraMotion:
    """Read how a camera moves from JSON.

    Raises:
        UsageError: If it makes no sense; names key frame and field.
    """
    try:
        content = named_fields(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise UsageError(f"this is not JSON: {error}.") from error
    if content is None or content.get("format") != PATH_FORMAT:
        raise UsageError(f'format: a camera path begins with {{"format": "{PATH_FORMAT}", …}}.')
    kind = content.get("kind")
    fields = {"format", "kind", "turn" if kind == "turntable" else "keys"}
    for name in content:
        if kind in {"keys", "turntable"} and name not in fields:
            raise UsageError(f"{name[:40]}: a camera path of kind '{kind}' has no such field.")
    if kind == "turntable":
        return Turntable(_number(content.get("turn"), "turn", -3600.0, 3600.0))
    if kind != "keys":
        raise UsageError("kind: this is neither 'keys' nor 'turntable'.")
    keys = content.get("keys")
    if not isinstance(keys, list) or not 1 <= len(cast("list[Any]", keys)) <= MOST_KEYS:
        raise UsageError(f"keys: expected a list of 1 to {MOST_KEYS} key frames.")
    return CameraPath(tuple(map(_key_frame, range(MOST_KEYS), cast("list[Any]", keys))))


def turned_pose(pose: Pose, angle: float) -> Pose:
    """Move a camera round what it looks at, anticlockwise seen from above.

    Args:
        pose: Where it stands.
        angle: By how much [rad].
    """
    up = pose.up / np.linalg.norm(pose.up)
    arm = pose.position - pose.look_at
    along = (arm @ up) * up
    across = arm - along
    moved = along + np.cos(angle) * across + np.sin(angle) * np.cross(up, across)
    return Pose(position=pose.look_at + moved, look_at=pose.look_at, up=pose.up, fov=pose.fov)


def _key_frame(index: int, value: Any) -> KeyFrame:
    place = f"key frame {index}: "
    fields = named_fields(value)
    if fields is None:
        raise UsageError(f"{place}expected named fields ({', '.join(sorted(_FIELDS))}).")
    for name in fields:
        if name not in _FIELDS:
            raise UsageError(f"{place}{name[:40]}: there is no such field.")
    frame = fields.get("frame")
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < 10**7:
        raise UsageError(f"{place}frame: expected a whole number from 0 on.")
    position, look_at = (_vector(fields.get(n), place + n) for n in ("position", "look_at"))
    up = _vector(fields.get("up", [0.0, 0.0, 1.0]), f"{place}up")
    fov = math.radians(_number(fields.get("fov", 60.0), f"{place}fov", 1.0, 170.0))
    ahead = look_at - position
    if np.linalg.norm(ahead) < _SAME:
        raise UsageError(f"{place}look_at: the camera cannot look at where it stands.")
    side = np.linalg.norm(np.cross(ahead, up))
    if side < 1e-6 * np.linalg.norm(ahead) * max(float(np.linalg.norm(up)), _SAME):
        raise UsageError(f"{place}up: the camera looks in this direction, so nothing is upwards.")
    return KeyFrame(frame=frame, pose=Pose(position=position, look_at=look_at, up=up, fov=fov))


def _number(value: Any, name: str, least: float, most: float) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not least <= value <= most:
        raise UsageError(f"{name}: expected a number from {least:g} to {most:g}.")
    return float(value)


def _vector(value: Any, name: str) -> Float[ndarray, " 3"]:
    numbers: list[Any] = cast("list[Any]", value) if isinstance(value, list) else []
    if len(numbers) != 3:
        raise UsageError(f"{name}: expected three numbers.")
    return np.array([_number(number, name, -1e6, 1e6) for number in numbers])


def _orientation(pose: Pose) -> Rotation:
    """Give the camera's axes: to the right, up, and back."""
    right_down_ahead = pose.camera(1, 1).T_world_camera[:3, :3]
    return Rotation.from_matrix(right_down_ahead * [1.0, -1.0, -1.0])


def _key_speeds(speed: Float[ndarray, "gap n"], steps: Float[ndarray, "gap 1"]) -> ndarray:
    """Choose the speed at each key frame from those in the gaps beside it."""
    if not len(speed):
        return np.zeros((1, speed.shape[1]))
    mean = (steps[1:] * speed[:-1] + steps[:-1] * speed[1:]) / (steps[1:] + steps[:-1])
    size = np.linalg.norm(speed, axis=1)
    slower = np.minimum(size[:-1], size[1:])
    fastest = np.maximum(np.linalg.norm(mean, axis=1), _SAME)
    limit = np.minimum(1.0, _STEEPEST * slower / fastest)
    return np.concatenate([speed[:1], limit[:, None] * mean, speed[-1:]])


def _bezier(
    value: ndarray, speed: ndarray, ends: tuple[int, int], span: float, part: float
) -> ndarray:
    """Go from one key frame to the next with the speeds that both have."""
    left, right = ends
    points = [
        value[left],
        value[left] + speed[left] * span / 3.0,
        value[right] - speed[right] * span / 3.0,
        value[right],
    ]
    rest = 1.0 - part
    weights = np.array([rest**3, 3.0 * rest**2 * part, 3.0 * rest * part**2, part**3])
    return weights @ np.stack(points)


def _slerp(first: Rotation, last: Rotation, part: float) -> Rotation:
    return first * Rotation.from_rotvec(part * (first.inv() * last).as_rotvec())
