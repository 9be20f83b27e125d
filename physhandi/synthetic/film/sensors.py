"""Error models of sensors and detectors, among them an Intel RealSense D455.

Stereo errs in disparity, so the error of depth grows with the square of the distance; it is smooth
over a few pixels, quantised, and depth fails beside edges and at grazing angles.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from numpy import ndarray
from numpy.random import Generator

IMAGER_WIDTH = 848.0
"""Width of the infrared images that depth is computed from [px]."""
# Wider steps of disparity are taken for these: in this image's pixels, and in the imagers'.
_WIDEST_SHADOW = 16, 42


@dataclass(frozen=True, kw_only=True)
class DepthSensor:
    """Errors of a stereo depth camera."""

    focal_length: float = 447.0
    """Focal length of the infrared imagers [px]."""
    baseline: float = 0.095
    """Distance between the imagers [m]."""
    disparity_noise: float = 0.08
    """Standard deviation of the disparity [px]."""
    disparity_step: float = 1 / 32
    """Resolution of the disparity; 0 is exact [px]."""
    correlation: float = 1.2
    """Standard deviation of the blur that makes neighbouring errors alike [px]."""
    hole_rate: float = 0.02
    """Part of the pixels lost to speckle."""
    flying_rate: float = 0.4
    """Part of the pixels at depth edges that mix fore- and background."""
    edge_reach: int = 1
    """How far from a depth edge such pixels lie at most [px]."""
    edge_step: float = 0.025
    """Depth step that makes an edge [m]."""
    grazing_cosine: float = 0.34
    """Cosine of the angle to the normal below which a surface often gives no depth."""
    grazing_rate: float = 0.5
    """Part of the pixels lost on such a surface."""
    shadow: float = 1.0
    """Width of the blind band beside near objects, relative to that of the stereo pair."""
    even_noise: float = 0.0
    """Standard deviation of a further error of each pixel, alike at all distances [m]."""
    bias: float = 0.001
    """Largest slowly varying offset of a whole image [m]."""

    def noise(self, depth: float) -> float:
        """Predict the standard deviation of depth at a distance [m]."""
        return depth * depth * self.disparity_noise / (self.focal_length * self.baseline)

    def measure(
        self,
        depth: Float[ndarray, "row column"],
        cosine: Float[ndarray, "row column"],
        random: Generator,
        *,
        offset: float = 0.0,
        scale: float | None = None,
    ) -> UInt16[ndarray, "row column"]:
        """Convert true depth to a measured depth image.

        Args:
            depth: True depth [m]; 0 where there is nothing.
            cosine: Cosine between the line of sight and the surface normal.
            random: Source of all errors.
            offset: Slow offset of this image, as a part of `bias` from -1 to 1.
            scale: Pixels of this image in one of the imagers'; None if it is as wide as they see.

        Returns:
            Depth [mm]; 0 where nothing was measured.
        """
        there = depth > 0
        mixed = self._fly(depth, random)
        measured = self._read(mixed, smooth_noise(depth.shape, self.correlation, random), offset)
        lost = random.random(depth.shape) < self.hole_rate
        lost |= (cosine < self.grazing_cosine) & (random.random(depth.shape) < self.grazing_rate)
        lost |= self._shadow(depth, depth.shape[1] / IMAGER_WIDTH if scale is None else scale)
        if self.even_noise > 0:
            measured = measured + 1000.0 * self.even_noise * random.standard_normal(depth.shape)
        is_measured = there & ~lost
        return np.where(is_measured, np.clip(np.round(measured), 0, 65535), 0).astype(np.uint16)

    def measure_points(
        self, depth: Float[ndarray, " point"], random: Generator, *, offset: float = 0.0
    ) -> Float[ndarray, " point"]:
        """Measure single points that are far from each other and from edges.

        Args:
            depth: True depth [m].
            random: Source of all errors.
            offset: Slow offset, as a part of `bias` from -1 to 1.

        Returns:
            Depth [m]; NaN where speckle left none.
        """
        measured = self._read(depth, random.standard_normal(depth.shape), offset) / 1000.0
        measured += self.even_noise * random.standard_normal(depth.shape)
        return np.where(random.random(depth.shape) < self.hole_rate, np.nan, measured)

    def _read(self, depth: ndarray, noise: ndarray, offset: float) -> ndarray:
        """Add normal noise of unit variance to the disparity, and quantise; returns depth [mm]."""
        reach = self.focal_length * self.baseline
        disparity = reach / np.maximum(np.where(depth > 0, depth + offset * self.bias, 1.0), 0.05)
        disparity += self.disparity_noise * noise
        if self.disparity_step > 0:
            disparity = np.round(disparity / self.disparity_step) * self.disparity_step
        return 1000.0 * reach / np.maximum(disparity, 1e-3)

    def _fly(self, depth: ndarray, random: Generator) -> Float[ndarray, "row column"]:
        """Mix foreground and background in some of the pixels beside depth edges."""
        kernel = np.ones((2 * self.edge_reach + 1,) * 2, dtype=np.uint8)
        near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
        is_edge = (far - near > self.edge_step) & (near > 0)
        is_edge &= random.random(depth.shape) < self.flying_rate
        blend = random.random(depth.shape)
        return np.where(is_edge, near + blend * (far - near), depth)

    def _shadow(self, depth: ndarray, scale: float) -> Bool[ndarray, "row column"]:
        """Mark the background that the left imager sees but the right one does not."""
        disparity = np.where(depth > 0, self.focal_length * self.baseline, 0.0)
        disparity = disparity / np.maximum(depth, 0.05) * (scale * self.shadow)
        hidden = np.zeros(depth.shape, dtype=bool)
        widest = max(_WIDEST_SHADOW[0], round(_WIDEST_SHADOW[1] * scale))
        for shift in range(1, widest + 1):
            jump = disparity[:, shift:] - disparity[:, :-shift]
            hidden[:, :-shift] |= (jump >= shift) & (depth[:, :-shift] > 0)
        return hidden


def smooth_noise(
    shape: tuple[int, ...], correlation: float, random: Generator
) -> Float[ndarray, "row column"]:
    """Draw normal noise of unit variance that is blurred over `correlation` pixels."""
    noise = cv2.GaussianBlur(random.standard_normal(shape), (0, 0), correlation)
    return noise * (2.0 * np.sqrt(np.pi) * correlation)


def shift_outlines(
    label: UInt8[ndarray, "row column"],
    random: Generator,
    *,
    error: float = 0.7,
    largest: float = 1.4,
) -> UInt8[ndarray, "row column"]:
    """Shift the outlines of a label image by smooth noise.

    Args:
        label: True labels.
        random: Source of the errors.
        error: Standard deviation of the shift [px].
        largest: No shift is larger than this [px].
    """
    height, width = label.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    shift = [
        np.clip(error * smooth_noise(label.shape, 4.0, random), -largest, largest) for _ in range(2)
    ]
    across = np.clip(np.round(columns + shift[0]), 0, width - 1).astype(np.int64)
    down = np.clip(np.round(rows + shift[1]), 0, height - 1).astype(np.int64)
    return label[down, across]


def track(
    pixel: Float[ndarray, "frame track 2"],
    is_seen: Bool[ndarray, "frame track"],
    random: Generator,
    *,
    error: float = 0.5,
    wander: float = 0.0,
    dropout_rate: float = 0.01,
    dropout_frames: int = 3,
) -> tuple[Float[ndarray, "frame track 2"], Bool[ndarray, "frame track"]]:
    """Add a tracker's errors: slow drift, jitter, and short losses of sight.

    Args:
        pixel: True image positions [px].
        is_seen: Whether the point is seen.
        random: Source of the errors.
        error: Standard deviation of each coordinate [px].
        wander: How far each coordinate has drifted for good after 30 frames, standard deviation
            [px].
        dropout_rate: Probability per frame that a track is lost for a while.
        dropout_frames: Frames that such a loss lasts.

    Returns:
        Reported positions, which keep their last place while unseen, and reported visibility.
    """
    frame_count, track_count = is_seen.shape
    drift = np.zeros(pixel.shape)
    memory = 0.9
    drift[0] = random.standard_normal((track_count, 2))
    for frame in range(1, frame_count):
        step = np.sqrt(1 - memory * memory) * random.standard_normal((track_count, 2))
        drift[frame] = memory * drift[frame - 1] + step
    jitter = random.standard_normal(pixel.shape)
    reported = pixel + error * np.sqrt(0.5) * (drift + jitter)
    lost = random.random(is_seen.shape) < dropout_rate
    lost[0] = False
    reach = lost.copy()
    for delay in range(1, dropout_frames):
        reach[delay:] |= lost[:-delay]
    visible = is_seen & ~reach
    if wander > 0:
        steps = random.standard_normal(pixel.shape) * (wander / np.sqrt(30.0))
        steps[0] = 0.0
        reported = reported + np.cumsum(steps, axis=0)
    for frame in range(1, frame_count):
        reported[frame] = np.where(visible[frame, :, None], reported[frame], reported[frame - 1])
    return reported.astype(np.float32), visible


def detect_keypoints(
    pixel: Float[ndarray, "frame keypoint 2"],
    is_hidden: Bool[ndarray, "frame keypoint"],
    size: tuple[int, int],
    random: Generator,
    *,
    error: float = 1.5,
    hidden_factor: float = 2.0,
    loss_rate: float = 0.01,
) -> Float[ndarray, "frame keypoint 3"]:
    """Simulate a keypoint detector: less accurate and less confident where keypoints are hidden.

    Args:
        pixel: True image positions [px].
        is_hidden: Whether something covers the keypoint.
        size: Width and height of the image [px].
        random: Source of the errors.
        error: Standard deviation of each coordinate of a seen keypoint [px].
        hidden_factor: How much larger it is for a hidden one.
        loss_rate: Part of the keypoints that are not found at all.

    Returns:
        Pixel x, pixel y and confidence; NaN outside of the image and where nothing was found.
    """
    spread = error * np.where(is_hidden, hidden_factor, 1.0)[..., None]
    detected = pixel + spread * random.standard_normal(pixel.shape)
    low, high = np.where(is_hidden, 0.35, 0.85), np.where(is_hidden, 0.6, 0.98)
    confidence = low + (high - low) * random.random(is_hidden.shape)
    keypoint = np.concatenate([detected, confidence[..., None]], axis=-1)
    outside = ((detected < 0) | (detected > np.array(size) - 1)).any(axis=-1)
    keypoint[outside | (random.random(is_hidden.shape) < loss_rate)] = np.nan
    return keypoint.astype(np.float32)
