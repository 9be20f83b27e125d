"""Which keypoints of several views to believe: those that agree with what others triangulate.

A network that takes one finger for another, or looks at a hand from an odd side, errs in one view
for a whole recording, and by the same amount in all frames. A robust loss does not leave such a
view out: all of its keypoints together pull the hand.
"""

import itertools
from collections.abc import Sequence as Many
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import uniform_filter1d

from physhandi.data.camera import PinholeCamera, triangulate
from physhandi.data.view import View
from physhandi.fitting.hands.observed import hand_size
from physhandi.perception.lifting import pixel_values

_BONES = np.array(
    [(base + at - 1 if at else 0, base + at) for base in range(1, 18, 4) for at in range(4)]
    + [(5, 9), (9, 13), (13, 17)]
)
"""Pairs of keypoints whose distance is constant."""
_WINDOW = 0.2
"""Time over which evidence is averaged [s]."""
_GROSS = 0.15
"""Distance at which a view contradicts others altogether, as a share of the hand's size."""
_AGREES = 0.1
"""Distance at which views still agree, likewise."""
_KEEPS, _LOSES = 0.25, 0.35
"""Distances at which a keypoint begins to lose, and has lost, its weight, likewise."""
_BONE_WEIGHT = 3.0
"""What wrong lengths of bones cost: as much as one view that contradicts, if a third off."""
_MARGIN = 0.2
"""By how much a pair of views must be better than others for these to be doubted altogether."""
_WRONG_BONES = 0.25
"""Error of the bones' lengths from which on two views contradict each other."""
_MOST = 0.5
"""Share of a view's keypoints of a hand that are doubted, for the others to be so, too."""
_RARE = 0.5
"""What a view costs that never sees the hand, as an error of its bones."""
_TELLS = 0.2
"""By how much one of two views that contradict each other must be worse to be left out."""


@dataclass(frozen=True, eq=False)
class SeenHand:
    """Keypoints of one hand in all views, and the cameras of these."""

    cameras: Many[PinholeCamera]
    """Camera of each view."""
    keypoint: Float[ndarray, "view frame 21 3"]
    """Pixel x, pixel y and confidence; NaN where not seen [px]."""
    template: Float[ndarray, "21 3"]
    """Keypoints of a hand, of any size and pose."""
    window: int
    """Frames over which evidence is averaged: an odd number."""

    @cached_property
    def is_seen(self) -> Bool[ndarray, "view frame 21"]:
        """Tell which keypoints are seen."""
        return np.isfinite(self.keypoint).all(-1) & (np.nan_to_num(self.keypoint[..., 2]) > 0)

    @cached_property
    def size(self) -> Float[ndarray, " view"]:
        """Measure how large the hand is in each view [px]."""
        return np.array([hand_size(view) for view in self.keypoint])

    def bone_ratio(self, point: Float[ndarray, "frame 21 3"]) -> Float[ndarray, "frame bone"]:
        """Compare the lengths of bones with the template's: logarithms of quotients."""
        return np.log(_bone_lengths(point) / _bone_lengths(self.template))


@dataclass(frozen=True, eq=False)
class PairOfViews:
    """Triangulation of one hand by two views."""

    views: tuple[int, int]
    """Their numbers."""
    distance: Float[ndarray, "view frame 21"]
    """From each view's keypoint to what this pair triangulates, as a share of the hand's size."""
    cost: Float[ndarray, "frame 21"]
    """Cost over all views; NaN where the pair triangulates nothing."""
    bone_error: Float[ndarray, " frame"]
    """Median error of the bones' lengths, as a logarithm; NaN where too few are known."""

    def hand_cost(self) -> Float[ndarray, " frame"]:
        """Average the cost over the joints that are known, and add that of the bones."""
        is_known = np.isfinite(self.cost)
        total = np.where(is_known, self.cost, 0.0).sum(1) / np.maximum(is_known.sum(1), 1)
        return total + _BONE_WEIGHT * np.nan_to_num(self.bone_error)


def believed_keypoints(
    views: Many[View],
    keypoint: Float[ndarray, "view frame 21 3"],
    template: Float[ndarray, "21 3"],
    frame_rate: float,
) -> Float[ndarray, "view frame 21 3"]:
    """Lower the confidence of one hand's keypoints by `keypoint_trust`; NaN where nothing is left.

    If nothing is doubted, the keypoints are the same to the bit.
    """
    trust = keypoint_trust(views, keypoint, template, frame_rate).astype(keypoint.dtype)
    believed = keypoint.copy()
    believed[..., 2] *= trust
    believed[trust == 0] = np.nan
    return believed


