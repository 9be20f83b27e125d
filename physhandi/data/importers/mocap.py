"""Motion capture of a rope that grippers swing: markers in, point controllers out."""

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.interpolate import CubicSpline

from physhandi.data.arrays import read_array
from physhandi.data.length_unit import doubt_extent, doubt_position
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, safe_name
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import ImportFailedError, UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.rotations import parallel_transport, unit_across

_STAGE = "import"
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
LengthUnit = Literal["m", "cm", "mm", "in"]
RestShape = Literal["straight", "first_frame"]
UNITS: dict[LengthUnit, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
"""Metres of a file's length unit."""
LARGEST_STRETCH = 0.4
"""Range of a segment's length (2 to 98 % of the frames) over its median; a rope's is below 0.25."""
SMALLEST_STRETCH = 5e-3
"""Segments whose length varies by less are never refused: that is the markers' noise [m]."""
LARGEST_SEGMENT_RATIO = 10.0
"""Longest over shortest segment; more is a jump between branches."""
LONGEST_CHAIN = 10.0
"""Chains longer than this were not given in the unit that they are read in [m]."""
UPRIGHT = 0.99
"""Sine of the slope from which on a line counts as upright."""
LEAST_BENDING = 4
"""Markers of the shortest rope that can be seen to bend."""
_FEWEST_FRAMES = 8
_SAMPLES_PER_SEGMENT = 64


def import_mocap(
    source: Path | str,
    out: Path | str,
    progress: Progress | None = None,
    *,
    controlled_markers: tuple[int, ...] = (0, 1, 11, 12),
    recording_rate: float = 100.0,
    frame_rate: float = 30.0,
    nodes_per_segment: int = 1,
    node_spacing: float | None = None,
    rest_shape: RestShape = "straight",
    up: Axis = "z",
    unit: LengthUnit = "m",
    overwrite: bool = False,
) -> list[Sequence]:
    """Convert trajectories of a rope's markers, each to a sequence ``out/<name of the file>``.

    A trajectory is a float array "frame marker 3"; the markers are given in their order along the
    rope.

    Args:
        source: One ``.npy`` file, or a folder of them.
        out: Folder of the new sequences.
        progress: Receives a report of every trajectory.
        controlled_markers: Markers that sit on the grippers; they become the controls.
        recording_rate: Frames per second of the recording [Hz].
        frame_rate: Frames per second of the sequence [Hz].
        nodes_per_segment: Object nodes from one marker to the next; fits let ropes bend as elastic
            rods with 1.
        node_spacing: Distance between nodes [m]; replaces `nodes_per_segment` by what the median
            segment needs.
        rest_shape: ``straight``, each segment as long as its median, or as in the ``first_frame``.
        up: Axis of the recording that points up.
        unit: Length unit of the recording.
        overwrite: Whether to replace sequences that are there.

    Returns:
        The sequences, by name.

    Raises:
        ImportFailedError: If a file is no such trajectory, or its markers are no chain; names file,
            frame and marker. Nothing is written then.
        UsageError: If a rate, a count or a spacing is not positive.
    """
    for name, value in (
        ("recording rate", recording_rate),
        ("frame rate", frame_rate),
        ("number of nodes per segment", nodes_per_segment),
        ("node spacing", 1.0 if node_spacing is None else node_spacing),
    ):
        if not 0 < value < math.inf:
            raise UsageError(f"The {name} must be positive, not {value:g}.")
    watched = progress or NullProgress()
    paths = _trajectories(Path(source))
    # All are read before the first is written: a bad one must not leave half of a folder.
    recordings = {path: _read(path, controlled_markers, up, unit) for path in paths}
    sequences: list[Sequence] = []
    for number, (path, marker) in enumerate(recordings.items()):
        watched.check_cancelled()
        resampled = resample(marker, recording_rate, frame_rate).astype(np.float32)
        per_segment = nodes_per_segment
        if node_spacing is not None:
            per_segment = max(1, round(float(np.median(_segment_length(marker))) / node_spacing))
        node, marker_node = refine(resampled[0].astype(np.float64), per_segment)
        rest = node if rest_shape == "first_frame" else straight_chain(marker, per_segment)
        meta = SequenceMeta(
            name=_name(path),
            description=f"Rope with {marker.shape[1]} motion-capture markers, moved by grippers.",
            frame_rate=float(frame_rate),
            frame_count=len(resampled),
            gravity=9.81,
            # Other recordings of the same rope are what a fit is tested on.
            reconstruction=len(resampled),
            controlled_markers=controlled_markers,
            shape="rope",
            provenance={
                "importer": "mocap",
                "file": path.name,
                "recording_rate": float(recording_rate),
                "recorded_frames": len(marker),
                "nodes_per_segment": per_segment,
                "rest_shape": rest_shape,
                "up": up,
                "unit": unit,
            },
        )
        held = held_point(marker, controlled_markers)
        arrays = {
            "control.npy": resampled[:, list(controlled_markers)],
            "marker.npy": resampled,
            "marker_node.npy": marker_node.astype(np.int32),
            "object_node.npy": node.astype(np.float32),
            "rest_node.npy": rest.astype(np.float32),
        }
        if held is not None:
            at_frames = resample(held[:, None], recording_rate, frame_rate)[:, 0]
            arrays["held_point.npy"] = at_frames.astype(np.float32)
        sequences.append(write_sequence(Path(out) / meta.name, meta, arrays, overwrite=overwrite))
        watched.report(_STAGE, number + 1, len(paths), message=meta.name)
    return sequences


def held_point(
    marker: Float[ndarray, "sample marker 3"], controlled_markers: tuple[int, ...]
) -> Float[ndarray, "sample 3"] | None:
    """Lay a point beside the first marker that turns with the gripper that holds the rope there.

    At first the way from the marker to it is as steep as it can be across the line from the first
    to the second marker, so that it is the same in all recordings of a rope. With this line it then
    turns on the shortest way, as a gripper does that does not spin about the rope.

    Args:
        marker: Positions [m].
        controlled_markers: Markers that sit on the grippers.

    Returns:
        The points, half a segment away from the first marker [m]; None if the first two markers are
        not both on a gripper, which then may hold the rope in any direction.
    """
    if not {0, 1} <= set(controlled_markers) or marker.shape[1] < LEAST_BENDING:
        return None
    segment = marker[:, 1] - marker[:, 0]
    tangent = segment / np.linalg.norm(segment, axis=1, keepdims=True)
    # Of a rope that is held upright, x takes the place of the vertical.
    steep = np.eye(3)[2 if abs(tangent[0, 2]) < UPRIGHT else 0]
    axis = parallel_transport(unit_across(steep, tangent[0]), tangent)
    return marker[:, 0] + 0.5 * float(np.median(np.linalg.norm(segment, axis=1))) * axis


def resample(
    marker: Float[ndarray, "sample marker 3"], recording_rate: float, frame_rate: float
) -> Float[ndarray, "frame marker 3"]:
    """Interpolate a recording at another frame rate by cubic splines; the first frame stays [m]."""
    time = np.arange(len(marker)) / recording_rate
    frame_count = int(np.floor(time[-1] * frame_rate + 1e-9)) + 1
    return CubicSpline(time, marker, axis=0)(np.arange(frame_count) / frame_rate)


def refine(
    marker: Float[ndarray, "marker 3"], nodes_per_segment: int
) -> tuple[Float[ndarray, "node 3"], Int[ndarray, " marker"]]:
    """Lay a chain of nodes through markers, evenly spaced along a smooth curve between two of them.

    Args:
        marker: Positions of the markers along the rope [m].
        nodes_per_segment: Nodes from one marker to the next.

    Returns:
        The nodes [m], and the index of the node at each marker.
    """
    chord = np.linalg.norm(np.diff(marker, axis=0), axis=1)
    knot = np.concatenate([[0.0], np.cumsum(chord)])
    curve = CubicSpline(knot, marker, axis=0)
    nodes = [marker[:1]]
    for start, end, last in zip(knot[:-1], knot[1:], marker[1:], strict=True):
        sample_count = _SAMPLES_PER_SEGMENT * nodes_per_segment + 1
        dense = np.linspace(float(start), float(end), sample_count)
        length = np.linalg.norm(np.diff(curve(dense), axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(length)])
        even = np.arange(1, nodes_per_segment) / nodes_per_segment * arc[-1]
        nodes.extend([curve(_interpolate(even, arc, dense)), last[None]])
    return np.concatenate(nodes), np.arange(len(marker)) * nodes_per_segment


def _interpolate(at: ndarray, x: ndarray, value: ndarray) -> Any:
    return np.interp(at, x, value)


def straight_chain(
    marker: Float[ndarray, "frame marker 3"], nodes_per_segment: int
) -> Float[ndarray, "node 3"]:
    """Lay out the rope straight along x, each segment as long as its median [m]."""
    length = np.median(_segment_length(marker), axis=0)
    step = np.repeat(length / nodes_per_segment, nodes_per_segment)
    node = np.zeros((len(step) + 1, 3))
    node[1:, 0] = np.cumsum(step)
    return node


def _trajectories(source: Path) -> list[Path]:
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise ImportFailedError(f"{source} is neither a file nor a folder.")
    paths = sorted(path for path in source.glob("*.npy") if path.name[0] != ".")
    if not paths:
        raise ImportFailedError(f"{source} holds no .npy file; give a folder of trajectories.")
    return paths


def turned_up(
    marker: Float[ndarray, "frame marker 3"], up: Axis
) -> Float[ndarray, "frame marker 3"]:
    """Turn a recording so that its axis `up` becomes z; the axes keep their handedness."""
    axis = "xyz".index(up[-1])
    # The two axes after `up`, in cyclic order, become x and y.
    turned = marker[..., [(axis + 1) % 3, (axis + 2) % 3, axis]]
    return turned * np.array([1.0, -1.0, -1.0]) if up.startswith("-") else turned


def _segment_length(marker: ndarray) -> Float[ndarray, "frame segment"]:
    return np.linalg.norm(np.diff(marker, axis=1), axis=2)


def _read(
    path: Path, controlled_markers: tuple[int, ...], up: Axis, unit: LengthUnit
) -> Float[ndarray, "sample marker 3"]:
    try:
        array = read_array(path)
    except (ValueError, OSError) as error:
        raise ImportFailedError(f"{path.name} is not a readable .npy file: {error}.") from error
    if not np.issubdtype(array.dtype, np.floating) or array.ndim != 3 or array.shape[2] != 3:
        raise ImportFailedError(
            f"{path.name} holds {array.dtype} {array.shape}; expected floating-point numbers "
            "(frame, marker, 3) in metres."
        )
    if len(array) < _FEWEST_FRAMES:
        raise ImportFailedError(
            f"{path.name} has {len(array)} frames; at least {_FEWEST_FRAMES} are needed."
        )
    wrong = [marker for marker in controlled_markers if not 0 <= marker < array.shape[1]]
    if wrong or not controlled_markers or array.shape[1] < 2:
        raise ImportFailedError(
            f"{path.name} has {array.shape[1]} markers, but markers {list(controlled_markers)} "
            "shall be the controls. Name other controls (--controlled-markers), or give a "
            "recording that has them."
        )
    marker = turned_up(array.astype(np.float64) * UNITS[unit], up)
    _check_values(path, marker)
    _check_chain(path, marker, unit)
    return marker


def _check_values(path: Path, marker: ndarray) -> None:
    lost = np.argwhere(~np.isfinite(marker).all(axis=2))
    if lost.size:
        frame, number = lost[0]
        raise ImportFailedError(
            f"{path.name}: frame {frame}, marker {number} is {marker[frame, number].tolist()}. "
            "Cut the recording where a marker is lost, or fill the gap."
        )
    doubt = doubt_position(marker)
    if doubt is not None:
        (frame, number), reason = doubt
        raise ImportFailedError(f"{path.name}: frame {frame}, marker {number} {reason}.")
    reason = doubt_extent(marker[0])
    if reason is not None:
        raise ImportFailedError(f"{path.name}: frame 0 {reason}.")
    short = np.argwhere(_segment_length(marker) < 1e-6)
    if short.size:
        frame, number = short[0]
        raise ImportFailedError(
            f"{path.name}: frame {frame}: markers {number} and {number + 1} are at one place. "
            "Give markers in their order along the rope, each once."
        )


def _check_chain(path: Path, marker: ndarray, unit: LengthUnit) -> None:
    """Refuse markers that are no chain of nearly constant segments, or in a wrong unit."""
    length = _segment_length(marker)
    median = np.median(length, axis=0)
    low, high = np.percentile(length, [2, 98], axis=0)
    if median.sum() > LONGEST_CHAIN:
        raise ImportFailedError(
            f"{path.name}: the markers make a rope of {median.sum():.1f} m, read in {unit}. "
            "Name the recording's unit (--unit)."
        )
    stretch = (high - low) / median
    worst = int(stretch.argmax())
    if stretch[worst] > LARGEST_STRETCH and (high - low)[worst] > SMALLEST_STRETCH:
        raise ImportFailedError(
            f"{path.name}: from marker {worst} to {worst + 1} it is {1e3 * low[worst]:.0f} to "
            f"{1e3 * high[worst]:.0f} mm, but the segments of a rope keep their lengths. Give "
            "markers in their order along one rope, without branches, all axes in one unit."
        )
    longest, shortest = int(median.argmax()), int(median.argmin())
    if median[longest] > LARGEST_SEGMENT_RATIO * median[shortest]:
        raise ImportFailedError(
            f"{path.name}: from marker {longest} to {longest + 1} it is "
            f"{1e3 * median[longest]:.0f} mm, but {1e3 * median[shortest]:.0f} mm from marker "
            f"{shortest} to {shortest + 1}. Give markers in their order along one rope, without "
            "branches."
        )


def _name(path: Path) -> str:
    return safe_name(path.stem) or "trajectory"
