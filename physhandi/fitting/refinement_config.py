"""Settings of stage 3."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """How hands are corrected through the simulator."""

    iterations: int = 40
    """Updates; 0 skips the stage."""
    articulation_rate: float = 0.01
    """Step of the joints [rad]."""
    rotation_rate: float = 0.01
    """Step of the wrist's rotation [rad]."""
    translation_rate: float = 1e-3
    """Step of the wrist's position [m]."""
    decay: float = 0.97
    """What each step is of the one before."""
    beta_2: float = 0.99
    """Adam's second moment decay."""
    steps_by_parameter: bool = False
    """Every number steps by itself (Adam, as the paper), or all of one frame share one step."""
    window: int | None = 2
    """Frames that a gradient reaches back; none is the whole sequence."""
    track_weight: float = 1.0
    """Weight of the track term beside the Chamfer term (paper: 1)."""
    prior_weight: float = 3.0
    """Weight of the surface's squared displacement from stage 1, beside the object's error."""
    smoothness_weight: float = 10.0
    """Weight of the squared change of that displacement from frame to frame."""
    keypoint_weight: float = 1e-6
    """Weight of stage 1's keypoint term, which keeps the hands in the images [m²]."""
    carry_time: float = 0.5
    """Time in which the last correction fades after the frames that are fitted [s]."""

    def __post_init__(self) -> None:
        if self.iterations < 0 or (self.window is not None and self.window < 1):
            raise ValueError("iterations must be at least 0, and window at least 1 or none")
        rates = (self.articulation_rate, self.rotation_rate, self.translation_rate)
        if min(rates) < 0 or not 0 < self.decay <= 1 or not 0 <= self.beta_2 < 1:
            raise ValueError("rates must not be negative, decay in ]0, 1], beta_2 in [0, 1[")

    @property
    def rates(self) -> dict[str, float]:
        """The step of every kind of correction, by the names of `HandOffsets`."""
        return {
            "articulation": self.articulation_rate,
            "rotation": self.rotation_rate,
            "translation": self.translation_rate,
        }
