"""Settings of stage 1."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class HandFitConfig:
    """Settings of stage 1."""

    model: Literal["open", "mano"] = "open"
    """Hand model to fit: the built-in open hand, or MANO that `physhandi import mano` imported."""
    iterations: int = 500
    """Updates of the fit to keypoints."""
    depth_iterations: int = 150
    """Updates of the fit to keypoints and depth that follow, if a view has depth and masks."""
    learning_rate: float = 0.03
    """First step size of the joints [rad]; it falls to a twentieth along a cosine."""
    keypoint_noise: float = 0.015
    """Error to be expected of a keypoint, as a share of the hand's size in the image."""
    doubt: float = 3.0
    """Keypoints that are wrong by more than so many times the expected error lose their pull."""
    agreement: float = 12.0
    """Views agree about a keypoint if it triangulates to so many times the expected error."""
    limit_weight: float = 300.0
    """Weight of the joints' limits [1/rad²]."""
    pose_weight: float = 0.3
    """Weight that pulls all joints towards the template's pose [1/rad²]."""
    shape_weight: float = 0.1
    """Weight that pulls the shape towards the template's."""
    acceleration_noise: float = 4.0
    """Acceleration to be expected of a keypoint [m/s²]."""
    turn_noise: float = 0.3
    """Turn of a joint to be expected from frame to frame [rad]."""
    depth_noise: float = 0.004
    """Error to be expected of a depth measurement on the hand [m]."""
    depth_weight: float = 100.0
    """Weight of a frame's mean depth error, in units of the expected error, squared."""
    depth_points: int = 128
    """Most observed points of a hand that are used in a frame."""

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.depth_iterations < 0 or self.depth_points < 1:
            raise ValueError("iterations and depth_points must be at least 1, depth_iterations 0")
