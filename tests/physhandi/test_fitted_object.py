import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file, save_file
from support.physics.hanging_node import hanging_node
from support.viewer.viewer_world import PARAMETERS, make_run

from app.settings import BUNDLED
from physhandi.data.layout import SequenceFiles
from physhandi.errors import RunError, UsageError
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import ObjectRollout, load_fitted, load_surface
from physhandi.run import Run
from physhandi.simulation.edits import Release
from physhandi.simulation.forces import spring_strains
from physhandi.simulation.restart import SHORTEST_SHARE, Restart
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import retopologize


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    return make_run(tmp_path_factory.mktemp("runs") / "sheet")


@pytest.fixture
def fitted(run) -> FittedObject:
    return FittedObject.of(run, "lift")


@pytest.mark.parametrize(
    ("field", "factor", "own", "virtual", "damping"),
    [
        ("stiffness", 0.5, 0.5, 1.0, 1.0),
        ("virtual_stiffness", 3.0, 1.0, 3.0, 1.0),
        ("damping", 4.0, 1.0, 1.0, 4.0),
    ],
)
def test_material_is_scaled_for_its_own_springs_alone(
    fitted, field, factor, own, virtual, damping
) -> None:
    was = fitted.begin(PARAMETERS).model
    count = was.object_spring_count
    assert 0 < count < len(was.stiffness)
    now = fitted.begin(PARAMETERS.replace(**{field: factor * getattr(PARAMETERS, field)})).model
    np.testing.assert_allclose(now.stiffness[:count], own * was.stiffness[:count], rtol=1e-6)
    np.testing.assert_allclose(now.stiffness[count:], virtual * was.stiffness[count:], rtol=1e-6)
    np.testing.assert_allclose(now.damping, damping * was.damping, rtol=1e-6)


def test_material_is_what_a_run_of_its_own_would_get(fitted, run) -> None:
    changed = PARAMETERS.replace(stiffness=90.0, virtual_stiffness=7000.0, damping=11.0)
    now = fitted.begin(changed).model
    model, control = fitted.model, run.array("sequences/lift/control.npy")
    rest = run.tensors("object/material.safetensors")["rest_node"]
    anew = retopologize(model, changed, control[0], fitted=PARAMETERS, rest_node=rest)
    np.testing.assert_array_equal(now.spring_nodes, anew.spring_nodes)
    np.testing.assert_allclose(now.stiffness, anew.stiffness, rtol=1e-5)
    np.testing.assert_allclose(now.damping, anew.damping, rtol=1e-5)


def test_the_world_is_that_of_the_sequence(tmp_path: Path) -> None:
    run = make_run(tmp_path / "moon")
    meta = run.out / "sequences/lift/meta.yaml"
    content = yaml.safe_load(meta.read_text())
    content |= {"frame_rate": 60.0, "gravity": 1.62, "ground_height": None}
    meta.write_text(yaml.safe_dump(content))
    for name, world in (("lift", (60.0, None, 1.62)), ("drag", (30.0, 0.0, 9.81))):
        take = load_fitted(run, name)
        assert take is not None
        found = take.parameters
        assert (found.frame_rate, found.ground_height, found.gravity) == world


AT = 14
STRENGTH = 2.0
"""Tension at which most grips of the run slip [N]."""


@pytest.fixture(scope="module")
def restarted(tmp_path_factory) -> Run:
    """A run whose object is seen 7 mm beside and below its rollout at the last fitted frame."""
    run = make_run(tmp_path_factory.mktemp("restarted") / "sheet")
    state = run.array("sequences/lift/rollout.npy")[AT].copy()
    noise = np.random.default_rng(8).normal(0.0, 0.0003, state.shape)
    state += (np.array([0.004, 0.003, -0.005]) + noise).astype(np.float32)
    still = np.zeros_like(state)
    restart = Restart(frame=AT, position=state, velocity=still)
    save_file(restart.to_tensors(), run.out / SequenceFiles("lift").restart)
    return run


