"""What is told of a rollout whose nodes the surface of hands pushes."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, crossing_scene, pressed_scene
from reference.spring_mass import Scene
from support.physics.palm import WEIGHT, on_a_palm, simulated

from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.forces import virtual_forces
from physhandi.simulation.restart import Restart


@pytest.fixture(scope="module")
def resting() -> ObjectRollout:
    return on_a_palm()


@pytest.mark.parametrize("has_velocities", [True, False])
def test_a_palm_carries_what_rests_on_it(resting: ObjectRollout, has_velocities: bool) -> None:
    rollout = resting if has_velocities else replace(resting, velocity=None)
    force = rollout.forces(11)
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, WEIGHT], atol=0.01 * WEIGHT)
    # A tilted sheet that friction holds: nodes share the weight, and springs what each carries.
    assert (force[:, 2] > 0.1 * WEIGHT).all()
    face, push = rollout.pushes(11)
    np.testing.assert_array_equal(push, force)
    assert (face >= 0).all()
    mean = rollout.mean_forces()
    np.testing.assert_allclose(mean[11].sum(axis=0), [0.0, 0.0, WEIGHT], atol=0.01 * WEIGHT)


def test_without_pushes_forces_are_those_of_springs_to_the_bit(resting: ObjectRollout) -> None:
    off = replace(resting, parameters=resting.parameters.replace(hand_pushes=False))
    bare = replace(resting, model=replace(resting.model, hand_face=np.zeros((0, 3), np.int32)))
    for rollout in (off, bare):
        assert not rollout.is_pushed
        expected = virtual_forces(rollout.model, rollout.parameters, *rollout.state(11))
        np.testing.assert_array_equal(rollout.forces(11), expected)


def test_a_restart_that_moves_what_springs_hold_leaves_the_surface(resting: ObjectRollout) -> None:
    here = resting.position[8].copy()
    moved = replace(
        resting,
        restart=Restart(frame=8, position=here, velocity=np.zeros_like(here)),
        hand_shift=np.full((4, 3), [0.0, 0.0, 0.01], np.float32),
    )
    assert moved.held_control(9)[0, 2] == pytest.approx(resting.control[9, 0, 2] + 0.01)
    # No spring ends at the hand.
    np.testing.assert_allclose(moved.forces(9), resting.forces(9), atol=1e-2)
    elsewhere = here + np.float32([0.0, 0.0, 2.0])
    away = replace(moved, restart=replace(moved.restart, position=elsewhere))
    assert not away.forces(9).any()


@pytest.mark.parametrize("scene", [pressed_scene(), crossing_scene()], ids=["pushed", "colliding"])
def test_averages_are_of_the_rollout_s_own_motion_though_what_touches_changes(scene: Scene) -> None:
    rollout, places = rollout_of(scene), []

    def remember(model, parameters, position, *_) -> np.ndarray:
        places.append(position.copy())
        return np.zeros(1)

    rollout.frame_means(remember)
    count = (len(places) - 1) // 3
    ends = np.stack([places[count * frame] for frame in range(1, 4)])
    np.testing.assert_allclose(ends, rollout.position[1:], atol=1e-7)


def test_pushes_are_averaged_beside_springs() -> None:
    rollout = rollout_of(pressed_scene())
    mean, springs = rollout.mean_forces()[3], rollout.frame_means(virtual_forces)[3]
    pushed = rollout.pushes(3)[0] >= 0
    assert pushed.sum() > 2
    assert (np.linalg.norm((mean - springs)[pushed], axis=1) > 1.0).all()
    # What is pushed at no moment of the frame is only pulled: one node.
    rest = np.linalg.norm(mean - springs, axis=1) == 0.0
    assert rest.sum() > 5
    assert (np.linalg.norm(springs, axis=1) > 0.0).sum() == 1


def rollout_of(scene: Scene) -> ObjectRollout:
    return simulated(*as_model(scene), scene.control.astype(np.float32))
