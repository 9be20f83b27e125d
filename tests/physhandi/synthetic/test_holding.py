"""Hands of capsules and another physics engine together: what is gripped goes where hands go."""

import numpy as np
import pytest

from physhandi.data.sequence_meta import Side
from physhandi.synthetic.bodies.bodies import make_body
from physhandi.synthetic.engines.mujoco_flex import simulate_truth
from physhandi.synthetic.hands.actions import script_action
from physhandi.synthetic.hands.true_hand import TrueHand, load_true_hand

FRAMES = 24


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_friction_alone_lifts_a_rope(seed: int):
    pytest.importorskip("mujoco")
    hands: dict[Side, TrueHand] = {"right": load_true_hand("right", seed=seed)}
    rope = make_body("rope", np.random.default_rng(seed), resolution="tiny")
    (script,) = script_action(
        "lift", rope, np.random.default_rng(seed), duration=(FRAMES - 1) / 30, hands=hands
    )
    truth = simulate_truth(rope, (script,), hands, frame_count=FRAMES)
    held = np.flatnonzero(truth.contact[0])
    assert len(held) > 0
    assert truth.contact[-1].any()
    risen = (truth.position[-1] - truth.position[0])[held, 2].mean()
    lifted = (script.at((FRAMES - 1) / 30).position - script.at(0.0).position)[2]
    assert lifted > 0.03
    assert risen > 0.8 * lifted
    other_end = np.argmax(np.abs(rope.node[:, 0] - rope.node[held, 0].mean()))
    assert truth.position[-1, other_end, 2] < 0.02  # it hangs from the hand
