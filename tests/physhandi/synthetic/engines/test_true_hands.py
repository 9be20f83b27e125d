"""The scripted true hand lifts by friction alone."""

import numpy as np
import pytest

from physhandi.synthetic.bodies.bodies import make_body
from physhandi.synthetic.engines.mujoco_flex import simulate_truth
from physhandi.synthetic.hands.actions import script_action
from physhandi.synthetic.hands.true_hand import load_true_hand

pytest.importorskip("mujoco")


@pytest.mark.slow
def test_a_true_hand_lifts_a_rope_by_friction():
    random = np.random.default_rng(1)
    hands = {"right": load_true_hand("right", seed=1)}
    rope = make_body("rope", random, resolution="tiny")
    scripts = script_action("lift", rope, random, duration=40 / 30, hands=hands)
    truth = simulate_truth(rope, scripts, hands, frame_count=40)
    wrist = truth.hands["right"][:, 0, 2, 3]
    lift = wrist[-1] - wrist[0]
    assert lift > 0.05
    held = truth.contact[0]
    assert 1 <= np.count_nonzero(held) <= 8
    assert truth.contact[-1].any()
    rise = truth.position[-1, held, 2] - truth.position[0, held, 2]
    assert 0.8 * lift < rise.mean() < 1.1 * lift
    assert truth.position[..., 2].min() > 0.5 * rope.radius