@pytest.mark.parametrize("change", [{}, {"stiffness": 90.0}, {"connection_radius": 0.04}])
def test_every_simulation_of_the_sequence_restarts_with_the_strain_it_had(
    run, restarted, change
) -> None:
    plain = FittedObject.of(run, "lift").simulate(**change)
    rollout = FittedObject.of(restarted, "lift").simulate(**change)
    assert rollout.restart is not None
    seen, control = rollout.restart.position, rollout.control[AT]
    np.testing.assert_array_equal(rollout.position[: AT + 1], plain.position[: AT + 1])
    assert rollout.frame_distance(plain, AT + 1) > 0.003
    later = rollout.model_in(AT + 1)
    assert rollout.model_in(AT) is rollout.model
    one_frame = Simulator(later, rollout.parameters)
    one_frame.reset(seen, rollout.restart.velocity)
    one_frame.step_frame(AT + 1, control, rollout.control[AT + 1])
    np.testing.assert_array_equal(rollout.position[AT + 1], one_frame.position.numpy())
    assert np.abs(later.rest_length / rollout.model.rest_length - 1).max() > 0.01
    # Other springs leave the object far from where it was seen, and a few would become too short.
    is_kept = later.rest_length > (SHORTEST_SHARE + 1e-3) * rollout.model.rest_length
    assert is_kept.mean() > (0.9 if "connection_radius" in change else 0.999)
    strains = spring_strains(later, seen, control)
    np.testing.assert_allclose(strains[is_kept], rollout.strains(AT)[is_kept], atol=2e-6)
    expected = spring_strains(later, rollout.position[AT + 1], rollout.control[AT + 1])
    np.testing.assert_array_equal(rollout.strains(AT + 1), expected)
    assert np.abs(plain.tensions(AT + 1) - rollout.tensions(AT + 1)).max() > 1e-3


def restarting_otherwise(source: Run, folder: Path, **changes: Any) -> Run:
    """Copy a run and change its restart."""
    shutil.copytree(source.folder, folder)
    run = Run.open(folder)
    path = run.out / SequenceFiles("lift").restart
    state = Restart.from_tensors(load_file(path))
    save_file(replace(state, **changes).to_tensors(), path)
    return run


@pytest.fixture(scope="module")
def shifted(restarted, tmp_path_factory) -> Run:
    """The same, where springs go on beside where nodes are seen."""
    folder = tmp_path_factory.mktemp("shifted") / "sheet"
    return restarting_otherwise(restarted, folder, shifts_nodes=True, strain_frames=3)


@pytest.fixture(scope="module")
def slipping(shifted, tmp_path_factory) -> Run:
    """The same, where most grips slip."""
    folder = tmp_path_factory.mktemp("slipping") / "sheet"
    return restarting_otherwise(shifted, folder, grip_strength=STRENGTH)


def test_springs_of_every_frame_are_those_that_are_left_when_grips_have_slipped(
    shifted, slipping
) -> None:
    firm, rollout = (FittedObject.of(each, "lift").simulate() for each in (shifted, slipping))
    assert rollout.restart is not None
    assert rollout.restart.grip_strength == pytest.approx(STRENGTH)
    np.testing.assert_array_equal(rollout.position[: AT + 2], firm.position[: AT + 2])
    assert rollout.frame_distance(firm, rollout.ready - 1) > 1e-4
    own = rollout.model.object_spring_count
    last = rollout.ready - 1
    # Frames may be asked for in any order.
    springs = {frame: rollout.model_in(frame) for frame in (last, AT + 1, *range(AT + 2, last))}
    for frame in range(AT + 1, last + 1):
        is_first = frame == AT + 1
        velocity = rollout.restart.velocity if is_first else rollout.velocity[frame - 1]
        one_frame = Simulator(springs[frame], rollout.parameters)
        one_frame.reset(rollout.sprung_nodes(frame - 1), velocity)
        one_frame.step_frame(frame, *rollout.control[frame - 1 : frame + 1])
        np.testing.assert_allclose(
            one_frame.position.numpy(), rollout.sprung_nodes(frame), atol=2e-6
        )
    lengths = np.stack([springs[frame].rest_length for frame in range(AT + 1, last + 1)])
    np.testing.assert_array_equal(lengths[:, :own], np.tile(lengths[0, :own], (len(lengths), 1)))
    assert (lengths[1:, own:] != lengths[:-1, own:]).any(axis=1).all()
    means = rollout.frame_means(lambda model, *_: model.rest_length)
    np.testing.assert_allclose(means[AT + 1 :], lengths, rtol=1e-5)
    arrays = rollout.restart_arrays()
    np.testing.assert_array_equal(arrays["restart_rest_length"], lengths[0])
    assert arrays["restart_grip_strength"] == pytest.approx([STRENGTH])
    np.testing.assert_array_less(arrays["restart_shortest"], rollout.model.rest_length + 1e-9)


