"""Observation of the object: tracked points and a cloud per frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectObservation:
    """Observed surface points of the object in the world frame."""

    point: Float[ndarray, "frame track 3"]
    """Position of each track [m]; NaN where it is not visible."""
    is_visible: Bool[ndarray, "frame track"]
    """Whether a track was seen in a frame."""
    is_motion_valid: Bool[ndarray, "frame track"]
    """Whether the motion from the frame before can be trusted; False in frame 0."""
    cloud: tuple[Float[ndarray, "_ 3"], ...] = ()
    """Object points of all views fused, per frame [m]; empty if no view has depth."""
    node_of_track: Int[ndarray, " track"] | None = None
    """Object node that each track observes, where the recording identifies it."""

    late: Float[ndarray, "frame late 3"] | None = None
    """Tracks that frame 0 does not show, whose place on the object nobody knows yet [m]; NaN where
    they are not visible. None if there can be none."""

    def __post_init__(self) -> None:
        shape = self.point.shape[:2]
        for name in ("is_visible", "is_motion_valid"):
            if getattr(self, name).shape != shape:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, but point has {shape}"
                )
        if self.cloud and len(self.cloud) != shape[0]:
            raise ValueError(f"cloud has {len(self.cloud)} frames, but point has {shape[0]}")
        if self.late is not None and len(self.late) != shape[0]:
            raise ValueError(f"late has {len(self.late)} frames, but point has {shape[0]}")
        if self.node_of_track is not None and self.node_of_track.shape != shape[1:]:
            raise ValueError(
                f"node_of_track has shape {self.node_of_track.shape} for {shape[1]} tracks"
            )

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.point.shape[0]

    @property
    def track_count(self) -> int:
        """Number of tracks."""
        return self.point.shape[1]


def evenly(count: int, most: int | None) -> Int[ndarray, " kept"]:
    """Choose so many of `count` things at most, evenly spread, first and last included."""
    number = count if most is None else min(most, count)
    return np.linspace(0, count - 1, number).round().astype(int)


def thinned(cloud: Float[ndarray, "point 3"], most: int | None) -> Float32[ndarray, "kept 3"]:
    """Keep so many points of a cloud at most; see `evenly`."""
    return np.asarray(cloud, np.float32).reshape(-1, 3)[evenly(len(cloud), most)]
