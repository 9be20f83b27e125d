"""Variants of a recording as inputs of methods: reduced, noisier, or with the truth.

A variant is a sequence folder of its own, of the same name. It contains no data for scoring and no
provenance from which the recording could be synthesized again with its truth. Methods run on it;
scores are always taken against the recording itself.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.files import named_fields
from physhandi.data.sequence import ARRAYS, Sequence
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.data.truth import ANNOTATION_FOLDER, read_truth
from physhandi.data.untrusted.image_header import announced_size
from physhandi.data.view import View
from physhandi.errors import MissingInputError
from physhandi.synthetic.code_version import INPUTS, code_version

DEPTH_NOISE = 0.001
"""Standard deviation of the paper's disturbed depth [m]."""
TRACK_NOISE = 1.0
"""Standard deviation of the paper's disturbed tracks [px]."""
DISTURBED_HAND = "noisy_hand"
"""The variant whose fitted hands are disturbed."""
SCORING_ONLY = "validation_track.npy"
"""True paths of points, also of future frames, that no stage may fit."""
_GIVEN = ("views/", *(file for file in ARRAYS if file != SCORING_ONLY))
"""Prefixes of the files that a method may read."""
_MILLIMETRES = 1000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class VariantChange:
    """The differences between a variant and its recording; everything else is copied."""

    meta: SequenceMeta
    """Content of its ``sequence.yaml``, from which the provenance is removed."""
    arrays: Mapping[str, ndarray] = field(default_factory=dict[str, ndarray])
    """Changed and additional arrays, by file."""
    images: Mapping[str, ndarray] = field(default_factory=dict[str, ndarray])
    """Changed images, by file."""
    without: tuple[str, ...] = ()
    """Prefixes of files that are left out."""


def unchanged(recording: Sequence, _random: Generator) -> VariantChange:
    """Keep the whole recording."""
    return VariantChange(meta=recording.meta)


def true_hand(recording: Sequence, _random: Generator) -> VariantChange:
    """Replace the hands by point controllers at the vertices of the true hands.

    Raises:
        MissingInputError: If the recording does not tell its true hands.
    """
    vertices = read_truth(recording.folder).hand_vertex
    missing = [side for side in recording.hands if side not in vertices]
    if missing or not recording.hands:
        which = f"truth/hand_{missing[0]}_vertex.npy" if missing else "hands"
        raise MissingInputError(
            f"Sequence '{recording.name}' has no {which}, so the true hand cannot be given."
        )
    control = np.concatenate([vertices[side] for side in recording.hands], axis=1)
    keypoints = tuple(f"views/{view.name}/keypoint.npy" for view in recording.views)
    return VariantChange(
        meta=replace(recording.meta, hands=()),
        arrays={"control.npy": control.astype(np.float32)},
        without=keypoints,
    )


def all_frames(recording: Sequence, _random: Generator) -> VariantChange:
    """Let the fit use every frame, also the held-out ones."""
    return VariantChange(meta=replace(recording.meta, reconstruction=recording.frame_count))


def one_view(recording: Sequence, _random: Generator) -> VariantChange:
    """Keep the first camera alone.

    Raises:
        MissingInputError: If the object is observed by markers, which no single camera sees, or
            there are not several views.
    """
    if recording.marker is not None or len(recording.views) < 2:
        raise MissingInputError(
            f"Sequence '{recording.name}' has {len(recording.views)} views and "
            f"{'markers' if recording.marker is not None else 'no markers'}: one view alone needs "
            "several views with depth and masks, and no markers."
        )
    first, *others = recording.meta.views
    return VariantChange(
        meta=replace(recording.meta, views=(first,)),
        without=tuple(f"views/{view.name}/" for view in others),
    )


def exact_annotation(recording: Sequence, _random: Generator) -> VariantChange:
    """Replace masks and tracks by those without any error; depth and keypoints stay.

    Raises:
        MissingInputError: If the recording does not tell them.
    """
    images: dict[str, ndarray] = {}
    arrays: dict[str, ndarray] = {}
    for view in recording.views:
        exact = exact_view(recording, view)
        for frame in range(recording.frame_count):
            images[f"views/{view.name}/mask/{frame:05d}.png"] = exact.mask(frame)
        for file, array in (("track", exact.track), ("track_visible", exact.track_visible)):
            if array is not None:
                arrays[f"views/{view.name}/{file}.npy"] = array
    return VariantChange(meta=recording.meta, images=images, arrays=arrays)


def exact_view(recording: Sequence, view: View) -> View:
    """Open a view's masks and tracks without any error, which have the view's calibration.

    Raises:
        MissingInputError: If the recording does not tell them.
    """
    folder = recording.folder / ANNOTATION_FOLDER / view.name
    if not folder.is_dir():
        raise MissingInputError(
            f"Sequence '{recording.name}' has no {ANNOTATION_FOLDER}/{view.name}/, so its masks "
            "and tracks are not known without errors."
        )
    return View(folder, recording.name, view.camera, recording.frame_count)