def test_strain_and_force_are_those_of_springs_beside_the_nodes(run, shifted) -> None:
    plain, rollout = (FittedObject.of(each, "lift").simulate() for each in (run, shifted))
    assert rollout.restart is not None
    own = rollout.position[AT]
    np.testing.assert_array_equal(own, plain.position[AT])
    shift = rollout.restart.position - own
    assert np.linalg.norm(shift, axis=1).min() > 0.005
    later = rollout.model_in(AT + 1)
    beside = Simulator(later, rollout.parameters)
    beside.reset(own, rollout.restart.velocity)
    beside.step_frame(AT + 1, rollout.control[AT], rollout.control[AT + 1])
    place = beside.position.numpy()
    np.testing.assert_allclose(rollout.position[AT + 1], place + shift, atol=1e-7)
    np.testing.assert_allclose(rollout.sprung_nodes(AT + 1), place, atol=1e-7)
    np.testing.assert_array_equal(rollout.sprung_nodes(AT), own)
    control = rollout.control[AT + 1]
    np.testing.assert_allclose(
        rollout.strains(AT + 1), spring_strains(later, place, control), atol=3e-6
    )
    # Where they are seen, springs to the hand would be strained by a tenth more or less.
    seen = spring_strains(later, rollout.position[AT + 1], control)
    assert np.abs(rollout.strains(AT + 1) - seen).max() > 0.1
    moment, _, _, _ = rollout.state(AT + 1)
    np.testing.assert_allclose(moment, place, atol=1e-7)
    lengths = rollout.frame_means(lambda _model, _parameters, node, *_: node)
    np.testing.assert_allclose(lengths[AT + 1], 0.5 * (own + place), atol=2e-3)
    assert np.abs(lengths[AT + 1] - 0.5 * (own + place) - shift).min() > 2e-4
    arrays = rollout.restart_arrays()
    np.testing.assert_array_equal(arrays["restart_node_shift"], shift)
    np.testing.assert_array_equal(arrays["restart_position"], rollout.restart.position)


@pytest.mark.parametrize("frame", [AT + 1, 17])
def test_a_rollout_goes_on_from_where_shifted_nodes_are_seen(shifted, frame: int) -> None:
    rollout = FittedObject.of(shifted, "lift").simulate()
    model, (position, velocity) = rollout.going_on(frame)
    np.testing.assert_array_equal(position, rollout.position[frame])
    np.testing.assert_array_equal(velocity, rollout.state(frame)[1])
    strains = spring_strains(model, position, rollout.control[frame])
    is_kept = model.rest_length > (SHORTEST_SHARE + 1e-3) * rollout.model_in(frame).rest_length
    assert is_kept.mean() > 0.99
    np.testing.assert_allclose(strains[is_kept], rollout.strains(frame)[is_kept], atol=3e-6)
    lengths = model.rest_length / rollout.model_in(frame).rest_length
    assert np.abs(lengths - 1.0).max() > 0.01


@pytest.mark.parametrize("strength", [0.0, STRENGTH], ids=["firm", "slipping"])
@pytest.mark.parametrize("frame", [0, 5, AT, AT + 1, 17])
def test_a_rollout_goes_on_from_any_frame_as_it_went_on(
    restarted, frame: int, strength: float
) -> None:
    rollout = FittedObject.of(restarted, "lift").simulate()
    assert rollout.restart is not None
    if strength:
        restart = replace(rollout.restart, grip_strength=strength, friction_share=0.5)
        simulator = Simulator(rollout.model, rollout.parameters)
        motion = simulator.rollout(rollout.control, restart)
        assert np.abs(motion.position - rollout.position).max() > 1e-4
        state = {"position": motion.position, "velocity": motion.velocity}
        rollout = replace(rollout, restart=restart, **state)
    model, state = rollout.going_on(frame)
    parameters = rollout.parameters_in(frame + 1)
    share = 0.5 if strength and frame >= AT else 1.0
    assert parameters.friction == share * rollout.parameters.friction
    simulator = Simulator(model, parameters)
    simulator.reset(*state)
    np.testing.assert_array_equal(simulator.position.numpy(), rollout.position[frame])
    simulator.step_frame(1, rollout.control[frame], rollout.control[frame + 1])
    is_same = np.array_equal(simulator.position.numpy(), rollout.position[frame + 1])
    # After the restart's own frame the rollout goes on from what was observed, not from itself.
    assert is_same == (frame != AT)


