"""What is averaged on the way of a rollout in which nodes touch each other, or hands push them."""

import numpy as np
import pytest
from reference.scenes import as_model, crossing_scene, pressed_scene
from reference.spring_mass import Scene

from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.simulator import Simulator


@pytest.mark.parametrize("scene", [pressed_scene(), crossing_scene()], ids=["pushed", "colliding"])
def test_averages_are_of_the_rollout_s_own_motion_though_what_touches_changes(scene: Scene) -> None:
    rollout, places = simulated(scene), []

    def remember(model, parameters, position, *_) -> np.ndarray:
        places.append(position.copy())
        return np.zeros(1)

    rollout.frame_means(remember)
    count = (len(places) - 1) // 3
    ends = np.stack([places[count * frame] for frame in range(1, 4)])
    np.testing.assert_allclose(ends, rollout.position[1:], atol=1e-7)


def simulated(scene: Scene) -> ObjectRollout:
    model, parameters = as_model(scene)
    rollout = ObjectRollout.empty(model, parameters, scene.control.astype(np.float32))
    assert rollout.velocity is not None
    for frame, position, velocity in Simulator(model, parameters).frames(rollout.control):
        rollout.position[frame], rollout.velocity[frame] = position, velocity
    rollout.ready = rollout.frame_count
    return rollout
