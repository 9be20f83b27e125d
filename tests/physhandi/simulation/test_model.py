"""Parameters and models survive being stored, and refuse nonsense by name."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, cube_scene
from safetensors.numpy import load, save

from physhandi.errors import UsageError
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


def test_parameters_survive_a_round_trip():
    parameters = SimulationParameters(
        stiffness=123.0, ground_height=None, use_control_velocity=False
    )
    assert SimulationParameters.from_dict(parameters.to_dict()) == parameters
    assert SimulationParameters.from_dict({}) == SimulationParameters()


def test_parameters_stored_before_self_collision_existed_still_load():
    stored = SimulationParameters(drag=2.0).to_dict()
    for name in ("self_collision", "collision_distance", "self_restitution", "self_friction"):
        del stored[name]
    del stored["collides_rest_neighbors"]
    assert SimulationParameters.from_dict(stored) == SimulationParameters(drag=2.0)
    assert not SimulationParameters.from_dict(stored).self_collision


def test_a_substep_is_a_667th_of_a_frame():
    assert SimulationParameters().dt == pytest.approx(4.9975e-5, rel=1e-4)


def test_a_frame_can_last_longer_than_the_recording_says():
    parameters = SimulationParameters(frame_rate=30.0, frame_duration=0.03335)
    assert parameters.dt == pytest.approx(5e-5, rel=1e-9)
    assert parameters.simulated_frame_rate == pytest.approx(29.985007, rel=1e-7)
    again = SimulationParameters.from_dict(parameters.to_dict())
    assert again == parameters
    assert SimulationParameters.from_dict({"frame_duration": None}).simulated_frame_rate == 30.0


def test_a_world_is_taken_over_as_far_as_the_parameters_let_it():
    world = {"frame_rate": 60.0, "ground_height": None, "gravity": 1.62}
    moon = SimulationParameters().in_world(**world)
    assert (moon.frame_rate, moon.ground_height, moon.gravity) == (60.0, None, 1.62)
    assert moon.dt == pytest.approx(1.0 / (60.0 * 667))
    own = SimulationParameters(gravity=9.8, uses_sequence_gravity=False, frame_duration=0.03335)
    own = own.in_world(**world)
    assert (own.frame_rate, own.ground_height, own.gravity) == (60.0, None, 9.8)
    assert own.dt == pytest.approx(5e-5)
    raised = SimulationParameters(ground_height=0.2, uses_sequence_ground=False).in_world(
        frame_rate=60.0, ground_height=0.5, gravity=1.62
    )
    assert (raised.ground_height, raised.gravity) == (0.2, 1.62)


@pytest.mark.parametrize(
    ("drag", "decay"),
    [(0.0, 1.0), (1.0, 0.999950051), (3.0, 0.999849975), (12.0, 0.999400139), (20.0, 0.999000549)],
)
def test_whole_drags_decay_as_a_gpu_rounds_them(drag, decay):
    # What float32 expf(-5e-5 drag) was on an H200; next to 1 a unit of float32 is 6e-8.
    rounded = SimulationParameters(drag=drag, frame_duration=0.03335, rounds_decay=True)
    assert 1.0 - rounded.velocity_loss() == np.float64(np.float32(decay))
    exact = rounded.replace(rounds_decay=False)
    assert exact.velocity_loss() == pytest.approx(1.0 - np.exp(-5e-5 * drag), rel=1e-9)
    assert exact.velocity_loss() == pytest.approx(rounded.velocity_loss(), abs=9e-8)


def test_other_drags_decay_by_the_nearest_float32():
    own = SimulationParameters(drag=3.0, frame_duration=0.03335, rounds_decay=True)
    for drag, of in ((2.5, own), (21.0, own), (3.0, own.replace(substeps_per_frame=500))):
        decay = 1.0 - of.velocity_loss(drag)
        assert decay == np.float64(np.float32(np.exp(-of.dt * drag)))


def test_whole_numbers_and_numpy_values_are_converted():
    parameters = SimulationParameters.from_dict(
        {"drag": 3, "max_neighbors": 12.0, "damping": np.float32(0.5)}
    )
    assert (type(parameters.drag), type(parameters.max_neighbors)) == (float, int)
    assert parameters.damping == 0.5


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stifness": 1.0}, "no simulation parameter 'stifness'. Do you mean 'stiffness'"),
        ({"stiffness": -1.0}, "stiffness is -1.0; expected a number from 0 to 100000000"),
        ({"friction": 2.1}, "friction is 2.1"),
        ({"drag": float("nan")}, "drag is nan"),
        ({"substeps_per_frame": 0}, "substeps_per_frame is 0"),
        ({"max_neighbors": 2.5}, "max_neighbors is 2.5; expected a whole number"),
        ({"damping": "much"}, "damping is 'much'; expected a number"),
        ({"gravity": None}, "gravity is empty"),
        ({"use_control_velocity": "no"}, "use_control_velocity is 'no'; expected true or false"),
        ({"self_collision": 1.0}, "self_collision is 1.0; expected true or false"),
        ({"self_restitution": 1.1}, "self_restitution is 1.1; expected a number from 0 to 1"),
        ({"collision_distance": -0.1}, "collision_distance is -0.1"),
        ({"frame_duration": 0.0}, "frame_duration is 0.0"),
        ({"rounds_decay": 1}, "rounds_decay is 1; expected true or false"),
    ],
)
def test_nonsense_is_refused_by_name(values, message):
    with pytest.raises(UsageError, match=message):
        SimulationParameters.from_dict(values)


def test_a_model_survives_safetensors():
    model, _ = as_model(cube_scene())
    again = SpringMassModel.from_tensors(load(save(model.to_tensors())))
    for name, value in model.to_tensors().items():
        np.testing.assert_array_equal(value, again.to_tensors()[name])
    assert (again.node_count, again.control_count, again.virtual_spring_count) == (8, 4, 5)


def test_a_model_stored_before_nodes_had_a_clearance_has_none():
    model, _ = as_model(cube_scene(clearance=np.full(8, 0.01)))
    tensors = model.to_tensors()
    assert np.array_equal(SpringMassModel.from_tensors(tensors).clearance, model.clearance)
    del tensors["clearance"]
    old = SpringMassModel.from_tensors(tensors)
    np.testing.assert_array_equal(old.clearance, np.zeros(8, np.float32))
    assert old.clearance.dtype == np.float32


def test_the_surface_of_hands_is_stored_if_there_is_one():
    model, _ = as_model(cube_scene())
    assert "hand_face" not in model.to_tensors()
    handed = replace(model, hand_face=np.int32([[0, 1, 2], [1, 3, 2]]))
    again = SpringMassModel.from_tensors(load(save(handed.to_tensors())))
    np.testing.assert_array_equal(again.hand_face, [[0, 1, 2], [1, 3, 2]])
    # Of control nodes 3, 1 and 2, in this order, one triangle is left.
    np.testing.assert_array_equal(handed.hand_face_of(np.array([3, 1, 2])), [[1, 0, 2]])


def test_a_model_without_one_of_its_arrays_is_refused():
    tensors = as_model(cube_scene())[0].to_tensors()
    del tensors["damping"]
    with pytest.raises(ValueError, match="needs the arrays attached, clearance"):
        SpringMassModel.from_tensors(tensors)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: {"rest_length": m.rest_length * 0}, "rest_length must be positive"),
        (lambda m: {"stiffness": m.stiffness * np.float32(np.nan)}, "stiffness has shape"),
        (lambda m: {"clearance": m.clearance + np.float32(np.inf)}, r"clearance has shape \(8,\)"),
        (lambda m: {"object_node": m.object_node * np.float32(np.inf)}, "object_node has shape"),
        (lambda m: {"spring_nodes": m.spring_nodes + np.int32(4)}, r"a node outside 0…11"),
        (lambda m: {"spring_nodes": m.spring_nodes * np.int32(0)}, "joins a node to itself"),
        (lambda _: {"object_spring_count": 30}, "object spring .* ends at a control node"),
        (lambda _: {"object_spring_count": 20}, "must join one object node and one control node"),
        (
            lambda _: {"object_spring_count": 99},
            "object_spring_count is 99, but there are 33 springs",
        ),
        (lambda _: {"hand_face": np.int32([[0, 1, 4]])}, r"hand_face .* outside 0…3"),
    ],
)
def test_an_inconsistent_model_is_refused(change, message):
    model, _ = as_model(cube_scene())
    with pytest.raises(ValueError, match=message):
        replace(model, **change(model))
