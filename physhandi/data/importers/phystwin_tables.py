"""Reads and checks the tables of a PhysTwin case: calibration, motion, split and annotations.

Everything here is in the case's own world, whose z axis may point either way. Facts about the
format are those of PhysTwin's published code (44f17cc); its pickles are read in a child process.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.phystwin_fields import (
    FARTHEST,
    check_points,
    fail,
    flags,
    named,
    numbers,
    optional_points,
    read_json,
)
from physhandi.data.untrusted import read_untrusted

FRAME_RATE = 30.0
"""PhysTwin's frame rate, for cases whose ``metadata.json`` does not say another one [Hz]."""
_RECONSTRUCTED = 0.7


@dataclass(frozen=True, eq=False, kw_only=True)
class CaseMotion:
    """Content of ``final_data.pkl``."""

    point: Float[ndarray, "frame point 3"]
    """Tracked object points [m]; NaN where not visible."""
    is_motion_valid: Bool[ndarray, "frame point"]
    """Whether the motion *from the frame before* can be trusted; PhysTwin stores it one earlier."""
    node: Float[ndarray, "node 3"]
    """Object nodes at frame 0: tracked points, then surface points, then interior points [m]."""
    surface_node_count: int
    """How many of the nodes are tracked points or surface points."""
    control: Float[ndarray, "frame control 3"]
    """Controller points [m]."""


@dataclass(frozen=True, kw_only=True)
class CaseMetadata:
    """Content of ``metadata.json``."""

    intrinsics: tuple[Float[ndarray, "3 3"], ...]
    """Intrinsic matrix of each camera [px]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    frame_rate: float
    """Frames per second [Hz]."""
    frame_count: int | None
    """Number of synchronised frames; None if the file does not say."""
    is_raw: bool
    """Whether this is the recorder's own file, of streams that nobody has synchronised."""
    serial_numbers: tuple[str, ...]
    """Serial number of each camera."""


def read_motion(path: Path) -> CaseMotion:
    """Read ``final_data.pkl``.

    Invisible samples are stored as the literal point (0, 0, 0) and become NaN. The flag of motion
    t → t+1 at entry t becomes that of t-1 → t.

    Raises:
        ImportFailedError: If a field is missing, has a wrong shape or holds impossible values.
    """
    table = named(path, read_untrusted(path))
    point = numbers(path, table, "object_points", ("frame", "point", 3))
    frame_count, point_count, _ = point.shape
    is_visible = flags(path, table, "object_visibilities", (frame_count, point_count))
    is_valid_next = flags(path, table, "object_motions_valid", (frame_count, point_count))
    control = numbers(path, table, "controller_points", (frame_count, "controller", 3))
    surface = optional_points(path, table, "surface_points")
    interior = optional_points(path, table, "interior_points")
    if 0 in (point.size, control.size):
        fail(path, f"object_points {point.shape} or controller_points {control.shape} is empty")
    is_valid = _shifted(path, is_valid_next, is_visible)
    # The points of frame 0 are the object's nodes, whether they are called visible or not.
    check_points(path, "object_points", point[:1])
    check_points(path, "object_points", point, is_visible)
    check_points(path, "controller_points", control)
    check_points(path, "surface_points", surface[None])
    check_points(path, "interior_points", interior[None])
    return CaseMotion(
        point=np.where(is_visible[..., None], point, np.nan),
        is_motion_valid=is_valid,
        node=np.concatenate([point[0], surface, interior]),
        surface_node_count=point_count + len(surface),
        control=control,
    )


def read_validation(path: Path, frame_count: int) -> Float[ndarray, "frame validation 3"]:
    """Read ``gt_track_3d.pkl``: hand-annotated points [m], NaN where there is no annotation."""
    table = {"content": read_untrusted(path)}
    point = numbers(path, table, "content", (frame_count, "track", 3))
    check_points(path, "content", point, np.asarray(~np.isnan(point).any(axis=-1)))
    return point


