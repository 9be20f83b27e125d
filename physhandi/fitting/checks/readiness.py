"""Inputs that each stage of a fit needs, and whether recordings have them.

The pipeline asks here which stages it runs; so do the command line, the API and the pages, before a
fit is launched. Only the presence of files is looked at.
"""

from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.fitting.config import (
    APPEARANCE,
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SPRINGS,
    PipelineConfig,
    planned_stages,
)

HANDS_OR_CONTROL, COLOR_OR_KEYPOINT = "hands or control", "color or keypoint"
DEPTH_WITH_MASK, NO_CONTROL = "depth and mask in one view", "hands without control"
COLOR_WITH_MASK = "color and mask in one view"
ITERATIONS, READABLE = "refinement.iterations", "readable files"
SEEN_HAND, SEEN_OBJECT = "a frame that shows a hand", "object in frame 0"
REMEDIES: Mapping[str, str] = {
    "hands": "name the hands in sequence.yaml: 'hands: [right]', or left, or both",
    "views": "describe every camera below 'views' in sequence.yaml",
    COLOR_OR_KEYPOINT: "add color.mp4 or color/, in which keypoints are found, or keypoint.npy",
    "depth": "add views/<view>/depth/ with 16-bit PNGs in millimetres, or marker.npy",
    "mask": "make masks with a click on the object, on the recording's check page or by "
    "'physhandi annotate SEQUENCE --click view,frame,x,y', or "
    "add views/<view>/mask/ with 8-bit PNGs: 1 object, 2 right hand, 3 left hand",
    DEPTH_WITH_MASK: "add masks to a view that has depth, or depth to one that has masks",
    COLOR_WITH_MASK: "add masks to a view that has color, or color to one that has masks",
    "object_node": "add object_node.npy, or depth with masks, which tell the object's shape",
    HANDS_OR_CONTROL: "name the hands in sequence.yaml ('hands: [right]'), or add control.npy",
    NO_CONTROL: "nothing need be done: point controllers stay as they were given",
    READABLE: "mend the files that the problems name",
    SEEN_HAND: "check that the hands of sequence.yaml are in the images, or mend keypoint.npy",
    SEEN_OBJECT: "label the object (1) in the masks of frame 0, where depth was measured",
    ITERATIONS: "set it above 0 to refine the hands",
}
"""How to get each part that may be missing."""

PALM = (0, 1, 5, 9, 13, 17)
"""Keypoints that move with the palm."""
LEAST_PALM_POINTS = 4
"""Palm keypoints that a frame must show for a first guess of the hand's place."""

ABOUT: Mapping[str, str] = {
    HANDS: "hands from keypoints and depth",
    OBSERVATION: "the object from depth and masks, or from markers",
    SEARCH: "topology and global parameters of the object",
    SPRINGS: "stiffness and damping of every spring",
    REFINEMENT: "hands whose object moves as it was seen to",
    APPEARANCE: "what the object looks like, as splats that its nodes carry",
    EVALUATION: "a rollout of all frames, and how well it went",
}
"""Result of each stage."""

ReadyState = Literal["ready", "not needed", "missing"]


@dataclass(frozen=True, kw_only=True)
class StageReadiness:
    """Whether a stage has what it needs."""

    missing: tuple[str, ...] = ()
    """Parts that keep it from running, as `Sequence.missing` names them; none if it is ready."""
    is_needed: bool = True
    """Whether a fit of these recordings is less without it."""
    why: str = ""
    """Why it is skipped; empty if it runs."""

    @property
    def is_ready(self) -> bool:
        """Whether it will run."""
        return not self.missing

    @property
    def state(self) -> ReadyState:
        """``ready``, ``missing``, or ``not needed`` where its absence is no loss."""
        if self.is_ready:
            return "ready"
        return "missing" if self.is_needed else "not needed"

    @property
    def remedy(self) -> str:
        """How to get what is missing, as part of a sentence; empty if nothing is."""
        return "; ".join(REMEDIES[part] for part in self.missing)

    def __str__(self) -> str:
        if self.is_ready:
            return "ready"
        if not self.is_needed:
            return f"will be skipped, which is no loss: {self.why}"
        return f"will be skipped: {self.why}; {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Describe it in plain data: ``ready missing state why remedy``."""
        return {
            "ready": self.is_ready,
            "missing": list(self.missing),
            "state": self.state,
            "why": self.why,
            "remedy": self.remedy,
        }


def shows_palm(keypoint: Float[ndarray, "*axis 21 3"]) -> Bool[ndarray, "*axis"]:
    """Tell where keypoints show enough of a palm to place a hand by them.

    Args:
        keypoint: Pixel x, pixel y and confidence; NaN where not seen.
    """
    palm = keypoint[..., list(PALM), :]
    is_seen = np.isfinite(palm).all(axis=-1) & (np.nan_to_num(palm[..., 2]) > 0)
    return np.asarray(is_seen.sum(axis=-1) >= LEAST_PALM_POINTS)


def missing_for_hands(sequence: Sequence) -> list[str]:
    """Tell what a sequence lacks for hands to be reconstructed in it."""
    missing = sequence.missing("hands") or sequence.missing("views")
    if not missing and not any(view.has_color or view.has_keypoint for view in sequence.views):
        missing = [COLOR_OR_KEYPOINT]
    return missing


