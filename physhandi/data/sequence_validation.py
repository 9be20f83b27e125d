"""Checks of a sequence's files: cheap ones when it is loaded, thorough ones on request."""

from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy import ndarray

from physhandi.data.atomic import read_array
from physhandi.data.length_unit import (
    FARTHEST,
    doubt_depth,
    doubt_extent,
    doubt_keypoints,
    doubt_position,
)
from physhandi.data.sequence_schema import FILE, SequenceMeta
from physhandi.data.truth import FOLDER as TRUTH
from physhandi.data.view import View
from physhandi.errors import SequenceError

_F, _I, _B = "floating-point", "integer", "boolean"
_KINDS: dict[str, Any] = {_F: np.floating, _I: np.integer, _B: np.bool_}
_Table = dict[str, tuple[tuple[str | int, ...], str, bool]]

# File: axes ("frame" is the sequence's), kind of number, whether NaN may stand for "not seen".
ARRAYS: _Table = {
    "control.npy": (("frame", "control", 3), _F, False),
    "marker.npy": (("frame", "marker", 3), _F, True),
    "marker_node.npy": (("marker",), _I, False),
    "marker_motion_valid.npy": (("frame", "marker"), _B, False),
    "validation_track.npy": (("frame", "validation", 3), _F, True),
    "object_node.npy": (("node", 3), _F, False),
    "rest_node.npy": (("node", 3), _F, False),
}
VIEW_ARRAYS: _Table = {
    "keypoint.npy": (("frame", "hand", 21, 3), _F, True),
    "track.npy": (("frame", "track", 2), _F, True),
    "track_visible.npy": (("frame", "track"), _B, False),
}

_SIDES = ("right", "left")
# Axes that must not be empty: without a node or a control there is nothing to simulate.
_NEEDED = {"control", "marker", "node"}
TRUTH_ARRAYS: _Table = {
    **{f"hand_{side}_keypoint.npy": (("frame", 21, 3), _F, False) for side in _SIDES},
    **{f"hand_{side}_vertex.npy": (("frame", f"{side} vertex", 3), _F, False) for side in _SIDES},
    "contact_point.npy": (("point", 3), _F, False),
    "contact.npy": (("frame", "point"), _B, False),
    "object_point.npy": (("frame", "point", 3), _F, False),
    "object_face.npy": (("object face", 3), _I, False),
}


def check_layout(folder: Path, meta: SequenceMeta, views: tuple[View, ...]) -> None:
    """Check that the files fit to ``sequence.yaml`` and to each other, without decoding images.

    Raises:
        SequenceError: At the first thing that is wrong.
    """
    axes = {"frame": meta.frame_count, "hand": len(meta.hands)}
    _check_arrays(folder, folder, meta.name, ARRAYS, axes)
    _check_arrays(folder, folder / TRUTH, meta.name, TRUTH_ARRAYS, {"frame": meta.frame_count})
    for view in views:
        if not view.folder.is_dir():
            _fail(meta.name, f"views/{view.name}", f"is missing, but {FILE} lists it")
        # Each view has its own number of tracks.
        _check_arrays(folder, view.folder, meta.name, VIEW_ARRAYS, dict(axes))
        has_track = [(view.folder / f).is_file() for f in ("track.npy", "track_visible.npy")]
        if has_track[0] != has_track[1]:
            _fail(meta.name, f"views/{view.name}", "needs both track.npy and track_visible.npy")
        view.check_presence()
    _check_markers(folder, meta, axes)


def check_values(
    folder: Path, meta: SequenceMeta, views: tuple[View, ...], *, reads_color: bool = True
) -> None:
    """Read every frame of every part and check sizes, labels, finiteness and the unit of lengths.

    Args:
        folder: Folder of the sequence.
        meta: Its description.
        views: Its views.
        reads_color: Whether color images are decoded too, which takes longest.

    Raises:
        SequenceError: At the first thing that is wrong.
    """
    name = meta.name
    for file in ARRAYS:
        _check_finite(folder, folder / file, name)
    for file in TRUTH_ARRAYS:
        _check_finite(folder, folder / TRUTH / file, name)
    _check_motion(folder, name)
    if meta.metric:
        _check_unit(folder, meta)
    for view in views:
        for file in VIEW_ARRAYS:
            _check_finite(folder, view.folder / file, name)
        _check_tracks(view, name)
        _check_keypoints(view, name)
        readers = ((view.has_color and reads_color, view.color), (view.has_mask, view.mask))
        for read in [read for is_there, read in readers if is_there]:
            for frame in range(view.frame_count):
                read(frame)
        view.close()
        if view.has_depth:
            depth = [view.depth(frame).max(initial=0.0) for frame in range(view.frame_count)]
            doubt = doubt_depth(round(1e3 * float(max(depth))))
            if doubt is not None and meta.metric:
                _fail(name, f"views/{view.name}/depth", doubt)


def _check_unit(folder: Path, meta: SequenceMeta) -> None:
    """Refuse lengths that look like millimetres, or like thousandths of metres."""
    for view in meta.views:
        doubt = doubt_position(view.camera.T_world_camera[:3, 3])
        if doubt is not None:
            _fail(meta.name, f"{FILE}: T_world_camera of view '{view.name}'", doubt[1])
    for file, (axes, kind, _) in ARRAYS.items():
        if kind != _F or not (folder / file).is_file():
            continue
        position = read_array(folder / file)
        doubt = doubt_position(position, FARTHEST)
        if doubt is not None:
            at = ", ".join(f"{axis} {index}" for axis, index in zip(axes, doubt[0], strict=False))
            _fail(meta.name, f"{file}: {at}", doubt[1])
        small = doubt_extent(position) if file in {"object_node.npy", "rest_node.npy"} else None
        if small is not None:
            _fail(meta.name, file, small)


