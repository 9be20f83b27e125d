"""Follows points of a thin thing, a rope or a cable, by how far they are from its ends along it.

Optical flow lags along a thin thing: little is painted there, and what is beside it stays. But a
rope hardly stretches, so the length along its centre line from an end that is seen tells which part
of it a place is, in every frame anew, and no error adds up. What hangs together with such an end
without a gap is measured; what a hand hides is not, and what comes out on the other side of it is
measured from the other end.

An *end* is one behind which a view sees past the object, and no hand near. Its place is smoothed
over time, since a pixel more or less of its mask would move all points of the line.

All of it is of no use for what stretches, branches, is knotted, crosses itself or hides its ends;
`thin_tracks` says so, and optical flow follows that as well as it can.
"""

from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from physhandi.data.view import View
from physhandi.perception.centre_line import CentreLine, centre_lines, local_regression
from physhandi.perception.lifting import (
    OBJECT_LABEL,
    VOXEL,
    fuse,
    mask_thickness,
    pixel_values,
    surface_points,
)
from physhandi.perception.point_tracking import (
    SHORTEST_TRACK,
    THIN,
    TRACKING_STAGE,
    PixelTracks,
    solid_depth,
)
from physhandi.perception.shape_class import cell_size
from physhandi.perception.tracks import EDGE_STEP
from physhandi.progress import Progress

