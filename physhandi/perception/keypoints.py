"""Detects the keypoints of hands in images and in the views of a sequence.

MediaPipe's palm and landmark networks run locally (`KeypointDetector`); `detect_sequence` follows
the hands of a sequence through all its views.
"""

import threading
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

import physhandi.hand
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import MissingInputError
from physhandi.hand.names import HandSide
from physhandi.progress import NullProgress, Progress

_ASSETS = Path(physhandi.hand.__file__).parent / "assets"
_PALM_SIZE, _LANDMARK_SIZE = 192, 224
_STRIDES = ((8, 2), (16, 6))
"""Anchor grids of the palm network: cell size [px] and anchors per cell."""
_PALM_SCORE = 0.5
"""Least probability of a detected palm."""
_OVERLAP = 0.3
"""Intersection over union from which two palms count as one."""
_PRESENCE = 0.5
"""Least probability that a region shows a hand."""
_SAME_HAND = 0.5
"""Intersection over union from which two detected hands count as one."""
_MAX_HANDS = 2
_WINDOW_SHARE = 0.6
"""Side of the windows in which small hands are looked for, of the image's shorter side."""
_CHUNK = 12
"""Images that are kept while a video is read backwards."""
KEYPOINT_STAGE = "keypoint_detection"


@dataclass(frozen=True)
class DetectedHand:
    """One hand in one image."""

    side: HandSide
    """Which hand it looks like, in an image that is not mirrored."""
    keypoint: Float[ndarray, "21 2"]
    """Keypoints in MediaPipe's order [px]."""
    confidence: float
    """Probability that this is a hand, 0 to 1."""
    right: float
    """Probability that it is a right hand, 0 to 1."""


