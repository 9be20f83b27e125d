"""How well fitted hands agree with the keypoints that the views saw."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera


@dataclass(frozen=True, kw_only=True)
class ReprojectionScore:
    """Distances between projected and seen keypoints, over all views, frames and joints."""

    median: float
    """Half of the keypoints are nearer [px]; NaN if none was scored."""
    mean: float
    """Mean distance [px]."""
    p95: float
    """95 of 100 keypoints are nearer [px]."""
    keypoint_count: int
    """Keypoints scored."""


@dataclass(frozen=True, kw_only=True)
class HandScore:
    """Score of one hand."""

    fitted: ReprojectionScore
    """Keypoints that the fit was given."""
    hidden: ReprojectionScore
    """Keypoints that were kept from the fit."""
    frame_count: int
    """Frames in which at least one view saw the hand; all of them are scored."""
    joint_median: tuple[float, ...]
    """Median distance of each of the 21 keypoints [px]."""

    def to_dict(self) -> dict[str, Any]:
        """Describe the score in plain numbers."""
        return asdict(self)


def hide_keypoints(
    keypoint: Float[ndarray, "view frame hand 21 3"], share: float = 0.1, seed: int = 0
) -> Bool[ndarray, "view frame hand 21"]:
    """Choose keypoints at random to keep from a fit, so that they can score it.

    Args:
        keypoint: Keypoints; NaN where not seen [px].
        share: Share of the seen keypoints to hide.
        seed: Seed of the choice.
    """
    chosen = np.random.default_rng(seed).random(keypoint.shape[:4]) < share
    return chosen & np.isfinite(keypoint).all(-1)


def evaluate_hands(
    cameras: Sequence[PinholeCamera],
    joint: Sequence[Float[ndarray, "frame 21 3"]],
    keypoint: Float[ndarray, "view frame hand 21 3"],
    hidden: Bool[ndarray, "view frame hand 21"] | None = None,
    *,
    least_views: int = 1,
) -> tuple[HandScore, ...]:
    """Project each hand's keypoints into all views and compare them with what was seen.

    Args:
        cameras: Camera of each view.
        joint: Keypoints of each hand in the world frame, as `HandMotion.keypoints` gives them.
        keypoint: Pixel x, pixel y and confidence of the seen keypoints; NaN where not seen [px].
        hidden: Which of them were kept from the fit; None means none.
        least_views: Score only frames in which so many views saw the hand.

    Returns:
        One score for each hand, in their order. A frame whose fit is missing or behind a camera
        has an infinite distance; it is not dropped.
    """
    scores: list[HandScore] = []
    for hand, points in enumerate(joint):
        seen = np.asarray(keypoint[:, :, hand], dtype=np.float64)
        is_seen = np.isfinite(seen).all(-1)
        is_scored = is_seen.any(-1).sum(0) >= least_views
        is_seen &= is_scored[:, None]
        distance = np.stack(
            [
                np.linalg.norm(camera.project(points.astype(np.float64)) - view[..., :2], axis=-1)
                for camera, view in zip(cameras, seen, strict=True)
            ]
        )
        distance = np.where(np.isfinite(distance), distance, np.inf)
        is_hidden = np.zeros_like(is_seen) if hidden is None else hidden[:, :, hand]
        scores.append(
            HandScore(
                fitted=_score(distance[is_seen & ~is_hidden]),
                hidden=_score(distance[is_seen & is_hidden]),
                frame_count=int(is_scored.sum()),
                joint_median=tuple(
                    _score(distance[..., k][is_seen[..., k]]).median for k in range(21)
                ),
            )
        )
    return tuple(scores)


def _score(distance: Float[ndarray, " keypoint"]) -> ReprojectionScore:
    if not len(distance):
        return ReprojectionScore(median=np.nan, mean=np.nan, p95=np.nan, keypoint_count=0)
    return ReprojectionScore(
        median=float(np.median(distance)),
        mean=float(np.mean(distance)),
        p95=float(np.percentile(distance, 95, method="higher")),
        keypoint_count=len(distance),
    )