_LOOKED_AT = 16
"""Frames of a view by which it is told whether an object is thin."""
_SPACING, _POINTS, _MOST_POINTS = 0.003, 250, 300
"""Distance between tracks along the line [m], unless these are fewer than that along all of it: a
view shows some three fifths of them in its worst frame; and most of them from one end."""
_LONGEST_BRIDGE_S = 0.1
"""Time for which places along a line are interpolated where no line is found [s]."""
_AROUND_END = 2.5
"""Distance beyond an end in which a view sees what is there, in cells."""
_BESIDE_END = 0.5
"""Part of that which belongs to the end itself, as its mask is a pixel or two too wide."""
_NEARER = 0.02
"""What hides an end is nearer by more than this [m]."""
_HIDING_SHARE = 0.1
"""Part of what is seen beyond an end that may do so, by noise."""
_JUMP = 0.06
"""Farthest way that an end moves between two frames in which it is seen [m]."""
_LEAST_SEEN = 0.67
"""Part of all frames in which an end must be seen to be one."""
_SMOOTH_S = 0.15
"""Radius (standard deviation) of the time over which the place of an end is smoothed [s]."""
_LONGEST_GAP = 2.0
"""Time for which the place of an end is known without being seen, in such radii."""
_END_ERROR = 0.004
"""Error from which a measured end counts less [m]."""
_NEAR_END = 2.0
"""Distance from where an end is to where its line ends, in cells: else that one is cut there."""
_MEASURED_SHARE = 0.5
"""Part of a frame's points on measured lines from which the frame is measured."""
_MEASURED_FRAMES = 0.8
"""Part of the frames that must be."""
_STRETCH = 0.06
"""Part of its length by which a thing may seem to stretch."""
_SURFACE = 0.03
"""Farthest way from the centre line to the surface that a view sees [m]."""
_SNAP, _SNAP_RADIUS = 4.0, 3.0
"""Farthest way across the line to the middle of a mask, and the radius in which it is looked for
[px]."""
_BESIDE = np.array([0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0])
"""Ways from there, across the line, to where points are looked for that can be lifted [px]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measured:
    """A line that is measured from one of its ends."""

    line: CentreLine
    origin: float
    """Length along the line at which the end is [m]."""
    sign: int
    """1 if the line runs away from the end, -1 if towards it."""
    extent: float
    """How far from the end the line goes [m]."""

    def places(self, arc: Float[ndarray, " track"]) -> Float[ndarray, "track 3"]:
        """Find the places at lengths from the end; NaN beyond what is seen."""
        return np.where(
            (arc <= self.extent)[:, None], self.line.at(self.origin + self.sign * arc), np.nan
        )


def is_thin(masks: Mapping[str, UInt8[ndarray, "frame row column"]]) -> bool:
    """Tell whether an object is thin in most frames of each view that shows it."""
    thickness = [
        [
            mask_thickness(label == OBJECT_LABEL)
            for label in mask[:: 1 + len(mask) // _LOOKED_AT]
            if (label == OBJECT_LABEL).any()
        ]
        for mask in masks.values()
    ]
    shown = [float(np.median(values)) for values in thickness if values]
    return bool(shown) and max(shown) <= THIN


def thin_tracks(
    views: Many[View],
    masks: Mapping[str, UInt8[ndarray, "frame row column"]],
    frame_rate: float,
    progress: Progress,
) -> tuple[PixelTracks, str]:
    """Follow points of a thin thing by their lengths from its ends.

    Args:
        views: Views with depth.
        masks: Labels of each of them.
        frame_rate: Frames a second [Hz].
        progress: Told after every frame; may cancel.

    Returns:
        By view, positions [px], NaN where a track is not seen, and where it is seen, as
        `track_points` gives them; and, if there are none, why not.

    Raises:
        CancelledError: If the user asked to stop.
    """
    frame_count = len(next(iter(masks.values())))
    lines: list[tuple[CentreLine, ...]] = []
    seen: list[list[ndarray]] = []
    count = np.zeros(frame_count)
    cell = np.zeros(frame_count)
    for frame in range(frame_count):
        progress.check_cancelled()
        labels = [masks[view.name][frame] for view in views]
        depths = [view.depth(frame) for view in views]
        images = list(zip(views, depths, labels, strict=True))
        cloud = fuse(
            [surface_points(view, depth, label == OBJECT_LABEL) for view, depth, label in images]
        ).astype(np.float64)
        count[frame], cell[frame] = len(cloud), cell_size(cloud, VOXEL)
        lines.append(centre_lines(cloud, float(cell[frame])))
        seen.append(_seen_ends(lines[-1], images, float(cell[frame])))
        progress.report(TRACKING_STAGE, frame + 1, 2 * frame_count, None, "Lengths along it")
    chains = _chains(seen)
    measured = [
        _measured(lines, _smoothed(chain, frame_count, _SMOOTH_S * frame_rate), cell)
        for chain in chains
    ]
    trouble = _trouble(lines, measured, count > 0)
    if trouble:
        return {}, trouble
    paths = _paths(measured, max(1, round(_LONGEST_BRIDGE_S * frame_rate)))
    count_all = sum(path.shape[1] for path in paths)
    pixel = {view.name: np.full((frame_count, count_all, 2), np.nan, np.float32) for view in views}
    for frame in range(frame_count):
        progress.check_cancelled()
        for view in views:
            is_object = masks[view.name][frame] == OBJECT_LABEL
            depth = view.depth(frame)
            pixel[view.name][frame] = np.concatenate(
                [_seen_pixels(view, path[frame], is_object, depth) for path in paths]
            )
        done = frame_count + frame + 1
        progress.report(TRACKING_STAGE, done, 2 * frame_count, None, "Along it, from its ends")
    tracks: PixelTracks = {}
    for name, places in pixel.items():
        is_seen = np.asarray(np.isfinite(places).all(axis=-1))
        is_long = is_seen.sum(axis=0) >= min(SHORTEST_TRACK, frame_count)
        if is_long.any():
            tracks[name] = places[:, is_long], is_seen[:, is_long]
    return tracks, "" if tracks else "no view shows it"


def _seen_ends(
    lines: tuple[CentreLine, ...],
    images: Many[tuple[View, Float[ndarray, "row column"], UInt8[ndarray, "row column"]]],
    cell: float,
) -> list[Float[ndarray, " 3"]]:
    """Find the places at which lines end because the thing does."""
    ends: list[ndarray] = []
    for line in lines:
        for end, beyond in ((0.0, -cell), (line.length, line.length + cell)):
            place = line.at(np.array([end, beyond]))
            if any(_shows_end(*image, place, cell) for image in images):
                ends.append(place[0])
    return ends


def _shows_end(
    view: View,
    depth: Float[ndarray, "row column"],
    label: UInt8[ndarray, "row column"],
    place: Float[ndarray, "2 3"],
    cell: float,
) -> bool:
    """Tell whether a view sees an end, and past the object behind it.

    Args:
        view: The view.
        depth: Its depth [m].
        label: Its labels.
        place: The end, and a point one cell beyond it [m].
        cell: Length at which the cloud has no holes [m].
    """
    end, beyond = view.camera.project(place)
    far = float(view.camera.camera_depth(place[0]))
    if not np.isfinite([end, beyond]).all():
        return False
    run = beyond - end
    length = float(np.linalg.norm(run))
    radius = _AROUND_END * cell * float(view.camera.K[0, 0]) / far
    if length < 0.3 * radius / _AROUND_END or (end < radius).any():
        return False  # It points at the camera, or the image ends there.
    if (end > np.array(label.shape[::-1]) - 1 - radius).any():
        return False
    low, high = np.floor(end - radius).astype(int), np.ceil(end + radius).astype(int) + 1
    row, column = np.mgrid[low[1] : high[1], low[0] : high[0]]
    away = np.stack([column, row], axis=-1) - end
    distance = np.linalg.norm(away, axis=-1)
    along = away @ (run / length)
    is_around = distance <= radius
    is_beyond = is_around & (along > _BESIDE_END * distance) & (distance > _BESIDE_END * radius)
    label, depth = label[row, column], depth[row, column]
    is_nearer = (depth > 0) & (depth < far - _NEARER)
    near = is_around & (distance < 0.5 * radius)
    return bool(
        (label[near] == OBJECT_LABEL).any()
        and not (label[is_around & (along > 0)] > OBJECT_LABEL).any()
        and not (label[is_beyond] == OBJECT_LABEL).any()
        and is_nearer[is_beyond].mean() <= _HIDING_SHARE
    )


def _chains(seen: list[list[Float[ndarray, " 3"]]]) -> list[dict[int, Float[ndarray, " 3"]]]:
    """Join ends from frame to frame; the two that are seen most often, if often enough."""
    chains: list[dict[int, ndarray]] = []
    for frame, ends in enumerate(seen):
        heads = [(chain, list(chain.values())[-1]) for chain in chains]
        pair = sorted(
            (float(np.linalg.norm(end - last)), number, at)
            for number, end in enumerate(ends)
            for at, (_, last) in enumerate(heads)
        )
        taken: set[int] = set()
        joined: set[int] = set()
        for distance, number, at in pair:
            if distance <= _JUMP and number not in taken and at not in joined:
                heads[at][0][frame] = ends[number]
                taken.add(number)
                joined.add(at)
        chains += [{frame: end} for number, end in enumerate(ends) if number not in taken]
    often = [chain for chain in chains if len(chain) >= _LEAST_SEEN * len(seen)]
    return sorted(often, key=lambda chain: -len(chain))[:2]


def _smoothed(
    chain: dict[int, Float[ndarray, " 3"]], frame_count: int, radius: float
) -> Float[ndarray, "frame 3"]:
    """Smooth the way of an end by robust local linear regression over time; NaN where unknown."""
    frame, place = np.array(list(chain)), np.stack(list(chain.values()))
    radius = max(radius, 1.0)
    weight = np.ones(len(frame))
    smooth = np.full((frame_count, 3), np.nan)
    away = frame - np.arange(frame_count)[:, None]
    for _ in range(3):
        share = np.exp(-0.5 * (away / radius) ** 2) * weight
        # Where the frames around say nothing of how fast it moves, it does not.
        smooth = local_regression(away, share, 0.1) @ place
        error = np.linalg.norm(smooth[frame] - place, axis=1)
        weight = 1.0 / np.maximum(1.0, error / _END_ERROR) ** 2
    is_far = np.abs(away).min(axis=1) > _LONGEST_GAP * radius
    return np.where(is_far[:, None], np.nan, smooth)


def _measured(
    lines: list[tuple[CentreLine, ...]],
    end: Float[ndarray, "frame 3"],
    cell: Float[ndarray, " frame"],
) -> list[_Measured | None]:
    """Find in each frame the line that begins at an end."""
    by_frame: list[_Measured | None] = []
    for frame, candidates in enumerate(lines):
        best: _Measured | None = None
        least = _NEAR_END * cell[frame]
        for line in candidates if np.isfinite(end[frame]).all() else ():
            ends = line.at(np.array([0.0, line.length]))
            distance = np.linalg.norm(ends - end[frame], axis=1)
            side = int(distance.argmin())
            if distance[side] > least:
                continue
            least = float(distance[side])
            origin = float(line.arc_of(end[frame][None])[0])
            extent = origin if side else line.length - origin
            best = _Measured(line=line, origin=origin, sign=1 - 2 * side, extent=extent)
        by_frame.append(best)
    return by_frame


def _trouble(
    lines: list[tuple[CentreLine, ...]],
    measured: list[list[_Measured | None]],
    is_shown: Bool[ndarray, " frame"],
) -> str:
    """Tell why lengths along a thing are not known; nothing if they are."""
    shown = int(is_shown.sum())
    plain = sum(bool(candidates) for candidates in lines)
    if plain < _MEASURED_FRAMES * shown:
        why = "it branches, is closed, crosses or touches itself"
        return f"it is a plain line in {plain} of {shown} frames: {why}"
    if not measured:
        return "neither of its ends is seen often enough"
    good = 0
    for frame, candidates in enumerate(lines):
        total = sum(line.length for line in candidates)
        parts = [one for chain in measured if (one := chain[frame]) is not None]
        own = {id(one.line): one.line.length for one in parts}
        good += bool(parts) and sum(own.values()) >= _MEASURED_SHARE * total
    if good < _MEASURED_FRAMES * shown:
        return (
            f"half of it or more can be measured from an end that is seen in {good} of {shown} "
            "frames: its ends are hidden"
        )
    whole = _whole_lengths(measured)
    if len(whole) > 1:
        low, high = np.percentile(whole, [10, 90])
        if high - low > _STRETCH * np.median(whole):
            return f"it stretches ({1e3 * low:.0f} to {1e3 * high:.0f} mm)"
    return ""


def _paths(
    measured: list[list[_Measured | None]], longest_bridge: int
) -> list[Float[ndarray, "frame _ 3"]]:
    """Lay out the places of points from each end, as far as it is ever measured from there.

    Where both ends are on one line, each measures up to the middle, or farther where the other one
    never does. Up to `longest_bridge` frames in a row without a line get places between those of
    the frames before and after; whether the object is there is then seen by its masks and depth.
    """
    extents = [[one.extent for one in chain if one is not None] for chain in measured]
    reach = [max(extent) for extent in extents]
    whole = _whole_lengths(measured)
    if whole:
        total, both = float(np.median(whole)), list(zip(*measured, strict=True))
        cut = [max((x[at].extent for x in both if _is_cut(x, at)), default=0.0) for at in (0, 1)]
        middle = 0.5 * (cut[0] + total - cut[1])
        reach = [max(cut[0], middle), max(cut[1], total - middle)]
    spacing = min(_SPACING, sum(reach) / _POINTS)
    parts: list[ndarray] = []
    for chain, length in zip(measured, reach, strict=True):
        arc = np.arange(spacing, length, max(spacing, length / _MOST_POINTS))
        nothing = np.full((len(arc), 3), np.nan)
        path = np.stack([nothing if one is None else one.places(arc) for one in chain])
        parts.append(_bridged(path, [one is not None for one in chain], longest_bridge))
    return parts


def _bridged(
    path: Float[ndarray, "frame track 3"], has_line: Many[bool], longest: int
) -> Float[ndarray, "frame track 3"]:
    """Interpolate places in frames without a line, at most so many in a row."""
    path, frames = path.copy(), np.flatnonzero(has_line)
    for before, after in pairwise(frames.tolist()):
        if 1 < after - before <= longest + 1:
            share = (np.arange(before + 1, after) - before) / (after - before)
            way = path[after] - path[before]
            path[before + 1 : after] = path[before] + share[:, None, None] * way
    return path


def _whole_lengths(measured: list[list[_Measured | None]]) -> list[float]:
    """Measure the thing from end to end in all frames in which both are on one line [m]."""
    if len(measured) != 2:
        return []
    return [
        abs(a.origin - b.origin)
        for a, b in zip(*measured, strict=True)
        if a is not None and b is not None and a.line is b.line
    ]


def _is_cut(ends: tuple[_Measured | None, ...], at: int) -> bool:
    """Tell whether a line is measured from one of its ends alone."""
    one, other = ends[at], ends[1 - at]
    return one is not None and (other is None or other.line is not one.line)


def _seen_pixels(
    view: View,
    place: Float[ndarray, "track 3"],
    is_object: Bool[ndarray, "row column"],
    depth: Float[ndarray, "row column"],
) -> Float[ndarray, "track 2"]:
    """Find where a view sees points of the line [px]; NaN if nowhere.

    Args:
        view: The view.
        place: Points of the line [m]; NaN where not known.
        is_object: Pixels of the object.
        depth: Depth of the view [m].
    """
    is_known = np.asarray(np.isfinite(place).all(axis=1))
    pixel = np.full((len(place), 2), np.nan)
    if is_known.sum() < 2:
        return pixel
    points = place[is_known]
    middle = _on_middle(view.camera.project(points), is_object, _can_lift(depth, is_object))
    there = pixel_values(solid_depth(depth, is_object), middle)
    is_seen = (there > 0) & (np.abs(there - view.camera.camera_depth(points)) < _SURFACE)
    pixel[is_known] = np.where(is_seen[:, None], middle, np.nan)
    return pixel


def _can_lift(
    depth: Float[ndarray, "row column"], is_object: Bool[ndarray, "row column"]
) -> Bool[ndarray, "row column"]:
    """Tell from which pixels on, to the right and down, four see one surface of the object."""
    window, first = np.ones((2, 2), np.uint8), (0, 0)
    low = np.where(is_object & (depth > 0), depth, -1.0).astype(np.float32)
    least = cv2.erode(low, window, anchor=first, borderValue=-1.0)
    most = cv2.dilate(low, window, anchor=first)
    return (least > 0) & (most - least < EDGE_STEP)


def _on_middle(
    pixel: Float[ndarray, "track 2"],
    is_object: Bool[ndarray, "row column"],
    can_lift: Bool[ndarray, "row column"],
) -> Float[ndarray, "track 2"]:
    """Move pixels across the line to the middle of the mask, or beside it where they can be lifted.

    Views differ by a pixel. Of what is two or three pixels wide the four around a place are seldom
    all the object's and on one surface, least of all near a hand, where points tell most.
    """
    pixel = np.nan_to_num(pixel, nan=-1e3)
    run = np.gradient(pixel, axis=0)
    run /= np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-6)
    across = np.stack([-run[:, 1], run[:, 0]], axis=1)
    step = np.arange(-_SNAP, _SNAP + 0.125, 0.25)
    place = pixel[:, None] + step[:, None] * across[:, None]
    column, row = np.moveaxis(place.astype(np.float32), -1, 0)
    share = cv2.remap(is_object.astype(np.float32), column, row, cv2.INTER_LINEAR)
    share = share * np.exp(-0.5 * (step / _SNAP_RADIUS) ** 2)
    middle = (share * step).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-6)
    way = middle[:, None] + _BESIDE
    place = pixel[:, None] + way[..., None] * across[:, None]
    is_good = pixel_values(can_lift, np.floor(place.reshape(-1, 2))).reshape(way.shape) > 0
    chosen = np.where(is_good.any(axis=1), is_good.argmax(axis=1), 0)
    return place[np.arange(len(pixel)), chosen]
