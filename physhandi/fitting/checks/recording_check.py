"""Looks through a whole recording: which stages can run, and every problem with file and frame.

`check_recording` reads all that the format allows, goes on after a broken file, and judges what is
readable by what the stages will look for. Command line, API, pages and Python ask it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from physhandi.data.depth_scale import LARGEST_SCALE, likely_scales
from physhandi.data.files import named_fields
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import SequenceError
from physhandi.fitting.checks.readiness import (
    READABLE,
    SEEN_HAND,
    SEEN_OBJECT,
    StageReadiness,
    readiness,
    shows_palm,
)
from physhandi.fitting.config import HANDS, OBSERVATION, STAGES
from physhandi.perception.hand_size import (
    MEASURED_PALMS,
    PALM_LENGTH,
    PALM_LENGTHS,
    is_impossible_palm,
    palm_length,
)
from physhandi.perception.lifting import (
    HAND_LABEL,
    OBJECT_LABEL,
    fuse,
    surface_points,
)
from physhandi.progress import NullProgress, Progress

CHECK_STAGE = "check"
"""Name of the check in progress reports."""
MOST_PROBLEMS = 200
"""Problems that are listed; more of them say nothing new."""
FEW_PIXELS = 20
"""Labelled pixels with depth below which a frame does not show a thing."""
MUCH_LOST = 0.5
"""Share of the object's pixels without depth from which a frame is doubted."""

_PALMS_STORED = (1e-4, 1e3)
"""Lengths of palms that some scale of depth may have led to; others are no measurement [m]."""

Level = Literal["error", "warning"]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is wrong with a recording, or that will disappoint."""

    level: Level
    """``error``: breaks the format; ``warning``: readable, but a stage gets less than it could."""
    message: str
    """Description of the problem, as a sentence."""
    file: str = ""
    """File or folder below that of the sequence; empty where no single one is to blame."""
    frame: int | None = None
    """First frame that it concerns; None for all."""
    last_frame: int | None = None
    """Last frame of an unbroken row of them; None for all."""
    field: str = ""
    """Field of ``sequence.yaml``, or place in an array."""
    remedy: str = ""
    """Remedy, as part of a sentence."""


@dataclass(frozen=True, kw_only=True)
class RecordingCheck:
    """Readiness of a recording for each stage, and its problems."""

    stages: Mapping[str, StageReadiness]
    """A stage's readiness by its name, in the order of the stages."""
    problems: tuple[Problem, ...]
    """Problems, errors first."""

    @property
    def error(self) -> str | None:
        """The first thing that breaks the format; None if all of it can be read."""
        return next((p.message for p in self.problems if p.level == "error"), None)

    def to_dict(self) -> dict[str, Any]:
        """Describe it in plain data: ``stages problems``."""
        return {
            "stages": {name: stage.to_dict() for name, stage in self.stages.items()},
            "problems": [asdict(problem) for problem in self.problems],
        }


_SCATTERED = Problem(
    level="warning",
    message="What masks label as the object in frame 0 has too few neighbouring points with depth.",
    file="views/*/mask",
    frame=0,
    last_frame=0,
    field=f"label {OBJECT_LABEL}",
    remedy="check depth and calibration there, or bring the cameras nearer to the object",
)


_UNFINISHED = Problem(
    level="warning",
    message="Masks and tracks were being stored when the process ended, so those of some views may "
    "be missing or older than others.",
    file="views/*/mask",
    field="provenance.masks",
    remedy="find or correct them again",
)


