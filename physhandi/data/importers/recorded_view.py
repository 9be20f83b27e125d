"""The cameras of a raw recording: their folders, streams, intrinsics and poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.importers.phystwin_files import fail, read_metadata, read_poses
from physhandi.data.importers.recorded_camera import (
    RecordedCamera,
    check_camera,
    read_camera,
    read_numbers,
    read_pose,
    read_pose_file,
    read_table,
)
from physhandi.data.importers.recorded_stream import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    VIDEO_SUFFIXES,
    RecordedStream,
    find_stream,
    image_stream,
    read_times,
    video_stream,
)
from physhandi.data.sequence_meta import safe_name
from physhandi.errors import ImportFailedError

CALIBRATION = "calibration"
"""Folder of the pictures of the board, one folder a view."""
_TABLES = (".json", ".yaml", ".yml")
_INTRINSICS = (
    *("intrinsics", "color_intrinsics", "rgb_intrinsics", "camera_intrinsic", "camera_info"),
    *("camera", "cameras", "calib", "calibration"),
)
_DEPTH_INTRINSICS = ("depth_intrinsics", "intrinsics_depth", "depth_camera_info")
_EXTRINSICS = ("extrinsics", "poses", "pose", "T_world_camera", "camera_pose")
_DEPTH_TO_COLOR = ("depth_to_color", "T_color_depth", "extrinsics_depth_to_color")


@dataclass(eq=False, kw_only=True)
class RecordedView:
    """One camera of a raw recording."""

    name: str
    """Name of the view."""
    folder: Path
    """Folder that holds its streams."""
    color: RecordedStream | None
    """Color images."""
    depth: RecordedStream | None
    """Depth images."""
    camera: RecordedCamera
    """Camera whose pixels the sequence gets: that of color, else that of depth."""
    depth_camera: RecordedCamera | None = None
    """Camera of the depth images; None if depth is given for the pixels of `camera`."""
    T_color_depth: Float[ndarray, "4 4"] | None = None
    """Maps coordinates of the depth camera to those of `camera`; None if both are one [m]."""
    T_world_camera: Float[ndarray, "4 4"] | None = None
    """Pose that the recording states [m]."""
    depth_scale: float | None = None
    """Metres per unit of depth that the recording states."""
    notes: list[str] = field(default_factory=list[str])
    """Assumptions, as sentences."""

    @property
    def streams(self) -> tuple[RecordedStream, ...]:
        """The streams that it has, color first."""
        return tuple(stream for stream in (self.color, self.depth) if stream is not None)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images that the sequence gets [px]."""
        stream = self.streams[0]
        return stream.width, stream.height


@dataclass(frozen=True)
class _Folder:
    """What is found before intrinsics are read."""

    name: str
    folder: Path
    color: RecordedStream | None
    depth: RecordedStream | None


def find_views(source: Path, intrinsics: Path | None = None) -> list[RecordedView]:
    """Find all cameras of a recording.

    Args:
        source: Folder of one camera, or of one folder for each camera; or PhysTwin's recorder's.
        intrinsics: File with the intrinsics of all cameras, instead of those in the folder.

    Raises:
        ImportFailedError: If there is no camera, or a file is missing or broken; names it.
    """
    if not source.is_dir():
        lack = "is not a folder" if source.exists() else "does not exist"
        raise ImportFailedError(
            f"{source} {lack}. Give the folder of a recording (one folder for each camera, with "
            "color and depth in it), a bag (.bag, .db3, .mcap) or .r3d."
        )
    if (source / "metadata.json").is_file() and _numbered(source / "color"):
        return _phystwin_views(source)
    folders = _views_of(source)
    if not folders:
        raise ImportFailedError(
            f"{source} holds no recording: neither it nor a folder in it has color or depth (as "
            "color/00000.png or color.mp4, and depth/00000.png or .npy), or a bag (.bag, .db3, "
            ".mcap, .r3d)."
        )
    shared = _shared_table(source, intrinsics)
    poses = _shared_poses(source, [item.name for item in folders])
    return [
        _view(item, shared, poses.get(item.name), is_alone=len(folders) == 1, order=order)
        for order, item in enumerate(folders)
    ]