def test_a_rollout_goes_on_with_the_springs_that_are_attached(run) -> None:
    rollout = FittedObject.of(run, "lift").simulate()
    attached = rollout.model.attached.copy()
    attached[:10], attached[10:20], attached[20:] = [0, 3], [3, 9], [9, 99]
    late = replace(rollout, model=replace(rollout.model, attached=attached))
    own = rollout.model.object_spring_count
    for frame, held in ((2, slice(0, 10)), (3, slice(10, 20)), (9, slice(20, None))):
        model, _ = late.going_on(frame)
        expected = np.zeros_like(rollout.model.stiffness[own:])
        expected[held] = rollout.model.stiffness[own:][held]
        np.testing.assert_array_equal(model.stiffness[own:], expected)
        assert model.is_always_attached


def test_some_of_the_controls_restart_too(restarted) -> None:
    fitted = FittedObject.of(restarted, "lift")
    rollout = fitted.begin(PARAMETERS, controls=[3, 17, 4])
    for _ in fitted.fill(rollout):
        pass
    assert rollout.restart is not None
    assert rollout.control.shape[1] == 3
    strains = spring_strains(
        rollout.model_in(AT + 1), rollout.restart.position, rollout.control[AT]
    )
    np.testing.assert_allclose(strains, rollout.strains(AT), atol=2e-6)


def test_the_jump_at_a_restart_is_no_velocity(restarted) -> None:
    stored = FittedObject.of(restarted, "lift").fitted
    assert stored.restart is not None
    rate = PARAMETERS.frame_rate
    step = stored.position[AT + 1] - stored.restart.position
    np.testing.assert_allclose(stored.state(AT + 1)[1], rate * step, rtol=1e-5, atol=1e-6)
    step = stored.position[AT + 2] - stored.position[AT + 1]
    np.testing.assert_allclose(stored.state(AT + 2)[1], rate * step, rtol=1e-5, atol=1e-6)


def test_what_is_exported_tells_the_springs_after_a_restart(restarted, tmp_path: Path) -> None:
    rollout = FittedObject.of(restarted, "lift").simulate()
    with np.load(rollout.export(tmp_path / "motion.npz")) as arrays:
        assert arrays["restart_frame"].tolist() == [AT]
        np.testing.assert_array_equal(arrays["restart_position"], rollout.restart.position)
        later = rollout.model_in(AT + 1).rest_length
        np.testing.assert_array_equal(arrays["restart_rest_length"], later)
    rollout.ready = AT
    assert rollout.restart_arrays() == {}


def test_tension_is_averaged_over_what_lies_between_frames() -> None:
    omega, gravity, rate = 2 * np.pi * 40.0, 9.81, 30.0
    rollout = hanging_node(stiffness=np.array([0.1 * omega**2], np.float32))
    simulator = Simulator(rollout.model, rollout.parameters)
    for frame, position, velocity in simulator.frames(rollout.control):
        rollout.position[frame], rollout.velocity[frame] = position, velocity
    rollout.ready = rollout.frame_count
    # From its rest length, the node swings about where the spring bears it.
    time = np.arange(rollout.frame_count) / rate
    moment = gravity * (1 - np.cos(omega * time))
    mean = gravity * (1 - rate / omega * np.diff(np.sin(omega * time)))
    shown = np.array([float(rollout.tensions(frame)[0]) for frame in range(rollout.ready)])
    np.testing.assert_allclose(shown, moment, atol=0.8)
    found = rollout.mean_tensions()
    assert found.shape == (rollout.ready, 1)
    assert found[0, 0] == pytest.approx(shown[0])
    np.testing.assert_allclose(found[1:, 0], mean, atol=0.3)
    assert np.std(shown) > 6.0
    assert np.std(found[1:]) < 1.5
    pull = rollout.mean_forces()
    np.testing.assert_allclose(pull[:, 0], found * np.array([0.0, 0.0, 1.0]), atol=1e-5)
    np.testing.assert_array_equal(pull[:, 1], 0.0)


