"""Gives a sequence on disk the masks and tracks that stages 2 and 3 need, from clicks."""

import dataclasses
import shutil
from collections.abc import Mapping
from collections.abc import Sequence as Many
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

import physhandi
from physhandi.data.arrays import write_array
from physhandi.data.files import (
    named_fields,
    sweep_temporary,
    sync_folder,
    temporary_name,
    write_bytes,
    write_yaml,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE, UNFINISHED, SequenceMeta, read_meta
from physhandi.data.view import View
from physhandi.errors import SequenceError, UsageError
from physhandi.perception.hand_size import MEASURED_PALMS, palm_length
from physhandi.perception.lifting import HAND_LABEL, OBJECT_LABEL
from physhandi.perception.mask_model import MaskModel
from physhandi.perception.point_tracking import PixelTracks, track_points, visible_on_object
from physhandi.perception.segmentation import (
    Click,
    carry_on,
    check_places,
    detected_keypoints,
    segment,
)
from physhandi.perception.thin_tracking import is_thin, thin_tracks
from physhandi.perception.track_model import TrackModel
from physhandi.progress import NullProgress, Progress

BUILT_IN = "built-in"
"""Source of built-in masks and tracks in the provenance."""
LENGTHS_ALONG = "lengths along it from its ends"
"""Method of tracks of a thin object in the provenance."""
_HASH = "model_sha256"
"""Provenance field of masks and tracks that a model of the user made here."""
_CORRECTIONS = "corrections"
"""Provenance field of masks that somebody painted."""
_TRACK_FILES = ("track.npy", "track_visible.npy")
_FILES = ("mask", *_TRACK_FILES)


def annotate(
    folder: Path | str,
    clicks: Many[Click],
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    mask_model: Path | None = None,
    track_model: Path | None = None,
    trusts_model_code: bool = False,
) -> Sequence:
    """Find object and hands in a sequence, follow points of the object, and store both.

    Nothing is written before everything is found. Then every view gets its new mask folder and
    tracks in place of the old ones, one after the other, and ``sequence.yaml`` says in
    ``provenance`` where they come from.

    Args:
        folder: Folder of the sequence.
        clicks: Places on the object (`Click`); without any, hands alone are found, and no tracks.
        progress: Told about both stages; may cancel.
        overwrite: Whether masks and tracks may be replaced that were not made here.
        mask_model: Folder of SAM 2 or EdgeTAM (`MaskModel`), which finds object and hands in the
            place of what is built in.
        track_model: Folder of CoTracker3 or TAPNext (`TrackModel`), which follows the points.
        trusts_model_code: Whether the user agreed that the tracker's code is executed, in a process
            of its own.

    Returns:
        The sequence as it is now.

    Raises:
        UsageError: If a click makes no sense, there is neither click nor hand, or masks are there
            that were not made here, or a folder holds no such model.
        MissingInputError: If no view has color.
        RunError: If the process of a tracker fails.
        CancelledError: If the user asked to stop; what was there is left.
    """
    progress = progress or NullProgress()
    _mend(Path(folder))
    sequence = Sequence.load(Path(folder))
    if not clicks and not sequence.hands:
        raise UsageError(
            f"Sequence '{sequence.name}' names no hand, and there is no click on an object. Click "
            "on the object in one image (view,frame,x,y)."
        )
    if not overwrite:
        _check_own(sequence)
    with ExitStack() as ended:
        tracker = None
        if track_model is not None:
            tracker = ended.enter_context(
                TrackModel(track_model, sequence, is_trusted=trusts_model_code)
            )
        finder = None if mask_model is None else MaskModel(mask_model)
        check_places(sequence, clicks)
        detected = detected_keypoints(sequence, progress)
        masks = segment(sequence, clicks, progress, finder, detected)
        tracks, method = _follow(sequence, masks, progress, tracker) if clicks else ({}, {})
        about = {
            part: {
                **({"source": BUILT_IN} if model is None else model.provenance()),
                "clicks": [click.to_dict() for click in clicks],
                "version": physhandi.__version__,
            }
            for part, model in (("masks", finder), ("tracks", tracker))
        }
    progress.check_cancelled()
    provenance: dict[str, Any] = {**sequence.provenance, "masks": about["masks"]}
    provenance.pop("tracks", None)
    provenance.pop(MEASURED_PALMS, None)
    if tracks:
        provenance["tracks"] = {**about["tracks"], **method}
    # Keypoints are not kept, so what they say of the depth's scale is.
    if palms := _palm_lengths(sequence, detected):
        provenance[MEASURED_PALMS] = palms
    return _store(sequence, masks, tracks, provenance)


@dataclass(frozen=True, eq=False)
class Correction:
    """The right labels of one image."""

    view: str
    """Name of the view."""
    frame: int
    """Number of the frame."""
    label: UInt8[ndarray, "row column"]
    """0 background, 1 object, 2 right hand, 3 left hand."""


def correct_masks(
    folder: Path | str,
    corrections: Many[Correction],
    progress: Progress | None = None,
    *,
    carries_on: bool = False,
) -> Sequence:
    """Replace masks of single frames by right ones, and follow the object's points anew.

    ``provenance.masks.corrections`` in ``sequence.yaml`` keeps which frames were corrected. Tracks
    that were not made here stay; those of a model of the user are hidden where the object is not.

    Args:
        folder: Folder of the sequence.
        corrections: The right masks.
        progress: Told how far it is; may cancel.
        carries_on: Whether labels of other frames are found anew from these, forwards and
            backwards, until the next frame that was corrected or clicked in.

    Raises:
        UsageError: If a view has no masks to correct, or labels do not fit it.
        CancelledError: If the user asked to stop; what was there is left.
    """
    progress = progress or NullProgress()
    sequence = Sequence.load(Path(folder))
    right: dict[str, list[int]] = {}
    for one in corrections:
        _check_correction(sequence, one)
        right.setdefault(one.view, []).append(one.frame)
    masks = {view.name: _stored_masks(view) for view in sequence.views if view.name in right}
    for one in corrections:
        masks[one.view][one.frame] = one.label
    about = named_fields(sequence.provenance.get("masks")) or {"source": "unknown"}
    if not _is_being_made(sequence.meta):  # Or views lack masks that only a click finds.
        about.pop(UNFINISHED, None)
    earlier = [entry for entry in map(named_fields, _listed(about, _CORRECTIONS)) if entry]
    if carries_on:
        clicks = [entry for entry in map(named_fields, _listed(about, "clicks")) if entry]
        fixed = {
            view: [int(e["frame"]) for e in (*earlier, *clicks) if e.get("view") == view]
            for view in right
        }
        fixed = {view: sorted(set(stay) - set(right[view])) for view, stay in fixed.items()}
        masks = carry_on(sequence, masks, right, fixed, progress)
    tracks: dict[str, tuple[ndarray, ndarray]] = {}
    of_tracks = named_fields(sequence.provenance.get("tracks")) or {}
    if of_tracks.get("source") == BUILT_IN:
        tracks, method = _follow(sequence, masks, progress)
        of_tracks = {key: value for key, value in of_tracks.items() if key != "method"} | method
    else:
        for view in sequence.views:
            if view.track is not None and view.track_visible is not None:
                pixel, visible = np.array(view.track), np.array(view.track_visible)
                if _HASH in of_tracks and view.name in masks:
                    visible = visible_on_object(masks[view.name], pixel, visible)
                tracks[view.name] = pixel, visible
    progress.check_cancelled()
    new = [{"view": one.view, "frame": one.frame, "carried_on": carries_on} for one in corrections]
    done = {(entry["view"], entry["frame"]) for entry in new}
    unchanged = [e for e in earlier if (e.get("view"), e.get("frame")) not in done]
    provenance = {**sequence.provenance, "masks": {**about, _CORRECTIONS: [*unchanged, *new]}}
    if of_tracks:
        provenance["tracks"] = of_tracks
    return _store(sequence, masks, tracks, provenance)


def _palm_lengths(sequence: Sequence, detected: Mapping[str, ndarray]) -> dict[str, float]:
    lengths = {
        view.name: palm_length(view, detected[view.name])
        for view in sequence.views
        if view.has_depth and view.name in detected
    }
    return {name: round(length, 4) for name, length in lengths.items() if length is not None}


def _stored_masks(view: View) -> UInt8[ndarray, "frame row column"]:
    return np.stack([view.mask(frame) for frame in range(view.frame_count)])


def _follow(
    sequence: Sequence,
    masks: Mapping[str, UInt8[ndarray, "frame row column"]],
    progress: Progress,
    tracker: TrackModel | None = None,
) -> tuple[PixelTracks, dict[str, str]]:
    """Follow points of the object, and tell provenance how, where what is built in has a choice.

    Lengths along a thin object need masks of all views; those that are not given are as stored.
    """
    views = [view for view in sequence.views if view.has_color and view.has_depth]
    method: dict[str, str] = {}
    if tracker is None:
        seen = {view.name: masks[view.name] for view in views if view.name in masks}
        others = [view for view in views if view.name not in masks and view.has_mask]
        is_thin_object = is_thin(seen)
        if is_thin_object and others:
            seen |= {view.name: _stored_masks(view) for view in others}
            is_thin_object = is_thin(seen)
        if is_thin_object:
            views = [view for view in views if view.name in seen]
            tracks, trouble = thin_tracks(views, seen, sequence.frame_rate, progress)
            if tracks:
                return tracks, {"method": LENGTHS_ALONG}
            method = {"method": f"optical flow, since {trouble}"}
    return track_points(sequence, masks, progress, tracker), method


def _check_correction(sequence: Sequence, one: Correction) -> None:
    view = next((view for view in sequence.views if view.name == one.view), None)
    if view is None or not view.has_mask:
        raise UsageError(
            f"View '{one.view}' has no masks that could be corrected. Pick the object first."
        )
    if not 0 <= one.frame < view.frame_count:
        raise UsageError(f"View '{one.view}' has no frame {one.frame}.")
    size = (view.camera.height, view.camera.width)
    allowed = {0, OBJECT_LABEL, *(HAND_LABEL[side] for side in sequence.hands)}
    labels = {int(value) for value in np.unique(one.label)}
    if one.label.shape != size or not labels <= allowed:
        raise UsageError(
            f"View '{one.view}', frame {one.frame}: a mask has {size[1]}x{size[0]} px of labels "
            f"{sorted(allowed)}, not {one.label.shape[1]}x{one.label.shape[0]} px of "
            f"{sorted(labels)}."
        )


def _listed(fields: Mapping[str, Any], name: str) -> list[Any]:
    value = fields.get(name)
    return cast("list[Any]", value) if isinstance(value, list) else []


def _store(
    sequence: Sequence,
    masks: Mapping[str, UInt8[ndarray, "frame row column"]],
    tracks: Mapping[str, tuple[ndarray, ndarray]],
    provenance: dict[str, Any],
) -> Sequence:
    """Give views their new masks and tracks, one after the other, and say where they come from."""
    # If the process ends meanwhile, they are known to be ours, and not to be whole.
    _note(sequence, {**provenance, "masks": {**provenance["masks"], UNFINISHED: True}})
    for view in sequence.views:
        sweep_temporary(view.folder.glob(".*.tmp"))
        if view.name not in masks:
            continue
        made = view.folder / temporary_name("annotation")
        try:
            _write(made, masks[view.name], tracks.get(view.name))
            _put_in_place(made, view.folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    _note(sequence, provenance)
    return Sequence.load(sequence.folder)


def _note(sequence: Sequence, provenance: dict[str, Any]) -> None:
    meta = dataclasses.replace(sequence.meta, provenance=provenance)
    write_yaml(sequence.folder / FILE, meta.to_dict())


def lacks_masks(folder: Path) -> bool:
    """Tell whether a sequence has no masks, or was being given them when the process ended.

    Raises:
        SequenceError: If it cannot be opened.
    """
    _mend(folder)
    sequence = Sequence.load(folder)
    return _is_being_made(sequence.meta) or not any(view.has_mask for view in sequence.views)


def _is_being_made(meta: SequenceMeta) -> bool:
    """Tell whether masks were being stored that can be made again, not corrections by hand."""
    about = named_fields(meta.provenance.get("masks")) or {}
    return meta.has_unfinished_masks and not about.get(_CORRECTIONS)


def _mend(folder: Path) -> None:
    """Remove tracks of which a process that ended had put only half in place."""
    meta = read_meta(folder)
    for view in meta.views if meta.has_unfinished_masks else ():
        halves = [folder / "views" / view.name / name for name in _TRACK_FILES]
        if not all(path.is_file() for path in halves):
            for path in halves:
                path.unlink(missing_ok=True)


def _is_own(sequence: Sequence, part: str) -> bool:
    about: Any = sequence.provenance.get(part)
    return isinstance(about, dict) and (about.get("source") == BUILT_IN or _HASH in about)


def _check_own(sequence: Sequence) -> None:
    if _is_being_made(sequence.meta):
        return
    for part, there in (
        ("masks", any(view.has_mask for view in sequence.views)),
        ("tracks", any(view.track is not None for view in sequence.views)),
    ):
        if there and not _is_own(sequence, part):
            raise UsageError(
                f"Sequence '{sequence.name}' has {part} that were not made here. Allow overwriting "
                "to replace them, or annotate a copy."
            )


def _write(
    folder: Path,
    mask: UInt8[ndarray, "frame row column"],
    tracks: tuple[ndarray, ndarray] | None,
) -> None:
    (folder / "mask").mkdir(parents=True)
    for frame, label in enumerate(mask):
        is_encoded, code = cv2.imencode(".png", np.ascontiguousarray(label))
        if not is_encoded:
            raise SequenceError(f"The mask of frame {frame} could not be encoded.")
        write_bytes(folder / "mask" / f"{frame:05d}.png", code.tobytes())
    if tracks is not None:
        write_array(folder / "track.npy", tracks[0])
        write_array(folder / "track_visible.npy", tracks[1])


def _put_in_place(made: Path, view_folder: Path) -> None:
    """Exchange masks and tracks of a view; what was there goes with the temporary folder."""
    old = made / "old"
    old.mkdir()
    for name in _FILES:
        if (view_folder / name).exists():
            (view_folder / name).rename(old / name)
        if (made / name).exists():
            (made / name).rename(view_folder / name)
    sync_folder(view_folder)
