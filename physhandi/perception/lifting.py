"""Lifts depth, masks and tracks of all views into the world and fuses them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence, View
from physhandi.errors import MissingInputError
from physhandi.perception.tracks import EDGE_STEP, lift_pixels, motion_validity
from physhandi.progress import NullProgress, Progress
from physhandi.unique_rows import unique_rows

OBJECT_LABEL = 1
"""Mask value of the object."""
HAND_LABEL = {"right": 2, "left": 3}
"""Mask value of each hand."""
VOXEL = 0.0045
"""Edge of the voxels to which a fused cloud is thinned [m]."""
OUTLIER_RADIUS = 0.012
"""Radius within which a fused point needs neighbours [m]."""
OUTLIER_COUNT = 6
"""Voxels, its own included, that must be occupied within `OUTLIER_RADIUS` of a point."""

_RING = tuple((row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1))
_SOLID_NEIGHBORS, _THIN_NEIGHBORS = 5, 3
_THIN = 4.0
"""Thickness up to which most pixels of a thing are at its edges [px]."""


def observe_object(sequence: Sequence, progress: Progress | None = None) -> ObjectObservation:
    """Collect the observations of a sequence's object in the world frame.

    Markers, where the sequence has them, become the tracks and name their nodes; where it also
    marks which of their motions are valid, they are the cloud too, and no depth is read. Otherwise
    the pixel tracks of every view are lifted by depth; those that frame 0 does not show on the
    object are kept apart, as `ObjectObservation.late`.

    Args:
        sequence: Recording with markers, or with views that have depth and masks.
        progress: Receives a report after every frame; may cancel.

    Returns:
        Tracks of all views side by side and one fused cloud a frame [m].

    Raises:
        MissingInputError: If there are neither markers nor a view with depth and masks.
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    if sequence.marker is not None and sequence.marker_motion_valid is not None:
        return _from_surface_markers(sequence, progress)
    views = sequence.depth_views
    if sequence.marker is None and not views:
        raise MissingInputError(_what_is_missing(sequence, "the object"))
    paths: list[list[ndarray]] = [[] for _ in views]
    clouds: list[ndarray] = []
    for frame in range(sequence.frame_count):
        progress.check_cancelled()
        parts: list[ndarray] = []
        for number, view in enumerate(views):
            depth, is_object = view.depth(frame), view.mask(frame) == OBJECT_LABEL
            parts.append(surface_points(view, depth, is_object))
            if sequence.marker is None and view.track is not None:
                paths[number].append(_lift_tracks(view, frame, depth, is_object))
        if views:
            clouds.append(fuse(parts))
        progress.report("observation", frame + 1, sequence.frame_count)
    if sequence.marker is not None:
        return _from_markers(sequence, tuple(clouds))
    point, late = _join(paths, sequence.frame_count)
    is_visible = np.asarray(np.isfinite(point).all(axis=-1))
    return ObjectObservation(
        point=point.astype(np.float32),
        is_visible=is_visible,
        is_motion_valid=motion_validity(point, is_visible),
        cloud=tuple(clouds),
        late=late.astype(np.float32),
    )