def _numbered(folder: Path) -> list[Path]:
    """Folders, or videos, that are named after the number of a camera."""
    if not folder.is_dir():
        return []
    items = [
        item
        for item in folder.iterdir()
        if item.stem.isdecimal() and (item.is_dir() or item.suffix.lower() in VIDEO_SUFFIXES)
    ]
    return sorted(items, key=lambda item: int(item.stem))


def camera_folders(source: Path) -> list[Path]:
    """List the folders in a recording that may each be a camera's."""
    return [
        folder
        for folder in sorted(source.iterdir())
        if folder.is_dir() and not folder.name.startswith(".") and folder.name != CALIBRATION
    ]


def has_streams(folder: Path) -> bool:
    """Tell whether a folder holds color or depth of a camera as images or a video.

    Raises:
        ImportFailedError: See `find_views`.
    """
    return _streams(folder, "") is not None


def _views_of(source: Path) -> list[_Folder]:
    own = _streams(source, "view0")
    if own is not None:
        return [own]
    folders: list[_Folder] = []
    for folder in camera_folders(source):
        streams = _streams(folder, _view_name(folder, len(folders)))
        if streams is None:
            images = [path for path in folder.iterdir() if path.suffix.lower() in COLOR_SUFFIXES]
            if images:
                color = image_stream("color", folder, images)
                streams = _Folder(_view_name(folder, len(folders)), folder, color, None)
        if streams is not None:
            folders.append(streams)
    return folders


def _streams(folder: Path, name: str) -> _Folder | None:
    color, depth = find_stream(folder, "color"), find_stream(folder, "depth")
    return None if color is None and depth is None else _Folder(name, folder, color, depth)


def _view_name(folder: Path, number: int) -> str:
    safe = safe_name(folder.name)
    return safe if safe.strip("_") else f"view{number}"


def _table_file(folder: Path, stems: Sequence[str], *more: str) -> Path | None:
    places = (folder / f"{stem}{suffix}" for stem in stems for suffix in (*_TABLES, *more))
    return next((path for path in places if path.is_file()), None)


def _shared_table(source: Path, given: Path | None) -> tuple[Path, Any] | None:
    path = given or _table_file(source, _INTRINSICS)
    if path is None:
        return None
    if path.suffix == ".txt":
        return path, read_numbers(path)
    table = read_table(path)
    if isinstance(table, dict):
        fields = cast("dict[str, Any]", table)
        return path, fields.get("cameras", fields)
    return path, table


def _shared_poses(source: Path, names: list[str]) -> dict[str, ndarray]:
    """Read poses of all cameras from one file: by name, or as a list in the order of folders."""
    pickled = source / "calibrate.pkl"
    if pickled.is_file():
        return _in_order(pickled, names, list(read_poses(pickled)))
    path = _table_file(source, _EXTRINSICS)
    if path is None:
        return {}
    table = read_table(path)
    if isinstance(table, dict):
        fields = cast("dict[Any, Any]", table)
        missing = [name for name in names if name not in fields]
        if len(missing) < len(names):
            if missing:
                fail(path, f"has no pose for the view '{missing[0]}'. Add it")
            return {name: read_pose(path, fields[name], name) for name in names}
    elif isinstance(table, list) and _lists_poses(cast("list[Any]", table)):
        entries = cast("list[Any]", table)
        poses = [read_pose(path, one, f"entry {order}") for order, one in enumerate(entries)]
        return _in_order(path, names, poses)
    if len(names) > 1:
        fail(path, f"has no poses by name; expected one for each of {', '.join(names)}")
    return {names[0]: read_pose_file(path)}


