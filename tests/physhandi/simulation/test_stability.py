"""The stability estimate against dense eigenvalues, real topology and actual divergence."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene

from physhandi.errors import SimulationDivergedError
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import (
    SAFETY,
    largest_stable_step,
    stable_substeps,
    with_stable_substeps,
)


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


def exact_step(scene):
    """Solve dt² K + 2 dt C = 4 for its smallest dt, by the dense companion matrix in 1 / dt."""
    stiffness, dashpot = dense_operators(scene)
    size = len(stiffness)
    companion = np.block([[dashpot / 2, stiffness / 4], [np.eye(size), np.zeros((size, size))]])
    return 1.0 / np.linalg.eigvals(companion).real.max()


def random_scene(seed):
    """Tie a few nodes and two controls at random, some springs stiff, some only damped."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 30))
    node = rng.uniform(0.0, 0.1, (count, 3))
    control = rng.uniform(0.0, 0.1, (1, 2, 3))
    pairs = rng.integers(0, count, (4 * count, 2))
    held = np.stack([rng.integers(0, count, 3), count + rng.integers(0, 2, 3)], axis=1)
    springs = np.vstack([np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0), held])
    number = len(springs)
    return bare_scene(
        node,
        springs=springs,
        rest=10.0 ** rng.uniform(-3, -1, number),
        stiffness=rng.choice([0.0, 1.0, 1e3], number) * rng.uniform(1, 10, number),
        damping=rng.choice([0.0, 1.0, 100.0], number) * rng.uniform(1, 3, number),
        control=np.repeat(control, 2, axis=0),
    )


@pytest.mark.parametrize("seed", range(40))
def test_no_system_gets_less_than_its_margin(seed):
    scene = random_scene(seed)
    model, parameters = as_model(scene)
    exact = 1.0 / (parameters.frame_rate * exact_step(scene))
    assert exact > 1.0
    needed = stable_substeps(model, parameters, scene.control[0])
    assert 0.99 * SAFETY * exact <= needed <= 1.01 * SAFETY * exact + 1
    assert stable_substeps(model, parameters) >= 0.99 * SAFETY * exact


def test_one_node_between_two_controls():
    # 2 Y / r = 4e4 along x and no force across: dt = 2 / √4e4 = 0.01 s.
    scene = bare_scene(
        [[0.5, 0.0, 0.0]],
        springs=[(0, 1), (0, 2)],
        rest=[0.5, 0.5],
        stiffness=[1e4, 1e4],
        damping=[0.0, 0.0],
        control=np.array([[[0.0, 0, 0], [1.0, 0, 0]]] * 2),
    )
    model, parameters = as_model(scene)
    assert largest_stable_step(model, parameters, scene.control[0]) == pytest.approx(0.01, rel=1e-4)


def test_automatic_substeps_are_stable_and_never_coarse():
    scene = cube_scene()
    model, parameters = as_model(scene)
    parameters = parameters.replace(drag=5.0, frame_duration=1.0 / 25.0)
    stiff = parameters.replace(stiffness_scale=1e6)
    control = scene.control[0]
    needed = stable_substeps(model, stiff, control)
    assert needed > 1000
    assert with_stable_substeps(stiff, model, control) == stiff.replace(substeps_per_frame=needed)
    twice = with_stable_substeps(stiff, model, control, safety=2.0 * SAFETY).substeps_per_frame
    assert twice == pytest.approx(2 * needed, abs=1)
    # What is soft is held by the longest step: 25 frames a second are 144 of 1/3600 s each.
    assert with_stable_substeps(parameters, model, control).substeps_per_frame == 144
    alone = with_stable_substeps(parameters, model, control, longest_step=np.inf)
    assert alone.substeps_per_frame == stable_substeps(model, parameters, control) < 144


def test_one_spring_is_stable_up_to_the_textbook_step():
    # Two unit masses: ω² = 2 Y / r, dt = 2 / ω = √(2 · 0.5 / 100) = 0.1 s.
    scene = bare_scene(
        [[0.0, 0, 0], [0.5, 0, 0]], springs=[(0, 1)], rest=[0.5], stiffness=[100.0], damping=[0.0]
    )
    model, parameters = as_model(scene)
    assert largest_stable_step(model, parameters) == pytest.approx(0.1, rel=1e-4)
    assert largest_stable_step(model, parameters.replace(stiffness_scale=4.0)) == pytest.approx(
        0.05, rel=1e-4
    )
    # One frame of 1 s needs ten of those, 25 % more for safety.
    assert stable_substeps(model, parameters.replace(frame_rate=1.0)) == 13


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
    fine = parameters.replace(frame_rate=1.0 / (0.97 * step), substeps_per_frame=1)
    rollout = Simulator(model, fine, device=device).rollout(scene.control)
    assert np.abs(rollout.velocity).max() < 1.0
    with pytest.raises(SimulationDivergedError):
        Simulator(model, fine.replace(frame_rate=1.0 / (1.03 * step)), device=device).rollout(
            scene.control
        )


def recorded_block(arrays, stiffness, floor=0.0, damping=0.0):
    """Build PhysTwin's t_block with one stiffness."""
    count = len(arrays["spring_nodes"])
    return SpringMassModel(
        object_node=arrays["position"],
        initial_velocity=np.zeros_like(arrays["position"]),
        spring_nodes=arrays["spring_nodes"].astype(np.int32),
        rest_length=np.maximum(arrays["rest_length"], np.float32(floor)),
        stiffness=np.full(count, stiffness, dtype=np.float32),
        damping=np.full(count, damping, dtype=np.float32),
        object_spring_count=count,
        control_count=0,
    )


@pytest.mark.parametrize(
    ("stiffness", "floor", "damping", "substeps"),
    [(3e4, 0.0, 0.0, 412), (1e5, 0.0, 0.0, 753), (3e4, 1e-3, 0.0, 191), (3e4, 0.0, 100.0, 432)],
)
def test_nine_short_springs_decide_how_many_substeps_the_block_needs(
    shared_array, stiffness, floor, damping, substeps
):
    arrays = shared_array("spring_twin/t_block.npz")
    assert np.sum(arrays["rest_length"] < 1e-3) == 9
    model = recorded_block(arrays, stiffness, floor, damping)
    assert stable_substeps(model, SimulationParameters(), safety=1.0) == pytest.approx(
        substeps, abs=2
    )


def test_the_block_diverges_at_667_substeps_where_it_needs_753(shared_array, device):
    model = recorded_block(shared_array("spring_twin/t_block.npz"), 1e5)
    parameters = SimulationParameters(ground_height=None, drag=0.0)
    control = np.zeros((2, 0, 3))
    with pytest.raises(SimulationDivergedError, match="rest_length_floor") as caught:
        Simulator(model, parameters, device=device).rollout(control)
    nodes = model.spring_nodes[model.rest_length < 1e-3]
    assert caught.value.node in nodes
    automatic = with_stable_substeps(parameters, model, safety=1.01)
    assert 753 < automatic.substeps_per_frame < 770
    motion = np.diff(Simulator(model, automatic, device=device).rollout(control).position, axis=0)
    # It falls freely for a frame: g t² / 2, and half a substep's g t more.
    step = automatic.dt
    fall = 0.5 * 9.81 * (1 / 30) * (1 / 30 + step)
    np.testing.assert_allclose(motion[..., 2], -fall, atol=2e-5)
