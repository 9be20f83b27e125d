"""What a run keeps of an observation comes back."""

from pathlib import Path

import numpy as np
import pytest
from run_world import make_run

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.artefacts import STORED_CLOUD, load_observation, save_observation


@pytest.mark.parametrize("is_identified", [True, False])
def test_clouds_of_identified_points_are_kept_whole(tmp_path: Path, *, is_identified: bool) -> None:
    count = STORED_CLOUD + 100
    point = np.random.default_rng(0).normal(size=(3, count, 3)).astype(np.float32)
    point[2, 7] = np.nan
    seen = np.isfinite(point).all(axis=-1)
    observation = ObjectObservation(
        point=point,
        is_visible=seen,
        is_motion_valid=np.zeros_like(seen),
        cloud=tuple(p[s] for p, s in zip(point, seen, strict=True)),
        node_of_track=np.arange(count, dtype=np.int32) if is_identified else None,
    )
    with make_run(tmp_path / "run").begin_attempt() as attempt:
        save_observation(attempt, "lift", observation)
        again = load_observation(attempt.out, "lift")
        attempt.publish()
    sizes = [len(cloud) for cloud in again.cloud]
    assert sizes == ([count, count, count - 1] if is_identified else [STORED_CLOUD] * 3)
    np.testing.assert_array_equal(again.cloud[2][0], point[2, 0])
    np.testing.assert_array_equal(again.cloud[2][-1], point[2, -1])
    np.testing.assert_array_equal(again.point, point)