def detect_sequence(
    sequence: Sequence,
    progress: Progress | None = None,
    *,
    views: SequenceOf[View] | None = None,
) -> Float[ndarray, "view frame hand 21 3"]:
    """Find the keypoints of a sequence's hands in all frames.

    Args:
        sequence: The sequence; it must say which hands it shows.
        progress: Told after every frame.
        views: Views to look into, which must have color images; None are all.

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
    views = sequence.views if views is None else views
    blind = [view.name for view in views if not view.has_color]
    if blind or not views:
        raise MissingInputError(
            f"Sequence '{sequence.name}': view '{(blind or ['?'])[0]}' has no color images to find "
            "keypoints in. Add color.mp4 or color/, or give keypoint.npy for the view."
        )
    detector = KeypointDetector()
    progress = progress or NullProgress()
    return np.stack([detect_view(view, sequence.hands, progress, detector) for view in views])


@dataclass(frozen=True)
class Region:
    """A square region of an image that holds one hand, fingers pointing up inside it."""

    center: Float[ndarray, " 2"]
    """Pixel x and y of the middle [px]."""
    size: float
    """Length of a side [px]."""
    angle: float
    """Clockwise turn of the region in the image [rad]."""

    def to_image(self) -> Float[ndarray, "2 3"]:
        """Map the unit square (y down) to the image, as an affine matrix."""
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        linear = self.size * np.array([[cosine, -sine], [sine, cosine]])
        return np.column_stack([linear, self.center - linear @ [0.5, 0.5]])


@dataclass(frozen=True)
class Landmarks:
    """Output of the landmark network for one region."""

    pixel: Float[ndarray, "21 2"]
    """Keypoints in the image [px]."""
    presence: float
    """Probability that the region shows a hand."""
    right: float
    """Probability that it is a right hand."""


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
        existing: SequenceOf[DetectedHand] = (),
        max_hands: int = _MAX_HANDS,
        *,
        finds_small: bool = False,
    ) -> list[DetectedHand]:
        """Search a whole RGB image for hands.

        Args:
            image: The image (RGB).
            existing: Hands that are already detected in it; they come first in the result.
            max_hands: Most hands to return, the existing ones included.
            finds_small: Whether to look into one part of the image after the other, for hands
                that are too small in the whole of it.
        """
        hands = list(existing)
        windows = _windows(image) if finds_small else [_whole(image)]
        for region in (region for window in windows for region in self._find_palms(image, window)):
            if len(hands) >= max_hands:
                break
            first = self._find_landmarks(image, region)
            if first.presence > _PRESENCE:
                # The palm's region is coarse; its keypoints give a better one.
                self._add(hands, image, landmark_region(first.pixel))
        return hands[:max_hands]

    def follow(
        self,
        image: UInt8[ndarray, "row column 3"],
        previous: SequenceOf[DetectedHand],
        existing: SequenceOf[DetectedHand] = (),
    ) -> list[DetectedHand]:
        """Search for the hands of the previous frame near their positions in it.

        Args:
            image: The image (RGB).
            previous: Hands of a frame next to it.
            existing: Hands that are already detected in it; they come first in the result.
        """
        hands = list(existing)
        for hand in previous:
            self._add(hands, image, landmark_region(hand.keypoint))
        return hands

    def _add(
        self, hands: list[DetectedHand], image: UInt8[ndarray, "row column 3"], region: Region
    ) -> None:
        """Append the hand in a region, if there is one that is not listed yet."""
        hand = self._find_landmarks(image, region)
        is_new = all(overlap(hand.pixel, other.keypoint) < _SAME_HAND for other in hands)
        if hand.presence > _PRESENCE and is_new:
            side: HandSide = "right" if hand.right > 0.5 else "left"
            hands.append(DetectedHand(side, hand.pixel, hand.presence, hand.right))


def detect_view(
    view: View, hands: tuple[HandSide, ...], progress: Progress, detector: KeypointDetector
) -> Float[ndarray, "frame hand 21 3"]:
    """Follow the given hands through one view, and back from where they were first found.

    Where no frame shows a hand, they are looked for once more as small ones.

    Args:
        view: The view; needs color images.
        hands: Hands to look for, in the order of the result's hand axis.
        progress: Told after every frame.
        detector: The networks.

    Returns:
        Pixel x, pixel y and confidence of each keypoint; NaN where a hand was not found.
    """
    result = _follow_through(view, hands, progress, detector, finds_small=False)
    if np.isnan(result).all():
        result = _follow_through(view, hands, progress, detector, finds_small=True)
    _follow_back(view, result, progress, detector)
    return result


def _follow_through(
    view: View,
    hands: tuple[HandSide, ...],
    progress: Progress,
    detector: KeypointDetector,
    *,
    finds_small: bool,
) -> Float[ndarray, "frame hand 21 3"]:
    result = np.full((view.frame_count, len(hands), 21, 3), np.nan, dtype=np.float32)
    previous: list[DetectedHand] = []
    for frame in range(view.frame_count):
        progress.check_cancelled()
        image = view.color(frame)
        detected = detector.follow(image, previous)
        if len(detected) < len(hands):
            detected = detector.detect(image, detected, finds_small=finds_small)
        assigned = assign_hands(detected, hands)
        for index, hand in assigned.items():
            result[frame, index, :, :2] = hand.keypoint
            result[frame, index, :, 2] = hand.confidence
        previous = list(assigned.values())
        progress.report(KEYPOINT_STAGE, frame + 1, view.frame_count, None, f"View {view.name}")
    return result


def _follow_back(
    view: View,
    keypoint: Float[ndarray, "frame hand 21 3"],
    progress: Progress,
    detector: KeypointDetector,
) -> None:
    """Follow each hand into the frames before those in which it was found, as far as it goes.

    A hand is easier to follow than to find: the networks know where to look.
    """
    is_found = np.isfinite(keypoint[:, :, 0, 2])
    lost: dict[int, DetectedHand] = {}
    images: list[UInt8[ndarray, "row column 3"]] = []
    for frame in range(view.frame_count - 2, -1, -1):
        after, here = is_found[frame + 1], is_found[frame]
        for hand in np.flatnonzero(after & ~here):
            lost.setdefault(int(hand), _detected(keypoint[frame + 1, hand]))
        lost = {hand: there for hand, there in lost.items() if after[hand] and not here[hand]}
        if not lost:
            images.clear()
            continue
        progress.check_cancelled()
        if not images:  # Videos are read forwards only.
            first = max(0, frame + 1 - _CHUNK)
            images = [view.color(number) for number in range(first, frame + 1)]
        image = images.pop()
        others = [_detected(keypoint[frame, hand]) for hand in np.flatnonzero(here)]
        for hand, there in list(lost.items()):
            hands = detector.follow(image, [there], others)[len(others) :]
            for one in hands:
                keypoint[frame, hand, :, :2], keypoint[frame, hand, :, 2] = (
                    one.keypoint,
                    one.confidence,
                )
                lost[hand], is_found[frame, hand] = one, True
                others.append(one)


def _detected(keypoint: Float[ndarray, "21 3"]) -> DetectedHand:
    """Take stored keypoints of a hand, whose side is settled, for a detection."""
    pixel = keypoint[:, :2].astype(np.float64)
    return DetectedHand("right", pixel, float(keypoint[0, 2]), 1.0)


def assign_hands(
    detected: SequenceOf[DetectedHand], hands: tuple[HandSide, ...]
) -> dict[int, DetectedHand]:
    """Assign the detected hands of one image to the hands of a sequence.

    A single hand gets the detection that looks most like it, whatever side the network names;
    of two hands, the right one gets the detection that looks more like a right hand.

    Returns:
        Detection by index in `hands`.
    """
    ordered = sorted(detected, key=lambda hand: -hand.right)
    if not ordered:
        return {}
    if len(hands) == 1:
        return {0: ordered[0] if hands[0] == "right" else ordered[-1]}
    if len(ordered) == 1:
        return {hands.index(ordered[0].side): ordered[0]}
    return {hands.index("right"): ordered[0], hands.index("left"): ordered[-1]}


class PalmNetwork:
    """Finds palms anywhere in an image."""

    def __init__(self, threads: int = 2) -> None:
        self._network = _Network("palm_detection_full.tflite", threads)
        self._anchor = _anchors()

    def __call__(self, image: UInt8[ndarray, "row column 3"], window: Region) -> list[Region]:
        """Find the regions that hold a hand in a window of an RGB image, the most certain first."""
        side = round(window.size)
        box, score = self._network(_crop(image, window, _PALM_SIZE))
        logit = np.clip(score.reshape(-1).astype(np.float64), -100, 100)
        probability = 1 / (1 + np.exp(-logit))
        keep = probability >= _PALM_SCORE
        value = box.reshape(-1, 9, 2)[keep].astype(np.float64) / _PALM_SIZE
        value[:, [0, 2, 3, 4, 5, 6, 7, 8]] += self._anchor[keep][:, None]
        offset = side / 2 - window.center
        value = value * side
        value[:, [0, 2, 3, 4, 5, 6, 7, 8]] -= offset
        return [_palm_region(palm) for palm in _merge(value, probability[keep])]


class LandmarkNetwork:
    """Finds the 21 keypoints of the hand in a region."""

    def __init__(self, threads: int = 2) -> None:
        self._network = _Network("hand_landmark_full.tflite", threads)

    def __call__(self, image: UInt8[ndarray, "row column 3"], region: Region) -> Landmarks:
        """Find the keypoints of the hand in a region of an RGB image."""
        landmark, presence, handedness, _ = self._network(_crop(image, region, _LANDMARK_SIZE))
        local = landmark.reshape(21, 3)[:, :2].astype(np.float64) / _LANDMARK_SIZE
        matrix = region.to_image()
        return Landmarks(
            pixel=local @ matrix[:, :2].T + matrix[:, 2],
            presence=float(presence.item()),
            right=float(handedness.item()),
        )


def _whole(image: UInt8[ndarray, "row column 3"]) -> Region:
    """Return the square around an image."""
    height, width = image.shape[:2]
    return Region(np.array([width, height]) / 2, float(max(height, width)), 0.0)


def _windows(image: UInt8[ndarray, "row column 3"]) -> list[Region]:
    """Cover an image by squares that overlap by half."""
    height, width = image.shape[:2]
    size = _WINDOW_SHARE * min(height, width)
    rows, columns = (np.arange(size / 2, length - size / 4, size / 2) for length in (height, width))
    return [Region(np.array([x, y]), size, 0.0) for y in rows for x in columns]


def landmark_region(pixel: Float[ndarray, "21 2"]) -> Region:
    """Predict the region of a hand in the next frame from its keypoints."""
    part = pixel[[0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]]
    knuckle = (pixel[5] + pixel[13]) / 4 + pixel[9] / 2
    angle = _turn_to_up(pixel[0], knuckle)
    return _region_around(part, angle, shift=-0.1, scale=2.0)


def overlap(first: Float[ndarray, "21 2"], second: Float[ndarray, "21 2"]) -> float:
    """Compute the intersection over union of two hands' bounding boxes."""
    low = np.maximum(first.min(0), second.min(0))
    high = np.minimum(first.max(0), second.max(0))
    shared = float(np.prod(np.maximum(high - low, 0)))
    total = float(np.prod(np.ptp(first, axis=0)) + np.prod(np.ptp(second, axis=0)))
    return shared / max(total - shared, 1e-9)


