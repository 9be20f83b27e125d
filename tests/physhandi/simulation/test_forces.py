"""Force arrows against a hand-computed spring and against the oracle."""

from dataclasses import replace

import numpy as np
from reference.scenes import as_model, bare_scene, cube_scene
from reference.spring_mass import spring_force

from physhandi.simulation.forces import virtual_forces


def test_one_virtual_spring_pulls_with_strain_and_closing_speed():
    scene = bare_scene(
        [[0.0, 0, 0], [5.0, 0, 0]], springs=[(2, 0)], rest=[0.5], stiffness=[10.0], damping=[3.0]
    )
    model, parameters = as_model(replace(scene, control=np.array([[[0.0, 0.0, 0.6]]] * 2)))
    force = virtual_forces(
        model,
        replace(parameters, stiffness_scale=2.0),
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
    expected = spring_force(replace(scene, **only), *everything)[:8]
    assert np.abs(expected).max() > 1.0
    force = virtual_forces(model, parameters, scene.node, scene.velocity, held, rate)
    np.testing.assert_allclose(force, expected, atol=1e-5)
    at_rest = virtual_forces(model, parameters, scene.node, scene.velocity, held)
    still = replace(parameters, use_control_velocity=False)
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
