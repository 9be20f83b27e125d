"""Hand motion: what it stores comes back, and its vertices drive the object."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.hand.names import HandSide


def _motion(side: HandSide = "right", frame_count: int = 200) -> HandMotion:
    random = np.random.default_rng(0)
    return HandMotion(
        side=side,
        shape=random.normal(size=10),
        articulation=0.2 * random.normal(size=(frame_count, 15, 3)),
        wrist_rotation=random.normal(size=(frame_count, 3)),
        wrist_translation=random.normal(size=(frame_count, 3)),
        scale=7.0,
    )


def test_motion_survives_storage() -> None:
    motion = _motion("left")
    stored = motion.to_tensors()
    loaded = HandMotion.from_tensors(stored)
    assert (loaded.side, loaded.scale, loaded.frame_count) == ("left", 7.0, 200)
    for name in ("shape", "articulation", "wrist_rotation", "wrist_translation"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(motion, name), rtol=1e-6)


def test_storage_with_a_fault_is_refused() -> None:
    stored = _motion().to_tensors()
    with pytest.raises(ValueError, match="lacks the array 'scale'"):
        HandMotion.from_tensors({name: a for name, a in stored.items() if name != "scale"})
    with pytest.raises(ValueError, match="'wrist_rotation' must be finite"):
        HandMotion.from_tensors({**stored, "wrist_rotation": np.full((200, 3), np.nan, np.float32)})
    with pytest.raises(ValueError, match=r"'shape' must be .* of shape \(9,\)"):
        HandMotion.from_tensors({**stored, "shape": np.zeros(9, np.float32)})
    with pytest.raises(ValueError, match="'side' must be 0 or 1, not 3"):
        HandMotion.from_tensors({**stored, "side": np.array(3)})


def test_the_hand_model_is_stored_and_old_motions_are_the_open_hands(mano: Path) -> None:
    motion = replace(_motion("left", 3), model="mano")
    stored = motion.to_tensors()
    loaded = HandMotion.from_tensors(stored)
    assert loaded.model == "mano"
    assert loaded.vertices(load_hand_model("left", "mano")).shape == (3, 778, 3)
    with pytest.raises(ValueError, match="'mano' was given the model 'open'"):
        loaded.vertices(load_hand_model("left"))
    del stored["model"]
    assert HandMotion.from_tensors(stored).model == "open"
    with pytest.raises(ValueError, match="'model' must be 0 or 1, not 2"):
        HandMotion.from_tensors({**stored, "model": np.array(2)})


def test_wrist_keypoint_keeps_its_distance_from_the_wrist() -> None:
    motion = _motion()
    wrist = motion.keypoints(load_hand_model("right"))[:, 0]
    distance = np.linalg.norm(wrist - 7 * motion.wrist_translation, axis=1)
    np.testing.assert_allclose(distance, distance[0], atol=1e-4)
    assert 7 * 0.012 < distance[0] < 7 * 0.025


def test_control_nodes_are_all_vertices_of_all_hands_in_order() -> None:
    motions = [_motion("right"), _motion("left")]
    models = [load_hand_model("right"), load_hand_model("left")]
    control = control_trajectory(motions, models)
    assert control.shape == (200, 2 * 1159, 3)
    assert np.array_equal(control[:, 1159:], motions[1].vertices(models[1]))
    assert np.ptp(control) > 1


def test_control_nodes_need_matching_hands() -> None:
    motions = [_motion("right"), _motion("left", 5)]
    models = [load_hand_model("right"), load_hand_model("left")]
    with pytest.raises(ValueError, match=r"not \[200, 5\]"):
        control_trajectory(motions, models)
    with pytest.raises(ValueError, match="a right hand was given a left hand model"):
        motions[0].vertices(models[1])
