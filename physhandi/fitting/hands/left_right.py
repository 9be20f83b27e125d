"""Puts back hands of views that take the left hand for the right one and the right for the left."""

import itertools
from collections.abc import Sequence as Many

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera, triangulate
from physhandi.fitting.hands.agreement import SeenHand, judge_pair
from physhandi.fitting.hands.wrist_guess import align

_EXCHANGE = 0.2
"""What an exchanged view costs; two views that contradict each other about one hand cost 1."""


def hands_in_place(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 2 21 3"],
    templates: Many[Float[ndarray, "21 3"]],
) -> Float[ndarray, "view frame 2 21 3"]:
    """Exchange the hands of views that take one for the other.

    In each frame that choice of views is made with which all pairs of views triangulate hands best.
    What is not known costs as much as a contradiction. Of two choices that differ only in which
    hand is called the left one, that is made which exchanges fewer views, and if both exchange as
    many, that whose hands are less like mirror images of what they should be.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence of both hands; NaN where not seen [px].
        templates: Keypoints of both hands' models.

    Returns:
        The keypoints, to the bit where nothing is exchanged.
    """
    view_count = len(cameras)
    if view_count < 2:
        return keypoint
    pairs = list(itertools.combinations(range(view_count), 2))
    cost = [_pair_costs(cameras, keypoint, templates, pair) for pair in pairs]
    choices = [
        choice
        for choice in itertools.product((0, 1), repeat=view_count)
        if (sum(choice), choice) <= (view_count - sum(choice), tuple(1 - one for one in choice))
    ]
    total = np.stack(
        [
            sum(one[choice[a] ^ choice[b]] for one, (a, b) in zip(cost, pairs, strict=True))
            + _EXCHANGE * sum(choice)
            for choice in choices
        ]
    )
    is_exchanged = np.array(choices, dtype=bool)[total.argmin(0)].T
    is_tie = 2 * is_exchanged.sum(0) == view_count
    if is_tie.any():
        error, mirrored = (
            _template_error(cameras, _exchange(keypoint[:, is_tie], way), templates)
            for way in (is_exchanged[:, is_tie], ~is_exchanged[:, is_tie])
        )
        if mirrored < error:
            is_exchanged[:, is_tie] ^= True
    return _exchange(keypoint, is_exchanged)


def _pair_costs(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 2 21 3"],
    templates: Many[Float[ndarray, "21 3"]],
    pair: tuple[int, int],
) -> Float[ndarray, "2 frame"]:
    """Compute what both hands cost, as two views name them and with those of one exchanged."""
    both = [cameras[view] for view in pair]
    cost = np.zeros((2, keypoint.shape[1]))
    for first, second in np.ndindex(2, 2):
        seen = np.stack([keypoint[pair[0], :, first], keypoint[pair[1], :, second]])
        judged = judge_pair(SeenHand(both, seen, templates[first], 1), (0, 1))
        is_known = np.isfinite(judged.cost).any(1)
        cost[first ^ second] += np.where(is_known, np.minimum(judged.hand_cost(), 1.0), 1.0)
    return cost


def _exchange(
    keypoint: Float[ndarray, "view frame 2 21 3"], is_exchanged: Bool[ndarray, "view frame"]
) -> Float[ndarray, "view frame 2 21 3"]:
    return np.where(is_exchanged[..., None, None, None], keypoint[:, :, ::-1], keypoint)


def _template_error(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 2 21 3"],
    templates: Many[Float[ndarray, "21 3"]],
) -> float:
    """Sum up how far the templates are from hands that all views triangulate, over frames [m]."""
    error = 0.0
    for hand, template in enumerate(templates):
        seen = keypoint[:, :, hand].astype(np.float64).reshape(len(cameras), -1, 3)
        weight = np.nan_to_num(seen[..., 2])
        point = triangulate(cameras, seen[..., :2], weight, np.inf).reshape(-1, 21, 3)
        for whole in point[np.isfinite(point).all((1, 2))]:
            rotation, offset = align(template, whole)
            away = rotation.apply(template) + offset - whole
            error += float(np.linalg.norm(away, axis=1).mean())
    return error
