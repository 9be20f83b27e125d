"""Warnings about the result of a fit: text for people, with a code for programs.

`fit_warnings` looks at what a run has stored of a sequence and at its measures. The measures of
predicted frames compare with what the recording shows there, so these warnings are results as well:
nothing that is fitted may depend on them.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from physhandi.data.files import named_fields
from physhandi.data.layout import SEARCH_FILE, SHAPE_FILE, STEADINESS_FILE, SequenceFiles
from physhandi.data.run_folder import read_yaml, reading
from physhandi.data.sequence import Sequence
from physhandi.fitting import artefacts
from physhandi.fitting.checks.readiness import LEAST_PALM_POINTS, shows_palm, skipped_object
from physhandi.fitting.config import INTERVALS, SearchVariable
from physhandi.fitting.search_bounds import (
    NEAR_GRIP,
    bounds_met,
    interval_text,
    neighbor_distance,
)
from physhandi.fitting.spring_optimisation import unsteadiness
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import PARAMETERS

Code = Literal[
    "at_bound",
    "unsteady",
    "stuck",
    "worse_than_static",
    "worse_than_rigid_follow",
    "worse_than_last_residual",
    "hand_holds_nothing",
    "controls_hold_nothing",
    "loose_nodes",
    "few_observations",
    "object_points_removed",
    "object_skipped",
    "hand_left_out",
    "hand_filled",
    "hand_by_one_view",
    "hand_away",
]
MARGIN, LEAST_EXCESS = 0.1, 5e-4
"""Part of a baseline's error, and length [m], by which a fit must exceed it to be called worse."""
FEW_POINTS = 10
"""Points of the object below which a frame shows too little of it."""
FEW_FRAMES = 0.2
"""Share of the fitted frames that may show too little."""
FEW_SEEN = 0.5
"""Share of the frames in which a hand must be seen; in others its pose is filled in."""
AGREEING = 0.25
"""Share of a hand's size in an image up to which a view agrees with where it was fitted."""
_RIVALS: dict[str, tuple[Code, str]] = {
    "static": ("worse_than_static", "an object that stays as it is in frame 0"),
    "rigid_follow": (
        "worse_than_rigid_follow",
        "an object that moves rigidly with the controls",
    ),
    "last_residual": (
        "worse_than_last_residual",
        "the same prediction shifted by what it missed in the last fitted frame",
    ),
}
_SPLITS = {"reconstruction": "fitted", "future": "predicted"}
_ADVICE = {
    "reconstruction": "Look at the worst frames in the viewer; a longer search, or a profile with "
    "more nodes, may help.",
    "future": "The fitted parameters explain what was seen, but do not predict: fit more frames or "
    "several recordings of the object.",
}


@dataclass(frozen=True, kw_only=True)
class FitWarning:
    """One doubt about a fit."""

    code: Code
    """Kind of warning."""
    message: str
    """Finding and remedy, for people."""


def with_warnings(out: Path, sequence: Sequence, scores: Mapping[str, Any]) -> dict[str, Any]:
    """Add what there is to doubt to the measures of a sequence.

    Args:
        out: Output folder of the run.
        sequence: The sequence.
        scores: Its measures (`metrics.report.score_run`).

    Returns:
        The measures, with ``warnings``: ``code message`` each. Without an object they are only
        there if there are any.

    Raises:
        RunError: If a file of the run is damaged.
    """
    doubts = fit_warnings(out, sequence, scores)
    if not doubts and not (out / SequenceFiles(sequence.name).model).is_file():
        return dict(scores)
    return {**scores, "warnings": [asdict(warning) for warning in doubts]}