def noisy_depth(recording: Sequence, random: Generator) -> VariantChange:
    """Add the paper's noise to every depth, or along no special axis to markers."""
    images: dict[str, ndarray] = {}
    for view in recording.views:
        for path in sorted((view.folder / "depth").glob("*.png")):
            try:
                announced_size(path)
                depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            except (ValueError, cv2.error) as error:
                raise MissingInputError(f"{path} cannot be decoded: it {error}.") from error
            if depth is None:
                raise MissingInputError(f"{path} cannot be decoded: it is no readable image.")
            noise = random.normal(0.0, DEPTH_NOISE * _MILLIMETRES, depth.shape)
            moved = np.clip(np.rint(depth + noise), 1, np.iinfo(np.uint16).max)
            rel = path.relative_to(recording.folder).as_posix()
            images[rel] = np.where(depth > 0, moved, 0).astype(np.uint16)
    arrays: dict[str, ndarray] = {}
    if recording.marker is not None:
        arrays["marker.npy"] = _disturbed(recording.marker, DEPTH_NOISE, random)
    return VariantChange(meta=recording.meta, arrays=arrays, images=images)


def noisy_tracks(recording: Sequence, random: Generator) -> VariantChange:
    """Add the paper's noise to every track; markers move by as much as a pixel is wide there.

    Raises:
        MissingInputError: If there are neither tracks nor markers with a view to tell pixels by.
    """
    arrays = {
        f"views/{view.name}/track.npy": _disturbed(view.track, TRACK_NOISE, random)
        for view in recording.views
        if view.track is not None
    }
    if recording.marker is not None and recording.views:
        camera = recording.views[0].camera
        place = recording.marker[np.isfinite(recording.marker).all(axis=2)].astype(np.float64)
        pixel = float(np.median(camera.camera_depth(place))) / float(camera.K[0, 0])
        arrays["marker.npy"] = _disturbed(recording.marker, TRACK_NOISE * pixel, random)
    if not arrays:
        raise MissingInputError(f"Sequence '{recording.name}' has no tracks to disturb.")
    return VariantChange(meta=recording.meta, arrays=arrays)


def noisy_hand(recording: Sequence, random: Generator) -> VariantChange:
    """Keep the whole recording; the hands are disturbed after their fit.

    Raises:
        MissingInputError: If there is no hand to fit.
    """
    if not recording.hands:
        raise MissingInputError(f"Sequence '{recording.name}' has no hands to disturb.")
    return unchanged(recording, random)


VARIANTS: dict[str, Callable[[Sequence, Generator], VariantChange]] = {
    "recording": unchanged,
    "true_hand": true_hand,
    "all_frames": all_frames,
    "one_view": one_view,
    "exact_annotation": exact_annotation,
    "noisy_depth": noisy_depth,
    "noisy_tracks": noisy_tracks,
    "noisy_hand": noisy_hand,
}
"""Variants by name."""


def make_variant(recording: Sequence, name: str, folder: Path) -> Sequence:
    """Write a variant of a recording, or open it if it is there.

    Args:
        recording: The whole recording.
        name: One of `VARIANTS`.
        folder: Where variants of this recording lie; it gets a folder for each.

    Raises:
        MissingInputError: If the recording lacks what the variant needs.
    """
    key = f"{recording.fingerprint()[:12]}_{name}_{code_version(INPUTS)}"
    target = folder / key / recording.folder.name
    if target.is_dir():
        return Sequence.load(target)
    change = VARIANTS[name](recording, np.random.default_rng(noise_seed(recording, name)))
    return write_variant(recording, change, target)


def write_variant(recording: Sequence, change: VariantChange, target: Path) -> Sequence:
    """Write what a method may read of a recording, changed, into a folder that is not there yet."""
    left_out = (*change.without, *change.arrays, *change.images)
    with SequenceWriter(target) as writer:
        for path in sorted(recording.folder.rglob("*")):
            rel = path.relative_to(recording.folder).as_posix()
            is_hidden = any(part.startswith(".") for part in rel.split("/"))
            is_given = rel.startswith(_GIVEN) and not rel.startswith(left_out)
            if path.is_file() and not is_hidden and is_given:
                writer.copy(rel, path)
        for view in change.meta.views:  # A view may have held nothing but what is left out.
            writer.make_folder(f"views/{view.name}")
        for rel, array in change.arrays.items():
            writer.save_array(rel, array)
        for rel, image in change.images.items():
            writer.save_image(rel, image)
        # A description tells sizes, a provenance the seed and all levels.
        return writer.finish(replace(change.meta, description="", provenance={}))


def noise_seed(recording: Sequence, variant: str) -> int:
    """Derive a seed from a recording's name and, if it is synthetic, its seed.

    Recordings made wrong by the same noise would not be independent.
    """
    settings = named_fields(recording.provenance.get("synthesize")) or {}
    parts = [variant, recording.name, str(settings.get("seed", ""))]
    return int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:8])


def _disturbed(
    value: Float[ndarray, "frame item _"], deviation: float, random: Generator
) -> Float[ndarray, "frame item _"]:
    return (value + random.normal(0.0, deviation, value.shape)).astype(value.dtype)