def keypoint_trust(
    views: Many[View],
    keypoint: Float[ndarray, "view frame 21 3"],
    template: Float[ndarray, "21 3"],
    frame_rate: float,
) -> Float[ndarray, "view frame 21"]:
    """Judge the keypoints of one hand, joint by joint, by what the other views say.

    Each pair of views triangulates each keypoint. The pair is believed whose points project best
    onto the keypoints of all views and have bones of constant, right proportions, over a short
    time, by joint and by hand. A view's keypoint that is far from what they say loses its weight;
    a view of which most do loses all. If two views are left that contradict each other, one of
    them is left out whose keypoints, lifted by measured depth, have clearly worse bones, or which
    finds the hand clearly less often. Where nothing decides, all are kept.

    Args:
        views: The views, with their cameras and depth.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        template: Keypoints of a hand, of any size and pose.
        frame_rate: Frames in a second.

    Returns:
        Share of each keypoint's weight that it keeps, from 0 to 1; 1 where it is not seen.
    """
    window = 2 * round(_WINDOW * frame_rate / 2) + 1
    hand = SeenHand([view.camera for view in views], keypoint, template, window)
    if not (hand.is_seen.sum(0) > 1).any():
        return np.ones(hand.is_seen.shape)
    pairs = [judge_pair(hand, pair) for pair in itertools.combinations(range(len(views)), 2)]
    away, sure = _away_from_others(pairs, len(views))
    lost = sure * np.clip((away - _KEEPS) / (_LOSES - _KEEPS), 0.0, 1.0)
    wrong = (sure * (away > _GROSS)).sum(2) / np.maximum(hand.is_seen.sum(2), 1)
    is_kept = _kept_views(views, hand, pairs) & (wrong < _MOST)
    return np.where(is_kept[..., None], 1.0 - lost, 0.0)


def judge_pair(hand: SeenHand, pair: tuple[int, int]) -> PairOfViews:
    """Triangulate keypoints from two views, and compare all views with that."""
    chosen, frame_count = list(pair), hand.keypoint.shape[1]
    point = triangulate(
        [hand.cameras[view] for view in pair],
        hand.keypoint[chosen][..., :2].astype(np.float64).reshape(2, -1, 2),
        hand.is_seen[chosen].reshape(2, -1).astype(np.float64),
        np.inf,
    )
    distance = np.full(hand.is_seen.shape, np.nan)
    for view, camera in enumerate(hand.cameras):
        projected = camera.project(point).reshape(frame_count, 21, 2)
        away = np.linalg.norm(projected - hand.keypoint[view, ..., :2], axis=-1) / hand.size[view]
        distance[view] = np.where(hand.is_seen[view], away, np.nan)
    is_measured = np.isfinite(distance)  # It is not where a point is behind the camera.
    share = np.where(is_measured, np.minimum((distance / _GROSS) ** 2, 1.0), hand.is_seen)
    cost = share.sum(0)
    point = point.reshape(frame_count, 21, 3)
    cost[~np.isfinite(point[..., 0])] = np.nan
    return PairOfViews(
        views=pair,
        distance=np.stack([_running_median(away, hand.window) for away in distance]),
        cost=_running_mean(cost, hand.window),
        bone_error=_bone_error(_running_mean(hand.bone_ratio(point), hand.window)),
    )


def _away_from_others(
    pairs: Many[PairOfViews], view_count: int
) -> tuple[Float[ndarray, "view frame 21"], Float[ndarray, "view frame 21"]]:
    """Find how far keypoints are from what the best pair of views says, and how sure that is.

    Returns:
        Distance as a share of the hand's size, zero where nothing is known, and how sure it is that
        the pair is right and the view is not, from 0 to 1.
    """
    cost = np.stack([pair.cost for pair in pairs])
    hand_cost = np.stack([pair.hand_cost() for pair in pairs])
    total = np.where(np.isfinite(cost), (cost + hand_cost[..., None]) / 2, np.inf)
    best = total.argmin(0)
    distances = np.stack([pair.distance for pair in pairs])
    distance = np.nan_to_num(np.take_along_axis(distances, best[None, None], 0)[0])
    member = np.array([[view in pair.views for pair in pairs] for view in range(view_count)])
    within = np.where(member[:, best], distance, 0.0).max(0)
    agrees = np.isfinite(total.min(0)) & (within < _AGREES)
    sure = np.zeros(distance.shape)
    for view in range(view_count):
        other = np.where(member[view][:, None, None], total, np.inf).min(0)
        worse = np.where(agrees, other, 0.0) - np.where(agrees, total.min(0), 0.0)
        sure[view] = np.clip(worse / _MARGIN, 0.0, 1.0)
    return distance, sure


