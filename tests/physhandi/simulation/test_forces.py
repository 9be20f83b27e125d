"""Force arrows against a hand-computed spring and against the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene, pressed_scene
from reference.spring_mass import incidence, pushes, simulate, spring_force

from physhandi.simulation.forces import (
    node_means,
    push_forces,
    spring_strains,
    spring_tensions,
    virtual_forces,
)


def test_one_virtual_spring_pulls_with_strain_and_closing_speed():
    scene = bare_scene(
        [[0.0, 0, 0], [5.0, 0, 0]], springs=[(2, 0)], rest=[0.5], stiffness=[10.0], damping=[3.0]
    )
    model, parameters = as_model(replace(scene, control=np.array([[[0.0, 0.0, 0.6]]] * 2)))
    force = virtual_forces(
        model,
        parameters.replace(stiffness_scale=2.0),
        model.object_node,
        np.array([[0.0, 0.0, 0.1], [0, 0, 0]]),
        np.array([[0.0, 0.0, 0.6]]),
        np.array([[1.0, 0.0, 0.3]]),
    )
    # 2 · 10 · (0.6 / 0.5 - 1) + 3 · (0.3 - 0.1) = 4.6 N upwards.
    np.testing.assert_allclose(force, [[0.0, 0.0, 4.6], [0.0, 0.0, 0.0]], rtol=1e-6)


def test_forces_are_the_oracle_s_without_object_springs():
    scene = cube_scene()
    model, parameters = as_model(scene)
    held, rate = scene.control[2], (scene.control[2] - scene.control[1]) * 30.0
    is_virtual = np.any(scene.springs >= 8, axis=1)
    only = {
        name: getattr(scene, name)[is_virtual]
        for name in ("springs", "rest", "stiffness", "damping")
    }
    everything = np.vstack([scene.node, held]), np.vstack([scene.velocity, rate])
    pulling = replace(scene, **only)
    expected = spring_force(pulling, incidence(pulling, 12), *everything)[:8]
    assert np.abs(expected).max() > 1.0
    force = virtual_forces(model, parameters, scene.node, scene.velocity, held, rate)
    np.testing.assert_allclose(force, expected, atol=1e-5)
    at_rest = virtual_forces(model, parameters, scene.node, scene.velocity, held)
    still = parameters.replace(use_control_velocity=False)
    np.testing.assert_array_equal(
        at_rest, virtual_forces(model, still, scene.node, scene.velocity, held, rate)
    )
    assert np.abs(at_rest - force).max() > 0.1


def test_an_object_that_nothing_holds_feels_nothing():
    model, parameters = as_model(bare_scene([[0.0, 0, 0], [1, 0, 0]]))
    none = np.zeros((0, 3))
    assert not virtual_forces(
        model, parameters, model.object_node, model.initial_velocity, none, none
    ).any()


def test_strain_and_tension_of_three_springs_that_were_computed_by_hand():
    # Nodes 1 m apart; the object springs are stretched by 25 % and squeezed by 20 %, the virtual
    # one (written control first) is stretched by 50 %.
    scene = bare_scene(
        [[0.0, 0, 0], [1.0, 0, 0], [1.0, 2.0, 0]],
        springs=[(0, 1), (2, 1), (3, 0)],
        rest=[0.8, 2.5, 0.4],
        stiffness=[10.0, 20.0, 30.0],
        damping=[3.0, 5.0, 7.0],
    )
    control = np.array([[0.0, 0.0, 0.6]])
    model, parameters = as_model(replace(scene, control=np.stack([control] * 2)))
    np.testing.assert_allclose(
        spring_strains(model, model.object_node, control), [0.25, -0.2, 0.5], rtol=1e-6
    )
    velocity = np.array([[0.0, 0, 0.1], [2.0, 1.0, 0], [0, 0, 0]])
    tension = spring_tensions(
        model, parameters, model.object_node, velocity, control, np.array([[9.0, 0, 0.3]])
    )
    # 10·0.25 + 3·2 as node 1 flees; -20·0.2 - 5·1 as it nears node 2; 30·0.5 + 7·(0.3 - 0.1).
    np.testing.assert_allclose(tension, [8.5, -9.0, 16.4], rtol=1e-6)
    # The middle node ends two object springs; the virtual spring counts for none.
    np.testing.assert_allclose(node_means(model, tension), [8.5, -0.25, -9.0], rtol=1e-6)


def test_tensions_add_up_to_the_oracle_s_forces():
    scene = cube_scene()
    model, parameters = as_model(scene)
    held, rate = scene.control[2], (scene.control[2] - scene.control[1]) * 30.0
    tension = spring_tensions(model, parameters, scene.node, scene.velocity, held, rate)
    point = np.vstack([scene.node, held])
    first, second = model.spring_nodes.T
    along = point[second] - point[first]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    force = np.zeros_like(point)
    np.add.at(force, first, tension[:, None] * along)
    np.add.at(force, second, -tension[:, None] * along)
    moving = point, np.vstack([scene.velocity, rate])
    expected = spring_force(scene, incidence(scene, len(point)), *moving)
    assert np.abs(expected[:8]).max() > 1.0
    np.testing.assert_allclose(force[:8], expected[:8], atol=1e-4)


def test_a_node_without_object_springs_has_no_mean():
    model, _ = as_model(bare_scene([[0.0, 0, 0], [1, 0, 0]]))
    assert np.isnan(node_means(model, np.zeros(0))).all()


@pytest.mark.parametrize("changes", [{}, {"hand_friction": 2.0}, {"gravity": 9.81}])
def test_pushes_are_the_oracle_s_with_the_triangles_of_the_frame_s_start(changes):
    scene, beside = pressed_scene(**changes), []
    position, velocity = simulate(scene, beside=beside)
    model, parameters = as_model(scene)
    count, held = len(scene.node), scene.control[3]
    state = position[3], velocity[3], held, (held - scene.control[2]) * 30.0
    points = np.vstack([state[0], held]), np.vstack([state[1], state[3]])
    force = spring_force(scene, incidence(scene, len(points[0])), *points)[:count]
    expected = pushes(scene, beside[2], state[:2], force, held, state[3])
    start = position[2], scene.control[2]
    face, push = push_forces(model, parameters, state, held, start)
    is_pushed = expected.any(axis=1)
    assert is_pushed.sum() > 2
    assert np.abs(expected).max() > 50.0
    np.testing.assert_allclose(push, expected, atol=1e-6)
    np.testing.assert_array_equal(face[is_pushed], beside[2][0][is_pushed])
    assert (face[~is_pushed] == -1).all()
    # Triangles that were found later are others.
    later = push_forces(model, parameters, state, held, (position[3], held))[1]
    assert np.abs(later - push).max() > 1.0