def fit_warnings(out: Path, sequence: Sequence, scores: Mapping[str, Any]) -> list[FitWarning]:
    """Collect the doubts about the hands and the object that were fitted in a sequence.

    Args:
        out: Output folder of the run. What it does not hold, such as the intervals of the search
            in runs of earlier versions, is not judged.
        sequence: The sequence.
        scores: Its measures (`metrics.report.score_run`).

    Raises:
        RunError: If a file of the run is damaged.
    """
    files = SequenceFiles(sequence.name)
    if not (out / files.model).is_file():
        message = skipped_object([sequence])
        skipped = [] if message is None else [FitWarning(code="object_skipped", message=message)]
        return [*skipped, *_unseen_hands(out, sequence), *_lone_views(out, sequence)]
    doubts = [*_at_bounds(out), *_unsteady(out), *_stuck(out, sequence.name)]
    doubts += _worse_than_baselines(scores)
    doubts += _doubts_of_shape(out)
    model = artefacts.load_model(out, sequence.name)
    doubts += [
        *_empty_hands(out, sequence, model),
        *_away(out, sequence, model),
        *_loose_nodes(model),
    ]
    if (out / files.observation("point")).is_file():
        doubts += _few_observations(out, sequence)
    return [*doubts, *_unseen_hands(out, sequence), *_lone_views(out, sequence)]


def _doubts_of_shape(out: Path) -> Iterator[FitWarning]:
    """Repeat what was found when the object got its nodes."""
    if not (out / SHAPE_FILE).is_file():
        return
    for warning in (named_fields(read_yaml(out / SHAPE_FILE)) or {}).get("warnings") or ():
        yield FitWarning(code="object_points_removed", message=str(warning["message"]))


def _at_bounds(out: Path) -> Iterator[FitWarning]:
    if not (out / SEARCH_FILE).is_file():
        return
    searched = (
        named_fields((named_fields(read_yaml(out / SEARCH_FILE)) or {}).get("intervals")) or {}
    )
    intervals = {name: SearchVariable.from_dict(value) for name, value in searched.items()}
    parameters = artefacts.load_parameters(out)
    for name, end in bounds_met(parameters, intervals).items():
        side = "high" if end == intervals[name].high else "low"
        unit = PARAMETERS[name].unit
        yield FitWarning(
            code="at_bound",
            message=f"{name} ended at {getattr(parameters, name):.4g}{f' {unit}' if unit else ''}, "
            f"the {side} end of the interval in which it was searched "
            f"({interval_text(name, intervals[name])}): a better value may lie beyond. Widen "
            f"{INTERVALS}.{name}.{side}, or raise object_.search.generations.",
        )


def _unsteady(out: Path) -> Iterator[FitWarning]:
    """Tell if the fitted motion goes elsewhere with a little more or less stiffness."""
    path = out / STEADINESS_FILE
    if not path.is_file():
        return
    with reading(path):
        steadiness = named_fields(read_yaml(path)) or {}
        nudge, sway, limit = (steadiness[name] for name in ("nudge", "sway", "limit"))
        sway = math.inf if sway is None else sway
        is_steady = sway <= limit
    if not is_steady:
        yield FitWarning(
            code="unsteady",
            message=f"{unsteadiness(nudge, sway, limit)} The object is about to buckle, and "
            "rounding decides which way it goes, so its prediction is partly luck. Try another "
            "seed of the search (object_.search.seed), a longer connection_radius, or more frames.",
        )


def _stuck(out: Path, name: str) -> Iterator[FitWarning]:
    """Tell if the fit holds still what was seen to slide."""
    restart = artefacts.load_restart(out, name)
    if restart is None or restart.friction_share == 1.0:
        return
    fitted = artefacts.load_parameters(out)
    left = restart.parameters_after(fitted).friction
    yield FitWarning(
        code="stuck",
        message="In the last fitted frames the object was seen to slide over the ground, where its "
        f"friction of {fitted.friction:.2g} holds it in the fit. The frames after them are "
        f"predicted with {left:.2g}, with which it goes on as fast. Frames in which it lies still "
        "tell only that friction is enough: fit more frames in which it slides.",
    )