def _kept_views(
    views: Many[View], hand: SeenHand, pairs: Many[PairOfViews]
) -> Bool[ndarray, "view frame"]:
    """Leave out, in frames in which it agrees with no other, a view that is clearly worse."""
    is_kept = np.ones(hand.is_seen.shape[:2], dtype=bool)
    contradiction = np.zeros((len(views), *is_kept.shape), dtype=bool)
    for pair in pairs:
        first, second = pair.views
        contradiction[first, second] = contradiction[second, first] = _contradicts(pair)
    rare = _RARE * (1 - np.nan_to_num(hand.keypoint[..., 2]).mean(axis=(1, 2)))
    for frame in map(int, np.flatnonzero(contradiction.any((0, 1)))):
        left = [view for view in range(len(views)) if hand.is_seen[view, frame].any()]
        bones = [_lifted_error(views[view], hand, view, frame) for view in left]
        has_bones = bool(np.isfinite(bones).all())
        doubt = {
            view: rare[view] + (error if has_bones else 0.0)
            for view, error in zip(left, bones, strict=True)
        }
        while len(left) > 1:
            least = min(doubt[view] for view in left)
            alone = [
                view
                for view in left
                if contradiction[view, [other for other in left if other != view], frame].all()
                and doubt[view] >= least + _TELLS
            ]
            if not alone:
                break
            worst = max(alone, key=doubt.__getitem__)
            left.remove(worst)
            is_kept[worst, frame] = False
    return is_kept


def _contradicts(pair: PairOfViews) -> Bool[ndarray, " frame"]:
    """Tell in which frames what two views triangulate is no hand, or they miss each other."""
    within = np.fmax(*pair.distance[list(pair.views)])
    is_known = np.isfinite(within).any(1)
    median = np.zeros(len(within))
    median[is_known] = np.nanmedian(within[is_known], axis=1)
    return (median > _AGREES) | (np.nan_to_num(pair.bone_error) > _WRONG_BONES)


def _lifted_error(view: View, hand: SeenHand, number: int, frame: int) -> float:
    """Measure how wrong the bones are between one view's keypoints, lifted by measured depth."""
    if not view.has_depth:
        return np.nan
    pixel = hand.keypoint[number, frame, :, :2].astype(np.float64)
    depth = pixel_values(view.depth(frame), pixel)
    is_known = depth > 0
    point = np.full((1, 21, 3), np.nan)
    point[0, is_known] = view.camera.unproject(pixel[is_known], depth[is_known])
    return float(_bone_error(hand.bone_ratio(point))[0])


def _bone_lengths(point: Float[ndarray, "*frame 21 3"]) -> Float[ndarray, "*frame bone"]:
    begin, end = _BONES.T
    length = np.linalg.norm(point[..., end, :] - point[..., begin, :], axis=-1)
    return np.maximum(length, 1e-9)


def _bone_error(ratio: Float[ndarray, "frame bone"]) -> Float[ndarray, " frame"]:
    """Take the median of how far logarithms of lengths are from being all alike."""
    error = np.full(len(ratio), np.nan)
    is_known = np.isfinite(ratio).sum(1) >= len(_BONES) // 2
    measured = ratio[is_known]
    away = np.abs(measured - np.nanmedian(measured, axis=1, keepdims=True))
    error[is_known] = np.nanmedian(away, axis=1)
    return error


def _running_mean(value: Float[ndarray, "frame number"], window: int) -> ndarray:
    """Average what is known over some frames; NaN where nothing is."""
    is_known = np.isfinite(value)
    total, count = (
        uniform_filter1d(part.astype(np.float64), window, axis=0, mode="nearest")
        for part in (np.where(is_known, value, 0.0), is_known)
    )
    return np.where(count > 1e-9, total / np.maximum(count, 1e-9), np.nan)


def _running_median(value: Float[ndarray, "frame number"], window: int) -> ndarray:
    """Take the lower median of what is known over some frames; NaN where nothing is."""
    padded = np.pad(value, ((window // 2, window // 2), (0, 0)), constant_values=np.nan)
    near = np.sort(sliding_window_view(padded, window, axis=0), axis=-1)
    middle = np.maximum(np.isfinite(near).sum(-1, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(near, middle, axis=-1)[..., 0]