def test_averages_are_taken_on_the_way_of_the_rollout_also_after_a_restart(restarted) -> None:
    rollout = FittedObject.of(restarted, "lift").simulate()
    moments = []

    def remember(model, parameters, position, velocity, control, moved) -> np.ndarray:
        assert parameters is rollout.parameters
        moments.append((position.copy(), control))
        return model.rest_length

    found = rollout.frame_means(remember)
    for frame in (1, AT, AT + 1, rollout.ready - 1):
        expected = rollout.model_in(frame).rest_length
        np.testing.assert_allclose(found[frame], expected, rtol=1e-6)
    count = (len(moments) - 1) // (rollout.ready - 1)
    assert count - 1 >= 8
    for frame in range(1, rollout.ready):
        begin, end = moments[1 + count * (frame - 1)], moments[count * frame]
        seen = rollout.restart.position if frame == AT + 1 else rollout.position[frame - 1]
        np.testing.assert_allclose(begin[0], seen, atol=2e-5)
        np.testing.assert_allclose(end[0], rollout.position[frame], atol=2e-5)
        np.testing.assert_array_equal(end[1], rollout.held_control(frame))


def test_only_the_sequence_that_was_observed_restarts(run, restarted) -> None:
    assert FittedObject.of(restarted, "drag").fitted.restart is None
    old = FittedObject.of(run, "lift")
    assert old.begin(PARAMETERS).restart is None
    assert old.fitted.model_in(19) is old.model


def test_a_damaged_restart_is_named(restarted, tmp_path: Path) -> None:
    run = make_run(tmp_path / "sheet")
    tensors = FittedObject.of(restarted, "lift").fitted.restart.to_tensors()
    shorter = {name: array[:5] for name, array in tensors.items()}
    save_file(shorter, run.out / SequenceFiles("lift").restart)
    with pytest.raises(RunError, match=r"restart\.safetensors.*position has 5 nodes"):
        FittedObject.of(run, "lift")


def test_hands_push_what_they_do_not_hold() -> None:
    """A run that was stored before hands could push has their triangles beside its model."""
    object_ = FittedObject.of(BUNDLED / "runs" / "towel_fold_quick")
    model, hand = object_.model, object_.scene().hands["right"]
    np.testing.assert_array_equal(model.hand_face, hand.face)
    np.testing.assert_allclose(object_.fitted.control[7], hand.vertex[7], atol=1e-6)
    # The hand goes 2 cm lower than it did, into a towel that it does not hold.
    control = object_.fitted.control[:25] - np.float32([0.0, 0.0, 0.02])
    low = FittedObject(ObjectRollout.empty(model, object_.parameters, control))
    free = [Release(nodes=tuple(range(model.node_count)))]
    still = low.simulate(edits=free)
    pushed = low.simulate(edits=free, hand_pushes=True)
    lying = still.position[-1] - still.position[0]
    assert np.linalg.norm(lying[:, :2], axis=1).max() < 0.005
    moved = np.linalg.norm(pushed.position[-1] - still.position[-1], axis=1)
    assert 0.02 < moved.max() < 0.08
    # What is far from the hand stays.
    assert np.quantile(moved, 0.25) < 0.005


def test_hands_without_a_surface_cannot_push(fitted) -> None:
    with pytest.raises(UsageError, match="hand_pushes needs the surface of a hand"):
        fitted.simulate(hand_pushes=True)


def test_the_surface_has_the_colors_of_the_first_frame(tmp_path: Path) -> None:
    """A teal towel of 18 by 13 cm; its free end has a wide and a narrow white stripe."""
    run = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    fitted = load_fitted(run, "towel_fold")
    surface = load_surface(run, fitted, BUNDLED / "towel_fold")
    vertex = surface.place(fitted.position[0])
    far = vertex[:, 0].max() - vertex[:, 0]
    for low, high, color in (
        (0.0, 0.002, (49, 136, 152)),
        (0.025, 0.03, (242, 238, 214)),
        (0.045, 0.12, (49, 136, 152)),
    ):
        found = surface.color[(far >= low) & (far <= high)]
        np.testing.assert_allclose(np.median(found, axis=0), color, atol=6)
    # Without the recording it is the same surface in no color.
    plain = load_surface(run, fitted, tmp_path / "gone")
    assert plain.color is None
    np.testing.assert_array_equal(
        plain.place(fitted.position[9]), surface.place(fitted.position[9])
    )