def read_metadata(path: Path) -> CaseMetadata:
    """Read ``metadata.json``.

    Raises:
        ImportFailedError: If it is no JSON, or a field is missing or wrong.
    """
    table = read_json(path)
    for field in ("intrinsics", "WH"):
        if field not in table:
            fail(path, f"field '{field}' is missing. It is needed to place images; add it")
    K = numbers(path, table, "intrinsics", ("camera", 3, 3))
    size = numbers(path, table, "WH", (2,))
    if not (size > 0).all() or (size != np.floor(size)).any():
        fail(path, f"WH is {table['WH']!r}; expected image width and height in pixels")
    rate, count = table.get("fps", FRAME_RATE), table.get("frame_num")
    if type(rate) not in (int, float) or not 1.0 <= rate <= 1000.0:
        fail(path, f"fps is {rate!r}; expected frames per second from 1 to 1000")
    if count is not None and (type(count) is not int or count < 1):
        fail(path, f"frame_num is {count!r}; expected the number of synchronised frames")
    serials: Any = table.get("serial_numbers", [])
    if not isinstance(serials, list) or len(cast("list[Any]", serials)) not in (0, len(K)):
        fail(path, f"serial_numbers is {serials!r}; expected {len(K)}, as there are intrinsics")
    return CaseMetadata(
        intrinsics=tuple(K),
        width=int(size[0]),
        height=int(size[1]),
        frame_rate=float(rate),
        frame_count=count,
        is_raw="recording" in table and count is None,
        serial_numbers=tuple(str(serial) for serial in cast("list[Any]", serials)),
    )


def read_poses(path: Path) -> Float[ndarray, "camera 4 4"]:
    """Read ``calibrate.pkl``, a list of matrices from camera to world coordinates [m].

    Raises:
        ImportFailedError: If it is missing or holds something else.
    """
    pose = numbers(path, {"content": read_untrusted(path)}, "content", ("camera", 4, 4))
    far = np.argwhere(~(np.abs(pose).max(axis=(1, 2)) <= FARTHEST))
    if far.size:
        fail(path, f"camera {far[0, 0]} is not finite or farther than {FARTHEST:g} m. Use metres")
    return pose


def join_cameras(
    path: Path, pose: Float[ndarray, "camera 4 4"], metadata: CaseMetadata
) -> tuple[PinholeCamera, ...]:
    """Join the poses that were read from `path` with the intrinsics of ``metadata.json``.

    Raises:
        ImportFailedError: If a pose is not rigid, or there are more or fewer poses than intrinsics.
    """
    if len(pose) != len(metadata.intrinsics):
        fail(
            path,
            f"has {len(pose)} cameras, but metadata.json has {len(metadata.intrinsics)} "
            "intrinsics; both must list every camera, in the same order",
        )
    cameras: list[PinholeCamera] = []
    for number, (T_world_camera, K) in enumerate(zip(pose, metadata.intrinsics, strict=True)):
        try:
            cameras.append(PinholeCamera(K, T_world_camera, metadata.width, metadata.height))
        except ValueError as error:
            fail(path, f"camera {number} (with the intrinsics of metadata.json): {error}")
    return tuple(cameras)


def read_split(path: Path, frame_count: int) -> int:
    """Read how many leading frames are fitted; without the file, PhysTwin's 70 per cent.

    Raises:
        ImportFailedError: If the parts are not [0, k] and [k, frame_count].
    """
    if not path.is_file():
        return max(1, math.floor(_RECONSTRUCTED * frame_count))
    table = read_json(path)
    if table.get("frame_len") != frame_count:
        fail(path, f"frame_len is {table.get('frame_len')!r}, but there are {frame_count} frames")
    train, test = _interval(table.get("train")), _interval(table.get("test", table.get("train")))
    end = train[1]
    is_whole = train[0] == 0 and 1 <= end <= frame_count
    if not is_whole or ("test" in table and test != (end, frame_count)):
        fail(
            path,
            f"train is {table.get('train')!r} and test is {table.get('test')!r}; expected [0, k] "
            f"and [k, {frame_count}]",
        )
    return end


def _interval(value: Any) -> tuple[int, int]:
    """Take two whole numbers; anything else is the impossible interval (-1, -1)."""
    pair = cast("list[Any]", value) if isinstance(value, list) else []
    is_interval = len(pair) == 2 and all(type(end) is int for end in pair)
    return (pair[0], pair[1]) if is_interval else (-1, -1)


def _shifted(path: Path, is_valid_next: ndarray, is_visible: ndarray) -> Bool[ndarray, "frame _"]:
    """Move the flag of a motion from the frame where it starts to the one where it ends."""
    is_seen = np.zeros_like(is_visible)
    is_seen[:-1] = is_visible[1:] & is_visible[:-1]
    wrong = np.argwhere(is_valid_next & ~is_seen)
    if wrong.size:
        frame, point = wrong[0]
        fail(
            path,
            f"object_motions_valid: frame {frame}, point {point} trusts the motion to frame "
            f"{frame + 1}, but object_visibilities does not show the point in both",
        )
    is_valid = np.zeros_like(is_valid_next)
    is_valid[1:] = is_valid_next[:-1]
    return is_valid
