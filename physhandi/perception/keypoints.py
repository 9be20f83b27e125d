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
        known: SequenceOf[DetectedHand] = (),
        max_hands: int = _MAX_HANDS,
    ) -> list[DetectedHand]:
        """Search a whole RGB image for hands.

        Args:
            image: The image (RGB).
            known: Hands that have been found in it already.
            max_hands: Most hands to return, the known ones included.

        Returns:
            The known hands, then the others.
        """
        found = list(known)
        for region in self._find_palms(image):
            if len(found) >= max_hands:
                break
            first = self._find_landmarks(image, region)
            if first.presence > _PRESENCE:
                # The palm's region is coarse; the keypoints in it say where the hand really is.
                self._add(found, image, landmark_region(first.pixel))
        return found[:max_hands]

    def follow(
        self, image: UInt8[ndarray, "row column 3"], previous: SequenceOf[DetectedHand]
    ) -> list[DetectedHand]:
        """Look for the hands of the frame before where they were; return those that still are."""
        found: list[DetectedHand] = []
        for hand in previous:
            self._add(found, image, landmark_region(hand.keypoint))
        return found

    def _add(
        self, found: list[DetectedHand], image: UInt8[ndarray, "row column 3"], region: Region
    ) -> None:
        """Keep what a region shows, if it is a hand that is not known yet."""
        hand = self._find_landmarks(image, region)
        is_new = all(overlap(hand.pixel, other.keypoint) < _SAME_HAND for other in found)
        if hand.presence > _PRESENCE and is_new:
            side: Side = "right" if hand.right > 0.5 else "left"
            found.append(DetectedHand(side, hand.pixel, hand.presence, hand.right))


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
        image = view.color(frame)
        found = detector.follow(image, previous)
        if len(found) < len(hands):
            found = detector.detect(image, found)
        assigned = assign_hands(found, hands)
        for index, hand in assigned.items():
            result[frame, index, :, :2] = hand.keypoint
            result[frame, index, :, 2] = hand.confidence
        previous = list(assigned.values())
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


def assign_hands(
    found: SequenceOf[DetectedHand], hands: tuple[Side, ...]
) -> dict[int, DetectedHand]:
    """Say which of the wanted hands each found one is.

    A single wanted hand is the one that looks most like it, whatever the network calls its side;
    two wanted hands are told apart by which looks more like a right hand.

    Args:
        found: Hands of one image.
        hands: Wanted hands.

    Returns:
        Found hand by position in `hands`.
    """
    ordered = sorted(found, key=lambda hand: -hand.right)
    if not ordered:
        return {}
    if len(hands) == 1:
        return {0: ordered[0] if hands[0] == "right" else ordered[-1]}
    if len(ordered) == 1:
        return {hands.index(ordered[0].side): ordered[0]}
    return {hands.index("right"): ordered[0], hands.index("left"): ordered[-1]}