def _worse_than_baselines(scores: Mapping[str, Any]) -> Iterator[FitWarning]:
    for split, frames in _SPLITS.items():
        part = named_fields(scores.get(split)) or {}
        own = named_fields(part.get("rollout")) or {}
        for rival, (code, about) in _RIVALS.items():
            other = named_fields(part.get(rival)) or {}
            measure = next(
                (name for name in ("track_error", "chamfer_l2") if own.get(name) is not None), None
            )
            theirs = None if measure is None else other.get(measure)
            if measure is None or theirs is None:
                continue
            if own[measure] - theirs <= max(MARGIN * theirs, LEAST_EXCESS):
                continue
            yield FitWarning(
                code=code,
                message=f"In the {frames} frames the {measure.replace('_', ' ')} is "
                f"{1e3 * own[measure]:.1f} mm, but that of {about} is {1e3 * theirs:.1f} mm. "
                f"{_ADVICE[split]}",
            )


def _empty_hands(out: Path, sequence: Sequence, model: SpringMassModel) -> Iterator[FitWarning]:
    """Find hands, or point controllers, without a virtual spring."""
    attached = artefacts.load_attachment(out, sequence.name)
    if not len(attached):
        return
    remedy = "raise virtual_connection_radius if it should touch the object at frame 0"
    ends = model.spring_nodes[model.object_spring_count :].max(axis=1, initial=0)
    holding = np.unique(ends[ends >= model.node_count]) - model.node_count
    surfaces = {
        side: artefacts.load_array(path)[0]
        for side in sequence.hands
        if (path := out / SequenceFiles(sequence.name).hand_vertex(side)).is_file()
    }
    if sequence.control is not None or not surfaces:
        if not len(holding):
            yield FitWarning(
                code="controls_hold_nothing",
                message=f"No virtual spring joins a control node to the object: {remedy}.",
            )
        return
    # Control nodes are vertices of the hands, all or some; refinement moved them a little.
    owner = np.repeat(np.arange(len(surfaces)), [len(surface) for surface in surfaces.values()])
    tree = KDTree(np.concatenate(list(surfaces.values())))
    held_by = set(owner[np.asarray(tree.query(attached[holding])[1])].tolist())
    for number, side in enumerate(surfaces):
        if number not in held_by:
            yield FitWarning(
                code="hand_holds_nothing",
                message=f"The {side} hand holds nothing: no virtual spring joins it to the object, "
                f"so it does not move it. Check where it is in the viewer; {remedy}.",
            )


def _away(out: Path, sequence: Sequence, model: SpringMassModel) -> Iterator[FitWarning]:
    """Tell if hands are where they could not hold what they move."""
    contacts = artefacts.load_contacts(out, sequence.name)
    if contacts is None or not sequence.hands:
        return
    spacing = neighbor_distance(model.object_node.astype(np.float64))
    gap = contacts.median_distance(len(sequence.reconstruction_frames))
    if gap > NEAR_GRIP * spacing:
        yield FitWarning(
            code="hand_away",
            message=f"Most of the time, what a hand moves was {1e3 * gap:.0f} mm from it when it "
            f"took hold, where nodes are {1e3 * spacing:.0f} mm apart: a hand is likely not where "
            "it was fitted. The object follows it all the same, but not as surely. Look at the "
            "hands over the video; larger images, or keypoints of another detector (keypoint.npy), "
            "help.",
        )


def _unseen_hands(out: Path, sequence: Sequence) -> Iterator[FitWarning]:
    """Find hands that stage 1 left out, or whose pose it filled in in most frames."""
    files = SequenceFiles(sequence.name)
    if not (out / files.keypoint).is_file():
        return
    keypoint = artefacts.load_array(out / files.keypoint)
    if keypoint.shape[2] != len(sequence.hands):
        return
    is_shown = np.logical_or.reduce(shows_palm(keypoint), axis=0)
    for hand, side in enumerate(sequence.hands):
        count, total = int(is_shown[:, hand].sum()), len(is_shown)
        is_fitted = any(
            (out / file).is_file() for file in (files.hand_motion(side), files.hand_vertex(side))
        )
        seen = f"{LEAST_PALM_POINTS} keypoints of its palm are seen in {count} of {total} frames"
        if not is_fitted:
            yield FitWarning(
                code="hand_left_out",
                message=f"The {side} hand was left out: {seen}, which do not tell where it is. "
                "Check its keypoints and the calibration, or take it out of 'hands' in "
                "sequence.yaml.",
            )
        elif count < FEW_SEEN * total:
            yield FitWarning(
                code="hand_filled",
                message=f"The {side} hand is seen in few frames: {seen}. In the others its pose "
                "is filled in by smoothness. Check its keypoints, or cut these frames out.",
            )


