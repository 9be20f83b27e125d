"""The scripted true hand lifts by friction alone."""

import numpy as np
import pytest

from physhandi.synthetic.bodies.bodies import make_body
from physhandi.synthetic.engines.flex_scene import FlexParameters
from physhandi.synthetic.engines.mujoco_flex import simulate_truth
from physhandi.synthetic.hands.actions import script_action
from physhandi.synthetic.hands.true_hand import load_true_hand

pytest.importorskip("mujoco")


@pytest.mark.slow
def test_a_true_hand_lifts_a_rope_by_friction():
    random, frames = np.random.default_rng(1), 24
    hands = {"right": load_true_hand("right", seed=1)}
    rope = make_body("rope", random, resolution="tiny")
    scripts = script_action("lift", rope, random, duration=(frames - 1) / 30, hands=hands)
    truth = simulate_truth(
        rope, scripts, hands, frame_count=frames, parameters=FlexParameters(settling_time=0.1)
    )
    wrist = truth.hands["right"][:, 0, 2, 3]
    lift = wrist[-1] - wrist[0]
    assert lift > 0.03
    held = truth.contact[0]
    assert 1 <= np.count_nonzero(held) <= 8
    assert truth.contact[-1].any()
    rise = truth.position[-1, held, 2] - truth.position[0, held, 2]
    assert 0.8 * lift < rise.mean() < 1.1 * lift
    other_end = np.argmax(np.abs(rope.node[:, 0] - rope.node[held, 0].mean()))
    assert truth.position[-1, other_end, 2] < 0.02  # It hangs from the hand.
    assert truth.position[..., 2].min() > 0.5 * rope.radius


def test_a_hand_that_comes_late_and_lets_go_touches_nothing_before_and_after():
    frames, set_out, release = 62, -0.6, 1.3
    hands = {"right": load_true_hand("right", seed=1)}
    rope = make_body("rope", np.random.default_rng(1), resolution="tiny")
    scripts = script_action(
        "lift",
        rope,
        np.random.default_rng(1),
        duration=(frames - 1) / 30,
        set_out=set_out,
        release=release,
        hands=hands,
    )
    truth = simulate_truth(
        rope, scripts, hands, frame_count=frames, parameters=FlexParameters(settling_time=0.1)
    )
    frame = np.flatnonzero(truth.contact.any(axis=1))
    first, last = int(frame[0]), int(frame[-1])
    # It closes from -0.2 s on, lifts from 0.9 s to 1.3 s, has opened at 1.7 s and is away at 2.1 s.
    assert 0 < first <= 12
    assert 39 <= last < 63
    still = np.linalg.norm(truth.position[:first] - truth.position[0], axis=2)
    assert still.max() < 5e-4
    held = truth.contact[36]
    assert held.any()
    height = truth.position[:, held, 2].mean(axis=1)
    assert height[39] > height[0] + 0.015
    # The rope lies again, and the hand has not come down with it.
    assert height[-1] < height[0] + 0.3 * (height[39] - height[0])
    wrist = truth.hands["right"][:, 0, 2, 3]
    assert wrist[-1] > wrist[39] - 0.01
