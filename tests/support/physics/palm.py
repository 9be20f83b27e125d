"""A small sheet that comes to rest on a tilted palm, which carries its weight."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

WEIGHT = 4 * 9.81
"""Weight of the sheet's four nodes of 1 kg [N]."""
_SLOPE = Rotation.from_rotvec([0.0, 0.3, 0.0])


def on_a_palm(frames: int = 12, **settings: Any) -> ObjectRollout:
    """Lay the sheet on two triangles that a friction of 0.5 holds it on, and simulate it.

    Nothing else holds it: there are no virtual springs.
    """
    side = 0.01 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    node, corner = (_SLOPE.apply(size * side).astype(np.float32) for size in (1.0, 5.0))
    model = SpringMassModel(
        object_node=node,
        initial_velocity=np.zeros((4, 3), np.float32),
        spring_nodes=np.array([[0, 1], [1, 2], [2, 3], [0, 3]], np.int32),
        rest_length=np.full(4, 0.02, np.float32),
        stiffness=np.full(4, 50.0, np.float32),
        damping=np.full(4, 1.0, np.float32),
        object_spring_count=4,
        control_count=4,
        clearance=np.zeros(4, np.float32),
        hand_face=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    given = {"hand_pushes": True, "ground_height": None, "substeps_per_frame": 100} | settings
    parameters = SimulationParameters(**given)
    return simulated(model, parameters, np.repeat(corner[None], frames, axis=0))


def simulated(
    model: SpringMassModel, parameters: SimulationParameters, control: np.ndarray
) -> ObjectRollout:
    """Simulate all frames of a control trajectory into a rollout."""
    rollout = ObjectRollout.empty(model, parameters, control)
    assert rollout.velocity is not None
    for frame, position, velocity in Simulator(model, parameters).frames(control):
        rollout.position[frame], rollout.velocity[frame] = position, velocity
    rollout.ready = rollout.frame_count
    return rollout