def missing_for_object(sequence: Sequence) -> list[str]:
    """Tell what a sequence lacks for an object: something that shows it, and that moves it."""
    missing = sequence.missing("object")
    if not missing and sequence.missing("marker") and not sequence.depth_views:
        missing = [DEPTH_WITH_MASK]
    if not missing and not sequence.depth_views:
        # Markers show single points; only those that sample the surface tell the shape too.
        missing = sequence.missing("object_node") if sequence.missing("marker_motion_valid") else []
    missing = [HANDS_OR_CONTROL if part == "control" else part for part in missing]
    if sequence.hands and sequence.missing("control"):
        missing += missing_for_hands(sequence)
    return missing


def readiness(
    sequences: Sequence | Many[Sequence], config: PipelineConfig | None = None
) -> dict[str, StageReadiness]:
    """Tell for every stage of a fit whether it will run, and why not.

    Args:
        sequences: Recordings that are fitted together; the object needs all of them.
        config: Settings of the fit; None are the default ones.

    Returns:
        A stage's readiness by its name, in the order of the stages; `APPEARANCE`, for which the
        first recording counts, is among them only if the settings ask for it. If `EVALUATION` is
        not ready, there is nothing to fit, and no stage is.
    """
    recordings = [sequences] if isinstance(sequences, Sequence) else list(sequences)
    hands = {sequence.name: missing_for_hands(sequence) for sequence in recordings}
    object_ = {sequence.name: missing_for_object(sequence) for sequence in recordings}
    is_controlled = not any(sequence.missing("control") for sequence in recordings)
    can_fit = not any(object_.values()) or not any(hands.values())
    of_object = _lacking(object_)
    of_hands = StageReadiness()
    if not can_fit or all(hands.values()):
        of_hands = _lacking(hands, is_needed=not is_controlled)
    of_refinement = of_object
    if of_object.is_ready and (config is not None and not config.refinement.iterations):
        why = "the settings leave it out (refinement.iterations is 0)"
        of_refinement = StageReadiness(missing=(ITERATIONS,), is_needed=False, why=why)
    elif of_object.is_ready and not any(is_moved_by_hands(sequence) for sequence in recordings):
        why = "point controllers (control.npy) take the place of hands"
        of_refinement = StageReadiness(missing=(NO_CONTROL,), is_needed=False, why=why)
    of_appearance = of_object
    if of_object.is_ready and not colored_views(recordings[0]):
        of_appearance = _lacking({recordings[0].name: [COLOR_WITH_MASK]})
    of_all = StageReadiness()
    if not can_fit:
        of_all = _lacking({name: [*object_[name], *hands[name]] for name in hands})
    stages = {
        HANDS: of_hands,
        OBSERVATION: of_object,
        SEARCH: of_object,
        SPRINGS: of_object,
        REFINEMENT: of_refinement,
        APPEARANCE: of_appearance,
        EVALUATION: of_all,
    }
    planned = planned_stages(None if config is None else config.to_dict())
    return {stage: stages[stage] for stage in planned}


def colored_views(sequence: Sequence) -> tuple[View, ...]:
    """List the views that show what the object looks like: those with color and masks."""
    return tuple(view for view in sequence.views if view.has_color and view.has_mask)


def is_moved_by_hands(sequence: Sequence) -> bool:
    """Tell whether hands, not point controllers, move a sequence's object."""
    return bool(sequence.hands) and bool(sequence.missing("control"))


def _lacking(missing: Mapping[str, Many[str]], *, is_needed: bool = True) -> StageReadiness:
    """Join what several sequences lack."""
    parts = tuple(dict.fromkeys(part for lacks in missing.values() for part in lacks))
    why = ", ".join(
        f"'{name}' lacks {', '.join(dict.fromkeys(lacks))}"
        for name, lacks in missing.items()
        if lacks
    )
    return StageReadiness(missing=parts, is_needed=is_needed, why=why)


def nothing_to_fit(sequences: Many[Sequence]) -> str:
    """Say what recordings lack in which there is nothing to fit, and how to get it."""
    clauses: list[str] = []
    parts: dict[str, None] = {}
    for sequence in sequences:
        of_object, of_hands = missing_for_object(sequence), missing_for_hands(sequence)
        parts |= dict.fromkeys([*of_object, *of_hands])
        lacks = [f"lacks {', '.join(of_object)} for the object"] if of_object else []
        if not sequence.hands:
            lacks.append("shows no hands")
        elif of_hands:
            lacks.append(f"lacks {', '.join(of_hands)} for the hands")
        clauses.append(f"'{sequence.name}' {' and '.join(lacks)}")
    remedies = "; ".join(REMEDIES[part] for part in parts)
    return f"There is nothing to fit: {'; '.join(clauses)}. To do: {remedies}."


def skipped_object(sequences: Many[Sequence], config: PipelineConfig | None = None) -> str | None:
    """Tell that a fit would leave the object out although depth was recorded; else None.

    Color alone shows hands and no more, so that leaving out an object is no surprise there.
    """
    stages = readiness(sequences, config)
    of_object = stages[OBSERVATION]
    if of_object.is_ready or not stages[EVALUATION].is_ready:
        return None
    shows_depth = any(
        view.has_depth
        for sequence in sequences
        if missing_for_object(sequence)
        for view in sequence.views
    )
    if not shows_depth:
        return None
    return (
        f"Only the hands will be fitted, not the object, although depth was recorded: "
        f"{of_object.why}. To fit the object, {of_object.remedy}."
    )