class _Network:
    def __init__(self, file: str, threads: int) -> None:
        from ai_edge_litert.interpreter import Interpreter

        self._interpreter = Interpreter(str(_ASSETS / file), num_threads=threads)
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        details = self._interpreter.get_output_details()
        self._outputs = [d["index"] for d in sorted(details, key=lambda d: d["name"])]
        self._lock = threading.Lock()

    def __call__(self, picture: Float[ndarray, "row column 3"]) -> list[ndarray]:
        with self._lock:
            self._interpreter.set_tensor(self._input, picture[None])
            self._interpreter.invoke()
            return [self._interpreter.get_tensor(index) for index in self._outputs]


def _crop(
    image: UInt8[ndarray, "row column 3"], region: Region, size: int
) -> Float[ndarray, "row column 3"]:
    """Cut a region out of an image, black outside, values 0 to 1."""
    matrix = region.to_image()
    matrix[:, :2] /= size
    matrix[:, 2] += matrix[:, :2] @ [0.5, 0.5] - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (size, size), flags=flags).astype(np.float32) / 255


def _anchors() -> Float[ndarray, "anchor 2"]:
    """Lay out the centres of the palm network's anchors in the unit square."""
    grids = []
    for stride, count in _STRIDES:
        cells = (np.arange(_PALM_SIZE // stride) + 0.5) * stride / _PALM_SIZE
        y, x = np.meshgrid(cells, cells, indexing="ij")
        grids.append(np.repeat(np.stack([x, y], -1).reshape(-1, 2), count, axis=0))
    return np.concatenate(grids)


def _merge(
    palm: Float[ndarray, "palm 9 2"], score: Float[ndarray, " palm"]
) -> list[Float[ndarray, "9 2"]]:
    """Average detections that overlap, weighted by score (weighted non-maximum suppression)."""
    merged = []
    remaining = np.argsort(-score, kind="stable")
    while len(remaining):
        best = palm[remaining[0]]
        is_same = _box_overlap(best, palm[remaining]) > _OVERLAP
        is_same[0] = True
        same = remaining[is_same]
        merged.append(np.average(palm[same], axis=0, weights=score[same]))
        remaining = remaining[~is_same]
    return merged


def _box_overlap(
    first: Float[ndarray, "9 2"], others: Float[ndarray, "palm 9 2"]
) -> Float[ndarray, " palm"]:
    low = np.maximum(first[0] - first[1] / 2, others[:, 0] - others[:, 1] / 2)
    high = np.minimum(first[0] + first[1] / 2, others[:, 0] + others[:, 1] / 2)
    shared = np.maximum(high - low, 0).prod(1)
    return shared / np.maximum(first[1].prod() + others[:, 1].prod(1) - shared, 1e-12)


def _palm_region(palm: Float[ndarray, "9 2"]) -> Region:
    """Enlarge a palm's box to the whole hand; keypoints 0 and 2 are wrist and middle knuckle."""
    center, extent, wrist, knuckle = palm[0], palm[1], palm[2], palm[4]
    angle = _turn_to_up(wrist, knuckle)
    up = np.array([np.sin(angle), -np.cos(angle)])
    return Region(center + 0.5 * extent[1] * up, 2.6 * float(extent.max()), angle)


def _region_around(
    point: Float[ndarray, "point 2"], angle: float, *, shift: float, scale: float
) -> Region:
    cosine, sine = np.cos(angle), np.sin(angle)
    to_image = np.array([[cosine, -sine], [sine, cosine]])
    local = point @ to_image
    low, high = local.min(0), local.max(0)
    extent = high - low
    center = (low + high) / 2 + [0, shift * extent[1]]
    return Region(to_image @ center, scale * float(extent.max()), angle)


def _turn_to_up(wrist: Float[ndarray, " 2"], knuckle: Float[ndarray, " 2"]) -> float:
    x, y = knuckle - wrist
    return float(np.arctan2(x, -y))