def _check_arrays(
    root: Path, folder: Path, name: str, table: _Table, axis_size: dict[str, int]
) -> None:
    for file_name, (axes, kind, _) in table.items():
        path = folder / file_name
        if not path.is_file():
            continue
        file = path.relative_to(root).as_posix()
        try:
            array = read_array(path, mmap=True)
        except (ValueError, OSError) as error:
            _fail(name, file, f"is not a readable .npy file: {error}")
        text = "(" + ", ".join(str(axis) for axis in axes) + ")"
        if not np.issubdtype(array.dtype, _KINDS[kind]):
            _fail(name, file, f"holds {array.dtype}; expected {kind} numbers {text}")
        pairs = zip(axes, array.shape, strict=False)
        fixed = [isinstance(axis, str) or size == axis for axis, size in pairs]
        if array.ndim != len(axes) or not all(fixed):
            _fail(name, file, f"has shape {array.shape}; expected axes {text}. Re-export it")
        for axis, size in zip(axes, array.shape, strict=True):
            if size == 0 and axis in _NEEDED:
                _fail(name, file, f"has shape {array.shape}: no {axis} at all. Remove or fill it")
            expected = axis_size.setdefault(axis, size) if isinstance(axis, str) else size
            if size != expected:
                _fail(
                    name,
                    file,
                    f"has shape {array.shape} for axes {text}; expected {axis} = {expected}, "
                    f"as {FILE} or another file says. Re-export it or correct {FILE}",
                )


def _check_markers(folder: Path, meta: SequenceMeta, axes: dict[str, int]) -> None:
    for file in ("rest_node.npy", "marker_node.npy"):
        if (folder / file).is_file() and not (folder / "object_node.npy").is_file():
            _fail(meta.name, file, "is about nodes, but object_node.npy is missing. Add it")
    path = folder / "marker_node.npy"
    nodes = read_array(path) if path.is_file() else np.zeros(0, int)
    node_count = axes.get("node", 0)
    if nodes.size and not 0 <= nodes.min() <= nodes.max() < node_count:
        _fail(
            meta.name,
            "marker_node.npy",
            f"names nodes {nodes.min()} to {nodes.max()}, but object_node.npy has {node_count}",
        )
    marker_count = axes.get("marker", 0)
    wrong = [marker for marker in meta.controlled_markers if marker >= marker_count]
    if wrong:
        reason = f"lists controlled_markers {wrong[0]}, but marker.npy has {marker_count} markers"
        _fail(meta.name, FILE, reason)
    if (meta.surface_node_count or 0) > node_count:
        reason = f"says surface_node_count {meta.surface_node_count}, but object_node.npy has "
        _fail(meta.name, FILE, f"{reason}{node_count} nodes")


def _check_finite(root: Path, path: Path, name: str) -> None:
    axes, kind, may_be_nan = (ARRAYS | VIEW_ARRAYS | TRUTH_ARRAYS)[path.name]
    if kind != _F or not path.is_file():
        return
    array = read_array(path)
    is_wrong: ndarray = np.isinf(array) if may_be_nan else ~np.isfinite(array)
    if is_wrong.any():
        place = tuple(int(index) for index in np.argwhere(is_wrong)[0])
        named = ("joint" if axis == 21 else axis for axis in axes)
        at = ", ".join(f"{axis} {index}" for axis, index in zip(named, place[:-1], strict=False))
        file = path.relative_to(root).as_posix()
        _fail(name, file, f"is {array[place]} at {at}. Repair or cut out these frames")


def _check_motion(folder: Path, name: str) -> None:
    """Check that a trusted motion joins two frames in which its marker was seen."""
    file = "marker_motion_valid.npy"
    if not (folder / file).is_file():
        return
    if not (folder / "marker.npy").is_file():
        _fail(name, file, "says which motions of markers to trust, but there is no marker.npy")
    is_valid = read_array(folder / file)
    marker = read_array(folder / "marker.npy")
    is_seen = np.asarray(np.isfinite(marker).all(axis=-1))
    can_be_valid = np.zeros_like(is_seen)
    can_be_valid[1:] = is_seen[1:] & is_seen[:-1]
    wrong = np.argwhere(is_valid & ~can_be_valid)
    if wrong.size:
        frame, marker = wrong[0]
        _fail(
            name,
            file,
            f"trusts the motion of marker {marker} to frame {frame} from the frame before, but "
            "marker.npy does not have both positions. Entry [t] must mean frame t-1 to t",
        )


def _check_tracks(view: View, name: str) -> None:
    if view.track is None or view.track_visible is None:
        return
    lost = np.argwhere(view.track_visible & np.isnan(view.track).any(-1))
    if lost.size:
        frame, track = lost[0]
        _fail(
            name,
            f"views/{view.name}/track.npy",
            f"is NaN at frame {frame}, track {track}, which track_visible.npy calls visible. "
            "Mark it as not visible",
        )


def _check_keypoints(view: View, name: str) -> None:
    if view.keypoint is None:
        return
    doubt = doubt_keypoints(view.keypoint, view.camera.width, view.camera.height)
    if doubt is not None:
        frame, hand, joint = doubt[0]
        file = f"views/{view.name}/keypoint.npy: frame {frame}, hand {hand}, joint {joint}"
        _fail(name, file, doubt[1])


def _fail(name: str, file: str, reason: str) -> NoReturn:
    raise SequenceError(f"Sequence '{name}': {file} {reason}.")