def _lists_poses(table: list[Any]) -> bool:
    """Tell several matrices from the rows, or the numbers, of one."""
    return all(
        isinstance(one, dict)
        or (isinstance(one, list) and np.size(cast("list[Any]", one)) in (12, 16))
        for one in table
    )


def _in_order(path: Path, names: list[str], poses: list[ndarray]) -> dict[str, ndarray]:
    if len(poses) != len(names):
        fail(
            path,
            f"has {len(poses)} cameras, but the recording has {len(names)} ({', '.join(names)}). "
            "A camera's folder is missing, or the file is of another recording",
        )
    return dict(zip(names, poses, strict=True))


def _view(
    streams: _Folder,
    shared: tuple[Path, Any] | None,
    pose: ndarray | None,
    *,
    is_alone: bool,
    order: int,
) -> RecordedView:
    camera = _camera(streams, shared, is_alone=is_alone, order=order)
    stream = streams.color or streams.depth
    assert stream is not None  # noqa: S101 - a folder without streams is no camera
    grid = camera
    if streams.color is None and camera.depth is not None:
        grid = camera.depth
    check_camera(grid, stream.width, stream.height, stream.path)
    view = RecordedView(
        name=streams.name,
        folder=streams.folder,
        color=streams.color,
        depth=streams.depth,
        camera=grid,
        T_world_camera=camera.T_world_camera if pose is None else pose,
        depth_scale=camera.depth_scale,
    )
    if view.T_world_camera is None:
        own = _table_file(streams.folder, _EXTRINSICS, ".txt", ".npy")
        view.T_world_camera = None if own is None else read_pose_file(own)
    for one in view.streams:
        read_times(streams.folder, one)
        one.frame_rate = one.frame_rate or camera.frame_rate
    if streams.color is not None and streams.depth is not None:
        _place_depth(view, camera)
    return view


def _camera(
    streams: _Folder, shared: tuple[Path, Any] | None, *, is_alone: bool, order: int
) -> RecordedCamera:
    own = None
    if not is_alone or shared is None:
        own = _table_file(streams.folder, _INTRINSICS, ".txt") or next(
            (path for path in (streams.folder / "K.txt",) if path.is_file()), None
        )
    if own is not None:
        if own.suffix == ".txt":
            return read_camera(own, read_numbers(own))
        return read_camera(own, read_table(own))
    if shared is None:
        fail(
            streams.folder,
            "has no intrinsics. Add intrinsics.json with fx, fy, cx, cy, width and height in "
            "pixels, or give --intrinsics",
        )
    path, table = shared
    if isinstance(table, dict):
        fields = cast("dict[Any, Any]", table)
        key: Any = next((k for k in (streams.name, streams.folder.name) if k in fields), None)
        if key is not None:
            return read_camera(path, fields[key], str(key))
    elif isinstance(table, list):
        rows = cast("list[Any]", table)
        if rows and isinstance(rows[0], dict) and order < len(rows):
            return read_camera(path, rows[order], f"camera {order}")
    return read_camera(path, table)


def _place_depth(view: RecordedView, camera: RecordedCamera) -> None:
    """Find out which camera took the depth images, and where it is beside the color camera."""
    assert view.color is not None  # noqa: S101 - asked by the caller
    assert view.depth is not None  # noqa: S101
    path = _table_file(view.folder, _DEPTH_INTRINSICS)
    depth = camera.depth if path is None else read_camera(path, read_table(path))
    size = (view.depth.width, view.depth.height)
    between = _table_file(view.folder, _DEPTH_TO_COLOR, ".txt", ".npy")
    T_color_depth = camera.T_color_depth if between is None else read_pose_file(between)
    if depth is None:
        if size != view.size:
            fail(
                view.depth.path,
                f"is {size[0]}x{size[1]} px, but color is {view.size[0]}x{view.size[1]} px, and "
                "nothing tells the intrinsics of depth. Add depth_intrinsics.json and "
                "depth_to_color, or record depth aligned to color",
            )
        if T_color_depth is None:
            view.notes.append(
                "Depth is taken as aligned to color, where both have the same size and nothing "
                "else is said."
            )
            return
        depth = view.camera
    check_camera(depth, *size, view.depth.path)
    view.depth_scale = view.depth_scale or depth.depth_scale
    is_same = (
        size == view.size
        and np.allclose(depth.K, view.camera.K, atol=1e-3)
        and np.array_equal(depth.distortion, view.camera.distortion)
    )
    if is_same and (T_color_depth is None or np.allclose(T_color_depth, np.eye(4), atol=1e-5)):
        return
    if T_color_depth is None:
        view.notes.append(
            f"View '{view.name}': depth has intrinsics of its own, but nothing tells where its "
            "camera is; it is taken to be where the color camera is (depth_to_color)."
        )
    view.depth_camera, view.T_color_depth = depth, T_color_depth