def check_recording(
    recording: Sequence | Path | str,
    progress: Progress | None = None,
    *,
    reads_color: bool = True,
) -> RecordingCheck:
    """Read a whole recording and tell what each stage can do with it.

    Args:
        recording: A sequence, or its folder.
        progress: Told how far it is; may cancel.
        reads_color: Whether color images are decoded too, which takes longest.

    Raises:
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    try:
        sequence = recording if isinstance(recording, Sequence) else Sequence.load(recording)
    except SequenceError as error:
        return RecordingCheck(stages=_stopped(STAGES, READABLE), problems=(_broken(error),))
    errors: list[Problem] = []
    total = max(1, sequence.frame_count * sum(2 + view.has_color for view in sequence.views))
    for number, check in enumerate(sequence.checks(reads_color=reads_color)):
        progress.check_cancelled()
        progress.report(CHECK_STAGE, min(number, total), total)
        try:
            check()
        except SequenceError as error:
            errors.append(_broken(error))
    stages = readiness(sequence)
    if any(_stops_all(error, sequence) for error in errors):
        stages = _stopped(STAGES, READABLE)
        return RecordingCheck(stages=stages, problems=tuple(_limited(errors)))
    warnings = [_UNFINISHED] if sequence.meta.has_unfinished_masks else []
    if stages[HANDS].is_ready:
        doubts, is_seen = _judge_hands(sequence)
        warnings += doubts
        if not is_seen:
            # Stage 1 then fails, and with it the run: nothing that follows is reached.
            stages = _stopped(STAGES, SEEN_HAND)
    depth = sequence.depth_views
    if depth:
        shown = _shown_pixels(sequence, depth, progress)
        warnings += _judge_masks(sequence, shown)
    if stages[OBSERVATION].is_ready and not _shows_object(sequence, depth):
        stages = stages | _stopped(STAGES[STAGES.index(OBSERVATION) :], SEEN_OBJECT)
        if not any(problem.frame == 0 for problem in warnings):
            warnings.append(_SCATTERED)
    warnings += _judge_tracks(sequence)
    warnings += depth_scale_problems(sequence)
    progress.report(CHECK_STAGE, total, total)
    return RecordingCheck(stages=stages, problems=tuple(_limited([*errors, *warnings])))


def depth_scale_problems(sequence: Sequence) -> list[Problem]:
    """Name views whose depth shows hands that are larger or smaller than hands are.

    Keypoints are those that are stored, or those that were detected when masks were found.
    """
    detected = named_fields(sequence.provenance.get(MEASURED_PALMS)) or {}
    scales = named_fields(sequence.provenance.get("depth_scale")) or {}
    possible: dict[str, float] = {}
    impossible: list[tuple[View, float]] = []
    for view in sequence.views if sequence.metric else ():
        if not view.has_depth:
            continue
        keypoint = view.keypoint
        palm: Any = detected.get(view.name) if keypoint is None else palm_length(view, keypoint)
        if not isinstance(palm, float) or not _PALMS_STORED[0] < palm < _PALMS_STORED[1]:
            continue
        if is_impossible_palm(palm):
            impossible.append((view, palm))
        else:
            possible[view.name] = palm
    return [_wrong_scale(view, palm, scales.get(view.name), possible) for view, palm in impossible]


def _wrong_scale(view: View, length: float, scale: Any, possible: Mapping[str, float]) -> Problem:
    """Doubt the depth of a view, or its keypoints where other views measure hands of a right size.

    Args:
        view: The view.
        length: From wrist to knuckles in it [m].
        scale: Metres per unit of its depth, if a number is noted.
        possible: The lengths of views in which they are those of hands [m].
    """
    ratio = length / PALM_LENGTH
    right = scale / ratio if isinstance(scale, float) else 0.0
    likely = [one for one in likely_scales(right) if one <= LARGEST_SCALE] if right > 0 else []
    if likely:
        choice = " or ".join(f"{one:g}" for one in likely)
        remedy = f"import it again with --depth-scale {choice}, in the place of {scale:g}"
    else:
        remedy = f"multiply its depth images by {1 / ratio:.2g}"
    low, high = (100 * end for end in PALM_LENGTHS)
    cause = "the scale of its depth is wrong"
    if possible:
        others = ", ".join(f"{100 * palm:.2g} in '{name}'" for name, palm in possible.items())
        cause += f", or its keypoints are not on hands (there are {others})"
        remedy = f"look at its keypoints on the check page; if they are on hands, {remedy}"
    return Problem(
        level="warning",
        message=f"View '{view.name}': by its depth hands measure {100 * length:.3g} cm from wrist "
        f"to knuckles, {ratio:.2g} times as much as a hand's ({low:g} to {high:g} cm): {cause}.",
        file=f"{view.place}/depth",
        remedy=remedy,
    )


def _stopped(stages: Iterable[str], part: str) -> dict[str, StageReadiness]:
    why = {
        READABLE: "the recording breaks the format",
        SEEN_HAND: "no frame shows a hand well enough to place it",
        SEEN_OBJECT: "frame 0 shows no point of the object",
    }[part]
    return dict.fromkeys(stages, StageReadiness(missing=(part,), why=why))


def _broken(error: SequenceError) -> Problem:
    return Problem(
        level="error",
        message=str(error),
        file=error.file,
        frame=error.frame,
        last_frame=error.frame,
        field=error.field,
        remedy=error.remedy,
    )


def _stops_all(error: Problem, sequence: Sequence) -> bool:
    """Tell whether a fit refuses what is broken: color only counts where keypoints are found."""
    for view in sequence.views:
        if error.file.startswith(f"{view.place}/color"):
            return bool(sequence.hands) and not view.has_keypoint
    return not (error.file.startswith("truth/") and "/color" in error.file)


def _limited(problems: list[Problem]) -> list[Problem]:
    if len(problems) <= MOST_PROBLEMS:
        return problems
    more = len(problems) - MOST_PROBLEMS
    rest = Problem(level="warning", message=f"There are {more} further problems.")
    return [*problems[:MOST_PROBLEMS], rest]


def _rows(is_concerned: Bool[ndarray, " frame"]) -> Iterator[tuple[int, int]]:
    """Give first and last frame of every unbroken row."""
    padded = np.concatenate([[False], is_concerned, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        yield int(first), int(end) - 1


def _in_rows(problem: Problem, is_concerned: Bool[ndarray, " frame"]) -> Iterator[Problem]:
    """List a problem once for each row of frames; its message says ``{frames}`` for them."""
    for first, last in _rows(is_concerned):
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        message = problem.message.replace("{frames}", frames)
        yield replace(problem, message=message, frame=first, last_frame=last)


def _judge_hands(sequence: Sequence) -> tuple[list[Problem], bool]:
    """Judge the stored keypoints; tell whether some hand can be placed, as far as they tell."""
    views = [view for view in sequence.views if view.has_keypoint]
    is_searched = any(view.has_color and not view.has_keypoint for view in sequence.views)
    if is_searched or not views:
        return [], True  # Only the networks will tell.
    stored = [view.keypoint for view in views]
    by_view = shows_palm(np.stack([one for one in stored if one is not None]))
    is_shown = np.logical_or.reduce(by_view, axis=0)
    problems: list[Problem] = []
    for hand, side in enumerate(sequence.hands):
        if not is_shown[:, hand].any():
            problems.append(
                Problem(
                    level="warning",
                    message=f"No frame of any view shows the {side} hand: it will be left out.",
                    file="views/*/keypoint.npy",
                    field=f"hand {hand}",
                    remedy="mend keypoint.npy, or take the hand out of 'hands' in sequence.yaml",
                )
            )
            continue
        problem = Problem(
            level="warning",
            message=f"No view shows the {side} hand in {{frames}}: its pose is filled in there.",
            file="views/*/keypoint.npy",
            field=f"hand {hand}",
            remedy="check the keypoints there, or cut these frames out",
        )
        problems += _in_rows(problem, ~is_shown[:, hand])
    return problems, bool(is_shown.any())


@dataclass(frozen=True, eq=False)
class _Shown:
    """Labelled pixels of all views with depth and masks, by label and frame."""

    with_depth: Int[ndarray, "label frame"]
    all_of_them: Int[ndarray, "label frame"]


def _shown_pixels(sequence: Sequence, views: list[View], progress: Progress) -> _Shown:
    shape = (4, sequence.frame_count)
    with_depth, all_of_them = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for view in views:
        for frame in range(sequence.frame_count):
            progress.check_cancelled()
            mask, is_measured = view.mask(frame), view.depth(frame) > 0
            all_of_them[:, frame] += np.bincount(mask.reshape(-1), minlength=4)
            with_depth[:, frame] += np.bincount(mask[is_measured], minlength=4)
    return _Shown(with_depth, all_of_them)


def _judge_masks(sequence: Sequence, shown: _Shown) -> list[Problem]:
    problems: list[Problem] = []
    file = "views/*/mask"
    if sequence.missing("marker"):
        seen, labelled = shown.with_depth[OBJECT_LABEL], shown.all_of_them[OBJECT_LABEL]
        unseen = Problem(
            level="warning",
            message="No mask labels the object in {frames}, where depth was measured.",
            file=file,
            field=f"label {OBJECT_LABEL}",
            remedy="label the object (1) in at least one view with depth",
        )
        problems += _in_rows(unseen, seen < FEW_PIXELS)
        lost = Problem(
            level="warning",
            message="More than half of the object's pixels have no depth in {frames}.",
            file="views/*/depth",
            remedy="check depth there: glossy, dark or near surfaces are not measured",
        )
        is_poor = (seen >= FEW_PIXELS) & (seen < (1 - MUCH_LOST) * labelled)
        problems += _in_rows(lost, is_poor)
    for side in sequence.hands:
        label = HAND_LABEL[side]
        if (shown.with_depth[label] < FEW_PIXELS).all():
            problems.append(
                Problem(
                    level="warning",
                    message=f"No mask labels the {side} hand: depth cannot tell how far it is.",
                    file=file,
                    field=f"label {label}",
                    remedy=f"label the {side} hand ({label}) in the masks of a view with depth",
                )
            )
    return problems


def _judge_tracks(sequence: Sequence) -> list[Problem]:
    views = [view for view in sequence.views if view.track_visible is not None]
    if not views:
        return []
    first = [int(np.sum(view.track_visible[0])) for view in views if view.track_visible is not None]
    if any(first):
        return []
    return [
        Problem(
            level="warning",
            message="No track is visible in frame 0, so none of them is used.",
            file="views/*/track_visible.npy",
            frame=0,
            last_frame=0,
            remedy="begin tracks on the object in frame 0",
        )
    ]


def _shows_object(sequence: Sequence, views: list[View]) -> bool:
    """Tell whether nodes can be laid into frame 0, by the cloud that the stage will look at."""
    if not sequence.missing("object_node"):
        return True
    if sequence.marker is not None and sequence.marker_motion_valid is not None:
        return bool(np.isfinite(sequence.marker[0]).all(axis=-1).any())
    parts = [surface_points(view, view.depth(0), view.mask(0) == OBJECT_LABEL) for view in views]
    return len(fuse(parts)) > 0
