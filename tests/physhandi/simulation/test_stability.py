"""The stability estimate against dense eigenvalues, real topology and actual divergence."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene

from physhandi.errors import SimulationDivergedError
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import largest_stable_step, stable_substeps


def dense_operators(scene):
    """Assemble stiffness and damping matrices of the object nodes, spring by spring."""
    place = np.vstack([scene.node, scene.control[0]])
    stiffness, damping = np.zeros((2, 3 * len(place), 3 * len(place)))
    for (i, j), rest, y, c in zip(
        scene.springs, scene.rest, scene.stiffness, scene.damping, strict=True
    ):
        row = np.zeros((len(place), 3))
        row[j] = (place[j] - place[i]) / np.linalg.norm(place[j] - place[i])
        row[i] = -row[j]
        stiffness += y / rest * np.outer(row, row)
        damping += c * np.outer(row, row)
    size = 3 * len(scene.node)
    return stiffness[:size, :size], damping[:size, :size]


@pytest.mark.parametrize("damping", [0.0, 1.0, 30.0])
def test_the_step_is_where_the_dense_operator_reaches_four(damping):
    scene = cube_scene()
    scene = replace(scene, damping=scene.damping * damping)
    stiffness, dashpot = dense_operators(scene)
    step = largest_stable_step(*as_model(scene), scene.control[0])
    highest = np.linalg.eigvalsh(step**2 * stiffness + 2.0 * step * dashpot)[-1]
    assert highest == pytest.approx(4.0, rel=2e-3)


def test_one_spring_is_stable_up_to_the_textbook_step():
    # Two unit masses: ω² = 2 Y / r, dt = 2 / ω = √(2 · 0.5 / 100) = 0.1 s.
    scene = bare_scene(
        [[0.0, 0, 0], [0.5, 0, 0]], springs=[(0, 1)], rest=[0.5], stiffness=[100.0], damping=[0.0]
    )
    model, parameters = as_model(scene)
    assert largest_stable_step(model, parameters) == pytest.approx(0.1, rel=1e-4)
    assert largest_stable_step(model, replace(parameters, stiffness_scale=4.0)) == pytest.approx(
        0.05, rel=1e-4
    )
    # One frame of 1 s needs ten of those, 25 % more for safety.
    assert stable_substeps(model, replace(parameters, frame_rate=1.0)) == 13


def test_nothing_stiff_needs_one_substep():
    model, parameters = as_model(bare_scene([[0.0, 0, 0]]))
    assert largest_stable_step(model, parameters) == np.inf
    assert stable_substeps(model, parameters) == 1


def test_unknown_control_positions_err_on_the_safe_side():
    scene = cube_scene()
    model, parameters = as_model(scene)
    assert largest_stable_step(model, parameters) <= largest_stable_step(
        model, parameters, scene.control[0]
    )


def test_the_simulator_diverges_beyond_the_step_and_not_before(device):
    direction = np.array([0.6, 0.0, 0.8])
    scene = bare_scene(
        [0 * direction, 0.51 * direction],
        springs=[(0, 1)],
        rest=[0.5],
        stiffness=[100.0],
        damping=[1.0],
        frames=400,
    )
    model, parameters = as_model(scene)
    step = largest_stable_step(model, parameters)
    fine = replace(parameters, frame_rate=1.0 / (0.97 * step), substeps_per_frame=1)
    rollout = Simulator(model, fine, device=device).rollout(scene.control)
    assert np.abs(rollout.velocity).max() < 1.0
    with pytest.raises(SimulationDivergedError):
        Simulator(model, replace(fine, frame_rate=1.0 / (1.03 * step)), device=device).rollout(
            scene.control
        )


@pytest.mark.parametrize(
    ("stiffness", "floor", "damping", "substeps"),
    [(3e4, 0.0, 0.0, 412), (1e5, 0.0, 0.0, 753), (3e4, 1e-3, 0.0, 191), (3e4, 0.0, 100.0, 432)],
)
def test_nine_short_springs_decide_how_many_substeps_the_block_needs(
    shared_array, stiffness, floor, damping, substeps
):
    block = shared_array("spring_twin/t_block.npz")
    assert np.sum(block["rest_length"] < 1e-3) == 9
    count = len(block["spring_nodes"])
    model = SpringMassModel(
        object_node=block["position"],
        initial_velocity=np.zeros_like(block["position"]),
        spring_nodes=block["spring_nodes"].astype(np.int32),
        rest_length=np.maximum(block["rest_length"], np.float32(floor)),
        stiffness=np.full(count, stiffness, dtype=np.float32),
        damping=np.full(count, damping, dtype=np.float32),
        object_spring_count=count,
        control_count=0,
    )
    assert stable_substeps(model, SimulationParameters(), safety=1.0) == pytest.approx(
        substeps, abs=2
    )
