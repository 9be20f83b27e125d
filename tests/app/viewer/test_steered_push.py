"""A steered hand that pushes what it does not hold."""

from dataclasses import replace

import numpy as np
import pytest

from app.settings import BUNDLED
from app.viewer.steer.steered import begin_motion
from physhandi.fitted_object import FittedObject
from physhandi.simulation.steering import POSE, HandSurface, SteeredMotion, SteeredSimulation

FRAME = 5


@pytest.fixture(scope="module")
def towel() -> FittedObject:
    return FittedObject.of(BUNDLED / "runs" / "towel_fold_quick")


def steered(object_: FittedObject) -> SteeredMotion:
    vertex = object_.scene().hands["right"].vertex[FRAME]
    surface = HandSurface(shapes=vertex[None].astype(np.float32))
    return begin_motion(object_.fitted, FRAME, {"right": surface}, {})


def test_fingers_that_press_on_a_towel_slide_it_over_the_table(towel: FittedObject) -> None:
    motion = steered(towel)
    free = motion.let_go(0, motion.start, motion.pose[0])
    ways = {}
    for pushes in (False, True):
        # Fingers slide what the table holds less than they do.
        parameters = free.parameters.replace(hand_pushes=pushes, friction=0.3)
        assert parameters.hand_friction > parameters.friction
        simulation = SteeredSimulation(replace(free, parameters=parameters))
        for frame in range(45):
            pose = np.zeros((1, POSE))
            # Down by 1 cm in half a second, then 3 cm to the side in one.
            pose[0, [0, 2]] = 0.001 * max(frame - 15, 0), -0.01 * min(frame / 15, 1.0)
            position, _ = simulation.step(pose)
        ways[pushes] = (position - motion.start[0])[:, 0].mean()
    assert abs(ways[False]) < 0.001
    assert 0.015 < ways[True] < 0.03


def test_what_a_restart_moved_off_the_hand_is_no_part_of_its_surface(towel: FittedObject) -> None:
    whole = steered(towel).model.hand_face
    assert len(whole) == len(towel.scene().hands["right"].face)
    rollout, moved = replace(towel.fitted), [3, 700]
    shift = np.float32(0.008 * np.isin(np.arange(rollout.control.shape[1]), moved))[:, None]
    rollout.held_control = lambda frame: rollout.control[frame] + shift  # type: ignore[method-assign]
    vertex = towel.scene().hands["right"].vertex[FRAME]
    surface = HandSurface(shapes=vertex[None].astype(np.float32))
    left = begin_motion(rollout, FRAME, {"right": surface}, {}).model.hand_face
    expected = whole[~np.isin(whole, moved).any(axis=1)]
    assert 0 < len(whole) - len(expected) < 40
    np.testing.assert_array_equal(left, expected)