def hand_points(
    sequence: Sequence, progress: Progress | None = None
) -> list[list[Float[ndarray, "point 3"]]]:
    """Lift the pixels of every hand.

    Args:
        sequence: Recording whose views have depth and masks.
        progress: May cancel.

    Returns:
        Fused surface points of each hand of `sequence.hands` in each frame, indexed
        ``[hand][frame]``, in the world frame [m]; a frame that shows nothing has no points.

    Raises:
        MissingInputError: If no view has depth and masks.
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    views = sequence.depth_views
    if not views:
        raise MissingInputError(_what_is_missing(sequence, "the hands"))
    points: list[list[ndarray]] = [[] for _ in sequence.hands]
    for frame in range(sequence.frame_count):
        progress.check_cancelled()
        images = [(view, view.depth(frame), view.mask(frame)) for view in views]
        for hand, side in enumerate(sequence.hands):
            points[hand].append(
                fuse(
                    [
                        surface_points(view, depth, mask == HAND_LABEL[side])
                        for view, depth, mask in images
                    ]
                )
            )
    return points


def surface_points(
    view: View, depth: Float[ndarray, "row column"], is_labelled: Bool[ndarray, "row column"]
) -> Float[ndarray, "point 3"]:
    """Lift the labelled pixels of one depth image, without mixed pixels at depth edges.

    A pixel counts if at least five of the eight around it have the same label and a depth within
    `EDGE_STEP`; a sensor's mixed pixels between foreground and background have fewer. So have most
    pixels of a rope that is two or three pixels wide and above the table: three are enough there.

    Args:
        view: View that recorded the image.
        depth: Depth image, 0 where nothing was measured [m].
        is_labelled: Pixels to lift.

    Returns:
        Points in the world frame [m], row by row.
    """
    good = is_labelled & (depth > 0)
    padded_depth = np.pad(depth, 1)
    padded_good = np.pad(good, 1)
    companions = np.zeros(depth.shape, dtype=np.int64)
    height, width = depth.shape
    for row, column in _RING:
        near = padded_depth[row : row + height, column : column + width]
        company = padded_good[row : row + height, column : column + width]
        companions += company & (np.abs(near - depth) < EDGE_STEP)
    enough = _THIN_NEIGHBORS if mask_thickness(is_labelled) <= _THIN else _SOLID_NEIGHBORS
    rows, columns = np.nonzero(good & (companions >= enough))
    pixel = np.stack([columns, rows], axis=1).astype(np.float64)
    return view.camera.unproject(pixel, depth[rows, columns].astype(np.float64))


def pixel_values(
    image: Shaped[ndarray, "row column"], pixel: Float[ndarray, "*batch 2"]
) -> Float[ndarray, "*batch"]:
    """Look up the values of the nearest pixels; 0 outside of the image, and for NaN."""
    height, width = image.shape
    column, row = np.moveaxis(np.nan_to_num(pixel, nan=-1e6).round().astype(np.int64), -1, 0)
    inside: ndarray = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    value = np.zeros(pixel.shape[:-1], dtype=np.float32)
    value[inside] = image[row[inside], column[inside]]
    return value


def mask_thickness(is_labelled: Bool[ndarray, "row column"]) -> float:
    """Tell how thick what is labelled is in most places [px]; 0 if nothing is."""
    inside = cv2.distanceTransform(is_labelled.astype(np.uint8), cv2.DIST_L2, 3)
    return 2 * float(np.percentile(inside[is_labelled], 90)) if is_labelled.any() else 0.0


def fuse(parts: list[Float[ndarray, "_ 3"]]) -> Float[ndarray, "point 3"]:
    """Join the clouds of several views, thin them to `VOXEL` and drop outliers.

    Args:
        parts: Cloud of each view in the world frame [m].

    Returns:
        One mean point a voxel, in voxel order (x slowest) [m].
    """
    joined = np.concatenate([np.zeros((0, 3)), *parts])
    if len(joined) == 0:
        return joined.astype(np.float32)
    voxel = np.floor(joined / VOXEL).astype(np.int64)
    _, _, owner, count = unique_rows(voxel)
    total = [np.bincount(owner, weights=joined[:, axis]) for axis in range(3)]
    mean = np.stack(total, axis=1) / count[:, None]
    tree = KDTree(mean)
    company = tree.query_ball_point(mean, OUTLIER_RADIUS, return_length=True)
    return mean[company >= OUTLIER_COUNT].astype(np.float32)


def _what_is_missing(sequence: Sequence, subject: str) -> str:
    lacks = [
        f"{view.name}: {' and '.join(part for part, has in parts if not has)}"
        for view in sequence.views
        if (parts := (("depth/", view.has_depth), ("mask/", view.has_mask)))
    ]
    return (
        f"Sequence '{sequence.name}' does not show where {subject} is: no view has both depth and "
        f"masks (missing: {'; '.join(lacks) or 'all views'}). Add views/<view>/depth/ and "
        "views/<view>/mask/, or marker.npy for the object."
    )


def lifted_tracks(view: View) -> Float[ndarray, "frame track 3"]:
    """Lift the tracks of a view in all frames, as `observe_object` does.

    Args:
        view: View with depth and masks.

    Returns:
        Where tracks are in the world [m]; NaN where they are not seen or cannot be lifted.
    """
    return np.stack(
        [
            _lift_tracks(view, frame, view.depth(frame), view.mask(frame) == OBJECT_LABEL)
            for frame in range(view.frame_count)
        ]
    )


def _lift_tracks(
    view: View, frame: int, depth: ndarray, is_object: ndarray
) -> Float[ndarray, "track 3"]:
    if view.track is None:
        return np.zeros((0, 3))
    pixel = view.track[frame].astype(np.float64)
    if view.track_visible is not None:
        pixel[~view.track_visible[frame]] = np.nan
    return lift_pixels(view.camera, depth, is_object, pixel)


def _join(
    paths: list[list[ndarray]], frame_count: int
) -> tuple[Float[ndarray, "frame track 3"], Float[ndarray, "frame late 3"]]:
    """Join the tracks of all views: those that frame 0 shows, and those that it does not."""
    parts = [np.stack(path) for path in paths if path]
    point = np.concatenate([np.zeros((frame_count, 0, 3)), *parts], axis=1)
    is_there = np.asarray(np.isfinite(point).all(axis=-1))
    return point[:, is_there[0]], point[:, ~is_there[0] & is_there.any(axis=0)]


def _from_surface_markers(sequence: Sequence, progress: Progress) -> ObjectObservation:
    """Use markers that sample the visible surface as tracks, and the visible ones as the cloud.

    The recording marks valid motions itself, so no depth is lifted: PhysTwin's Chamfer term
    compares with the visible tracked points alone.
    """
    progress.check_cancelled()
    marker = np.asarray(sequence.marker, dtype=np.float32)
    cloud = tuple(points[np.isfinite(points).all(axis=-1)] for points in marker)
    progress.report("observation", sequence.frame_count, sequence.frame_count)
    return _from_markers(sequence, cloud)


def _from_markers(sequence: Sequence, cloud: tuple[ndarray, ...]) -> ObjectObservation:
    """Use identified markers as tracks; identity makes every observed motion valid."""
    marker = np.asarray(sequence.marker, dtype=np.float32)
    is_visible = np.asarray(np.isfinite(marker).all(axis=-1))
    is_motion_valid = np.zeros_like(is_visible)
    is_motion_valid[1:] = is_visible[1:] & is_visible[:-1]
    if sequence.marker_motion_valid is not None:
        is_motion_valid &= sequence.marker_motion_valid
    return ObjectObservation(
        point=np.where(is_visible[..., None], marker, np.float32(np.nan)),
        is_visible=is_visible,
        is_motion_valid=is_motion_valid,
        cloud=cloud,
        node_of_track=sequence.marker_node,
    )