def _phystwin_views(source: Path) -> list[RecordedView]:
    """Read what PhysTwin's recorder writes: streams that count their steps each for themselves."""
    path = source / "metadata.json"
    metadata = read_metadata(path)
    poses = _shared_poses(source, [str(n) for n in range(len(metadata.intrinsics))])
    items = _numbered(source / "color")
    table = cast("dict[str, Any]", read_table(path))
    steps: Any = table.get("recording", {})
    views: list[RecordedView] = []
    if [int(item.stem) for item in items] != list(range(len(metadata.intrinsics))):
        fail(
            source / "color",
            f"has the cameras {', '.join(item.name for item in items)}, but metadata.json has "
            f"intrinsics of {len(metadata.intrinsics)}. A camera's folder is missing",
        )
    for number, item in enumerate(items):
        color = _phystwin_stream("color", item)
        folder = source / "depth" / str(number)
        depth = _phystwin_stream("depth", folder) if folder.is_dir() else None
        camera = RecordedCamera(
            path=path,
            K=metadata.intrinsics[number],
            size=(metadata.width, metadata.height),
            frame_rate=metadata.frame_rate,
        )
        check_camera(camera, color.width, color.height, item)
        view = RecordedView(
            name=f"view{number}",
            folder=item,
            color=color,
            depth=depth,
            camera=camera,
            T_world_camera=poses.get(str(number)),
            depth_scale=0.001,
        )
        if depth is not None and (depth.width, depth.height) != view.size:
            fail(folder, f"is {depth.width}x{depth.height} px, but color has another size")
        for stream in view.streams:
            stream.frame_rate = stream.frame_rate or metadata.frame_rate
            _step_times(path, stream, steps, number)
        views.append(view)
    return views


def _phystwin_stream(kind: Any, item: Path) -> RecordedStream:
    if item.is_file():
        return video_stream(item)
    suffixes = COLOR_SUFFIXES if kind == "color" else DEPTH_SUFFIXES
    files = [path for path in item.iterdir() if path.suffix.lower() in suffixes]
    if not files:
        fail(item, f"has no images ({', '.join(sorted(suffixes))})")
    return image_stream(kind, item, files)


def _step_times(path: Path, stream: RecordedStream, steps: Any, number: int) -> None:
    """Give images the times that the recorder noted for their steps."""
    if not isinstance(steps, Mapping) or not stream.files or stream.number is None:
        return
    table = cast("Mapping[Any, Any]", steps)
    own: Any = table.get(str(number), table.get(number))
    if not isinstance(own, Mapping):
        return
    time_of = {str(step): time for step, time in cast("Mapping[Any, Any]", own).items()}
    missing = [step for step in stream.number if str(step) not in time_of]
    if missing:
        fail(path, f"recording.{number} has no time for step {missing[0]} of {stream.path}")
    times = np.array([time_of[str(step)] for step in stream.number], dtype=np.float64)
    back = np.flatnonzero(~(np.diff(times) > 0))
    if len(back):
        step = stream.number[int(back[0]) + 1]
        fail(path, f"recording.{number} goes backwards in time at step {step}")
    stream.time, stream.time_source = times, path.name
