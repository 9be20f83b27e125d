"""Keypoints of hands in images and in the views of a sequence."""

from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import MissingInputError
from physhandi.hand.model import Side
from physhandi.perception.hand_networks import (
    LandmarkNetwork,
    Landmarks,
    PalmNetwork,
    Region,
    landmark_region,
    overlap,
)
from physhandi.progress import NullProgress, Progress

_PRESENCE = 0.5
_SAME_HAND = 0.5
_MAX_HANDS = 2
STAGE = "keypoint_detection"


@dataclass(frozen=True)
class DetectedHand:
    """One hand in one image."""

    side: Side
    """Which hand it looks like, in an image that is not mirrored."""
    keypoint: Float[ndarray, "21 2"]
    """Keypoints in MediaPipe's order [px]."""
    confidence: float
    """Probability that this is a hand, 0 to 1."""
    right: float
    """Probability that it is a right hand, 0 to 1."""


class KeypointDetector:
    """Runs the palm and the landmark network on images; nothing leaves the machine."""

    def __init__(self, threads: int = 2) -> None:
        """Load both networks.

        Args:
            threads: CPU threads that each network may use.
        """
        self._find_palms = PalmNetwork(threads)
        self._find_landmarks = LandmarkNetwork(threads)

    def detect(
        self,
        image: UInt8[ndarray, "row column 3"],
        previous: SequenceOf[DetectedHand] = (),
        max_hands: int = _MAX_HANDS,
    ) -> list[DetectedHand]:
        """Find the hands of an RGB image.

        Args:
            image: The image (RGB).
            previous: Hands of the frame before; they are looked for where they were, and the
                whole image is searched only when one of `max_hands` is not found again.
            max_hands: Most hands to return.

        Returns:
            The hands, the ones found again first.
        """
        found: list[Landmarks] = []
        for hand in previous:
            self._add(found, image, landmark_region(hand.keypoint))
        if len(found) < max_hands:
            for region in self._find_palms(image):
                self._add(found, image, region, refine=True)
        return [
            DetectedHand("right" if one.right > 0.5 else "left", one.pixel, one.presence, one.right)
            for one in found[:max_hands]
        ]

    def _add(
        self,
        found: list[Landmarks],
        image: UInt8[ndarray, "row column 3"],
        region: Region,
        *,
        refine: bool = False,
    ) -> None:
        """Keep what a region shows, if it is a hand that is not known yet."""
        hand = self._find_landmarks(image, region)
        if refine and hand.presence > _PRESENCE:
            hand = self._find_landmarks(image, landmark_region(hand.pixel))
        if hand.presence > _PRESENCE and all(
            overlap(hand.pixel, other.pixel) < _SAME_HAND for other in found
        ):
            found.append(hand)


def detect_view(
    view: View, hands: tuple[Side, ...], progress: Progress, detector: KeypointDetector
) -> Float[ndarray, "frame hand 21 3"]:
    """Follow the given hands through one view.

    Args:
        view: The view; needs color images.
        hands: Hands to look for, in the order of the result's hand axis.
        progress: Told after every frame.
        detector: The networks.

    Returns:
        Pixel x, pixel y and confidence of each keypoint; NaN where a hand was not found.
    """
    result = np.full((view.frame_count, len(hands), 21, 3), np.nan, dtype=np.float32)
    previous: list[DetectedHand] = []
    for frame in range(view.frame_count):
        progress.check_cancelled()
        previous = detector.detect(view.color(frame), previous, max_hands=len(hands))
        for index, hand in _assign(previous, hands):
            result[frame, index, :, :2] = hand.keypoint
            result[frame, index, :, 2] = hand.confidence
        progress.report(STAGE, frame + 1, view.frame_count, None, f"View {view.name}")
    return result


def detect_sequence(
    sequence: Sequence, progress: Progress | None = None
) -> Float[ndarray, "view frame hand 21 3"]:
    """Find the keypoints of a sequence's hands in all frames of all views.

    Args:
        sequence: The sequence; it must say which hands it shows and have color images.
        progress: Told after every frame.

    Returns:
        Pixel x, pixel y and confidence of each keypoint; NaN where a hand was not found.

    Raises:
        MissingInputError: If the sequence names no hand, or a view has no color images.
    """
    if not sequence.hands:
        raise MissingInputError(
            f"Sequence '{sequence.name}': no hand is named. "
            "Add 'hands: [right]' to sequence.yaml, or left, or both."
        )
    blind = [view.name for view in sequence.views if not view.has_color]
    if blind or not sequence.views:
        raise MissingInputError(
            f"Sequence '{sequence.name}': view '{(blind or ['?'])[0]}' has no color images to find "
            "keypoints in. Add color.mp4 or color/, or give keypoint.npy for the view."
        )
    detector = KeypointDetector()
    progress = progress or NullProgress()
    return np.stack(
        [detect_view(view, sequence.hands, progress, detector) for view in sequence.views]
    )


def _assign(
    found: SequenceOf[DetectedHand], hands: tuple[Side, ...]
) -> list[tuple[int, DetectedHand]]:
    """Say which of the wanted hands each found one is; one wanted hand takes whatever is found."""
    if len(hands) == 1:
        return [(0, hand) for hand in found[:1]]
    ordered = sorted(found, key=lambda hand: -hand.right)
    if len(ordered) == 1:
        return [(hands.index(ordered[0].side), ordered[0])]
    return [
        (hands.index(side), hand) for side, hand in zip(("right", "left"), ordered, strict=False)
    ]
