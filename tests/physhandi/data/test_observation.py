"""Observations whose parts do not fit together are refused."""

import numpy as np
import pytest

from physhandi.data.observation import ObjectObservation


def make(**changes: object) -> ObjectObservation:
    parts = {
        "point": np.zeros((4, 3, 3), np.float32),
        "is_visible": np.ones((4, 3), bool),
        "is_motion_valid": np.ones((4, 3), bool),
    }
    return ObjectObservation(**(parts | changes))


def test_counts() -> None:
    observation = make(
        cloud=(np.zeros((7, 3)), np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((2, 3)))
    )
    assert (observation.frame_count, observation.track_count) == (4, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"is_visible": np.ones((4, 2), bool)}, r"is_visible has shape \(4, 2\)"),
        ({"is_motion_valid": np.ones((3, 3), bool)}, r"is_motion_valid has shape \(3, 3\)"),
        ({"cloud": (np.zeros((7, 3)),)}, "cloud has 1 frames, but point has 4"),
        ({"node_of_track": np.zeros(5, int)}, r"node_of_track has shape \(5,\) for 3 tracks"),
    ],
)
def test_parts_must_fit(changes: dict[str, object], message: str) -> None:
    observation = make()
    for name, value in changes.items():
        object.__setattr__(observation, name, value)
    # Outside of tests nothing checks the shapes in annotations, so the class itself has to.
    with pytest.raises(ValueError, match=message):
        observation.__post_init__()
