"""Agreement of pictures of a rollout with what cameras recorded, frame by frame.

The object is drawn as its splats, carried by the nodes of the rollout, over black and without
hands. `physhandi.metrics.photometric` defines the scores.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.rasterise import render_splats
from physhandi.appearance.splats import Splats
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.metrics.photometric import (
    ImageScores,
    Perceptual,
    phystwin_scores,
    proper_scores,
)
from physhandi.progress import NullProgress, Progress

PHYSTWIN, PROPER, HELD_OUT = "phystwin", "proper", "held_out"
"""PhysTwin's scores in the first view that has masks; proper ones as the mean over all views that
have masks, those that are held out among them; and proper ones in those that are held out alone."""
PICTURE_SCORES = ("psnr", "ssim", "iou")
"""Scores that need nothing more; ``lpips`` needs a network."""
PictureCurves = dict[str, dict[str, Float[ndarray, " frame"]]]
"""Scores of every frame by definition and name; NaN where a frame cannot be compared."""


def rebound(splats: Splats, node: Float[ndarray, "node 3"]) -> Splats:
    """Bind splats to other nodes of the same object, where they are in the frame of the fit [m].

    Args:
        splats: The splats.
        node: All nodes of that frame, such as those that another method has.
    """
    return replace(splats, rest_node=np.asarray(node, np.float32))


def picture_curves(
    sequence: Sequence,
    rollout: Float[ndarray, "frame node 3"],
    splats: Splats,
    progress: Progress | None = None,
    *,
    stage: str = "",
    device: str = "cpu",
    perceptual: Perceptual | None = None,
) -> PictureCurves:
    """Draw every frame of a rollout in every view that has masks, and compare.

    Args:
        sequence: The recording; views without masks are left out.
        rollout: The object's nodes, finite [m].
        splats: What it looks like, bound to these nodes.
        progress: Told about every frame, as part of `stage`; may cancel.
        stage: Stage that this belongs to.
        device: Warp device that draws.
        perceptual: Network for ``lpips``; None leaves that score out.

    Returns:
        Curves of `PHYSTWIN` and `PROPER`, and of `HELD_OUT` if there is such a view; nothing if no
        view has masks. Scores of color are unknown in views without color.
    """
    progress = progress or NullProgress()
    seen = [view.straightened() for view in sequence.views if view.has_mask]
    aside = [view.straightened() for view in sequence.held_out_views if view.has_mask]
    if not seen:
        return {}
    frame_count = min(len(rollout), sequence.frame_count)
    names = (PHYSTWIN, PROPER, *([HELD_OUT] if aside else []))
    scores = PICTURE_SCORES if perceptual is None else (*PICTURE_SCORES, "lpips")
    curves = {name: {score: np.full(len(rollout), np.nan) for score in scores} for name in names}
    binding = SplatBinding.of(splats)
    for frame in range(frame_count):
        progress.check_cancelled()
        center = binding.carry(np.asarray(rollout[frame : frame + 1], np.float64))[0]
        proper: list[ImageScores] = []
        for view in (*seen, *aside):
            parts = _picture(view, frame, splats, center, device)
            proper.append(proper_scores(*parts, perceptual))
            if view is seen[0]:
                _note(curves[PHYSTWIN], frame, [phystwin_scores(*parts, perceptual)])
        _note(curves[PROPER], frame, proper)
        if aside:
            _note(curves[HELD_OUT], frame, proper[len(seen) :])
        if stage:
            progress.report(stage, frame + 1, frame_count, message="compares pictures")
    for view in (*seen, *aside):
        view.close()
    return curves


def mean_scores(curves: PictureCurves, frames: Iterable[int]) -> dict[str, dict[str, float | None]]:
    """Average scores over frames, those that cannot be compared left out; None if none can."""
    chosen = list(frames)
    return {
        name: {score: _mean(curve[chosen]) for score, curve in by_score.items()}
        for name, by_score in curves.items()
    }


def add_picture_scores(
    report: dict[str, Any], curves: PictureCurves, splits: Mapping[str, range]
) -> None:
    """Add scores of pictures to a report of `physhandi.metrics.report`.

    Args:
        report: Gets ``photometric`` of frame 0, which no split has, and of each split's rollout.
        curves: What `picture_curves` found; nothing is added if that is nothing.
        splits: Frames of each split.
    """
    if not curves:
        return
    report["photometric"] = {"frame": 0, **mean_scores(curves, [0])}
    for split, frames in splits.items():
        if split in report:
            scored = [frame for frame in frames if frame > 0]
            report[split]["rollout"]["photometric"] = mean_scores(curves, scored)


def _picture(
    view: View, frame: int, splats: Splats, center: Float[ndarray, "splat 3"], device: str
) -> tuple[ndarray, ndarray, ndarray, ndarray | None]:
    """Draw a frame in a view; give color and alpha, and the mask and color that were recorded."""
    drawn = render_splats(view.camera, splats, center=center, device=device)
    recorded = view.color(frame) if view.has_color else None
    return drawn.color, drawn.alpha, view.mask(frame), recorded


def _note(
    curves: dict[str, Float[ndarray, " frame"]], frame: int, scores: list[ImageScores]
) -> None:
    for name, curve in curves.items():
        mean = _mean(np.array([getattr(score, name) for score in scores], np.float64))
        curve[frame] = np.nan if mean is None else mean


def _mean(value: Float[ndarray, " item"]) -> float | None:
    finite = value[np.isfinite(value)]
    return float(finite.mean()) if len(finite) else None