def _lone_views(out: Path, sequence: Sequence) -> Iterator[FitWarning]:
    """Find hands that most frames place by one view, since no other one shows them there."""
    files = SequenceFiles(sequence.name)
    views = sequence.views
    if len(views) < 2 or not (out / files.keypoint).is_file():
        return
    keypoint = artefacts.load_array(out / files.keypoint)
    if keypoint.shape[0] != len(views) or keypoint.shape[2] != len(sequence.hands):
        return
    for hand, side in enumerate(sequence.hands):
        if not (out / files.hand_keypoint(side)).is_file():
            continue
        joint = artefacts.load_array(out / files.hand_keypoint(side)).astype(np.float64)
        is_shown = shows_palm(keypoint[:, :, hand])
        agrees = np.zeros_like(is_shown)
        for number, view in enumerate(views):
            pixel = view.camera.project(joint.reshape(-1, 3)).reshape(*joint.shape[:2], 2)
            size = np.linalg.norm(np.ptp(pixel, axis=1), axis=1)
            off = np.linalg.norm(pixel - keypoint[number, :, hand, :, :2], axis=2)
            off[~is_shown[number]] = np.inf
            agrees[number] = np.nanmedian(off, axis=1) <= AGREEING * size
        total = int(is_shown.any(axis=0).sum())
        lone = int((is_shown.any(axis=0) & (agrees.sum(axis=0) < 2)).sum())
        if lone > FEW_SEEN * total:
            yield FitWarning(
                code="hand_by_one_view",
                message=f"The {side} hand is placed by one view or none in {lone} of {total} "
                f"frames: the other ones of {len(views)} find no keypoints of it there, or find "
                "them elsewhere. It may be centimetres off, and masks and the object with it. Look "
                "at the keypoints in the viewer; larger images, or keypoints of another detector "
                "(keypoint.npy), help.",
            )


def _loose_nodes(model: SpringMassModel) -> Iterator[FitWarning]:
    """Find nodes that no chain of springs joins to the largest piece of the object."""
    count = model.node_count
    own = slice(0, model.object_spring_count)
    ends = model.spring_nodes[own][model.stiffness[own] > 0.0]
    joined = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    pieces, piece = connected_components(joined, directed=False)
    if pieces < 2:
        return
    loose = count - int(np.bincount(piece).max())
    yield FitWarning(
        code="loose_nodes",
        message=f"{loose} of {count} nodes, in {pieces - 1} piece{'s' if pieces > 2 else ''}, are "
        "not joined to the rest of the object and move by themselves: raise connection_radius, "
        "or check the masks of frame 0 for background beside the object.",
    )


def _few_observations(out: Path, sequence: Sequence) -> Iterator[FitWarning]:
    observation = artefacts.load_observation(out, sequence.name)
    frames = range(1, len(sequence.reconstruction_frames))
    seen = [
        max(
            int(observation.is_visible[frame].sum()),
            len(observation.cloud[frame]) if observation.cloud else 0,
        )
        for frame in frames
    ]
    poor = sum(count < min(FEW_POINTS, observation.point.shape[1] or FEW_POINTS) for count in seen)
    if seen and poor > FEW_FRAMES * len(seen):
        yield FitWarning(
            code="few_observations",
            message=f"{poor} of {len(seen)} fitted frames show fewer than {FEW_POINTS} points of "
            "the object, so the fit rests on little. Check masks, depth and tracks there.",
        )
