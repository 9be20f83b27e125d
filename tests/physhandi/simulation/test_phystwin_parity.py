"""Trajectories that PhysTwin's own simulator produced, with its switches set."""

import math

import numpy as np
import pytest

from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

UP = np.array([1.0, 1.0, -1.0], dtype=np.float32)
"""PhysTwin's z points down into the table."""
# CUDA's float32 exp(-dt · 3) is one unit lower than the nearest float32; that is its drag.
DECAY = float(np.nextafter(np.float32(math.exp(-5e-5 * 3.0)), np.float32(0.0)))
PARAMETERS = SimulationParameters(
    drag=-math.log(DECAY) / 5e-5,
    gravity=9.8,
    frame_rate=1.0 / (667 * 5e-5),
    substeps_per_frame=667,
    use_control_velocity=False,
)


@pytest.mark.parametrize("name", ["plush_lift", "plush_ground"])
def test_trajectories_agree_with_phystwin(device, shared_array, name):
    case = shared_array(f"phystwin_parity/{name}.npz")
    rollout = Simulator(model_of(case), PARAMETERS, device=device).rollout(case["control"] * UP)
    position = case["position"] * UP
    assert np.abs(position[-1] - position[0]).max() > 0.04
    np.testing.assert_allclose(rollout.position, position, atol=1e-5)


def test_a_sheet_folds_as_in_phystwin_with_self_collision(device, shared_array):
    case = shared_array("phystwin_parity/sheet_fold_self_collision.npz")
    parameters = PARAMETERS.replace(
        self_collision=True, collision_distance=0.008, collides_rest_neighbors=True
    )
    simulator = Simulator(model_of(case), parameters, device=device)
    control, position = case["control"][:10] * UP, case["position"][:10] * UP
    rollout = simulator.rollout(control)
    assert np.abs(position[9] - position[0]).max() > 0.04
    np.testing.assert_allclose(rollout.position, position, atol=1e-4)
    # The recorded nodes never come nearer than 8.8 mm, so this fold meets no collision; from
    # 12 mm on, spring neighbours would block each other.
    simulator.set_parameters(parameters.replace(collision_distance=0.012))
    blocked = simulator.rollout(control)
    assert np.abs(blocked.position - position).max() > 1e-3


def model_of(case):
    spring_nodes = case["spring_nodes"]
    node_count = len(case["position_0"])
    return SpringMassModel(
        object_node=case["position_0"] * UP,
        initial_velocity=case["velocity"][0] * UP,
        spring_nodes=spring_nodes,
        rest_length=case["rest_length"],
        stiffness=case["stiffness"],
        damping=np.full(len(spring_nodes), 100.0, dtype=np.float32),
        object_spring_count=int(np.all(spring_nodes < node_count, axis=1).sum()),
        control_count=case["control"].shape[1],
    )
