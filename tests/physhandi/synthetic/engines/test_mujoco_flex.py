"""MuJoCo's bodies and hands against closed forms, and that friction alone holds."""

from dataclasses import replace

import numpy as np
import pytest
from support.physics.grippers import Gripper, PinchAndLift

from physhandi.errors import CancelledError, SimulationDivergedError, UsageError
from physhandi.progress import Progress
from physhandi.synthetic.bodies.bodies import Body, make_body
from physhandi.synthetic.engines.flex_scene import FlexParameters
from physhandi.synthetic.engines.mujoco_flex import simulate_truth

pytest.importorskip("mujoco")

GRAVITY = 9.81


def block(size=0.03, height=0.0):
    """A cube of six tetrahedra, just above the ground."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    elements = np.array(
        [[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]]
    )
    radius = 0.002
    node = (corner - [0.5, 0.5, 0.0]) * size + [0.0, 0.0, radius + height]
    return Body(
        name="plush",
        node=node,
        elements=elements,
        faces=np.array([[0, 1, 3]]),
        surface_node_count=8,
        size=(size, size, size),
        stiffness=2e5,
        element_stiffness=np.ones(6),
        poisson=0.2,
        thickness=0.0,
        radius=radius,
        mass=0.02,
    )


def grasp(block_size=0.03, *, squeeze=0.006, height=0.08):
    gripper = Gripper(gap=block_size + 0.006)
    return gripper, PinchAndLift((0.0, 0.0, 0.018), squeeze, height)


def lift(parameters=None, *, hold="friction", frame_count=34):
    gripper, script = grasp()
    return simulate_truth(
        block(),
        [script],
        {"right": gripper},
        frame_count=frame_count,
        hold=hold,
        parameters=parameters or FlexParameters(settling_time=0.1),
    )


@pytest.fixture(scope="module")
def held():
    return lift()


def test_what_nothing_holds_falls_as_galilei_says():
    parameters = FlexParameters(settling_time=1 / 30, substeps_per_frame=10)
    body = block(height=0.5)
    truth = simulate_truth(body, [], {}, frame_count=5, parameters=parameters)
    assert truth.position.shape == (5, 8, 3)
    step = 1 / 300
    for frame, position in enumerate(truth.position):
        count = 10 * (frame + 1)
        drop = GRAVITY * step**2 * count * (count + 1) / 2
        np.testing.assert_allclose(body.node[:, 2] - position[:, 2], drop, rtol=1e-4)
    assert not truth.contact.any()


def test_the_ground_bears_a_body():
    body = block(height=0.002)
    truth = simulate_truth(body, [], {}, frame_count=8)
    rest = truth.position[-1, :, 2].min() - body.radius
    assert -5e-4 < rest < 1e-4
    assert np.abs(truth.position[-1] - truth.position[-2]).max() < 1e-5


def test_friction_alone_holds_what_is_lifted(held):
    first = held.contact[10]
    assert set(np.flatnonzero(first)) == set(range(8))
    rise = held.position[-1, :, 2] - held.position[0, :, 2]
    assert rise.min() > 0.8 * 0.08
    assert rise.max() < 1.1 * 0.08
    assert held.hold == "friction"


def test_without_friction_the_same_hand_lifts_nothing():
    slippery = lift(FlexParameters(settling_time=0.1, hand_friction=1e-3, bone_mass=0.15))
    assert slippery.contact[9].any()
    assert np.abs(slippery.position[-1, :, 2] - slippery.position[0, :, 2]).max() < 0.02


def test_contact_is_told_from_the_frame_in_which_it_begins(held):
    gripper, script = grasp()
    left = held.position[:, :4, 0].min(axis=1)
    face = [
        gripper.bone_transforms(script.at(frame / 30))[0, 0, 3] - gripper.gap / 2
        for frame in range(len(left))
    ]
    distance = left - held.body.radius - np.array(face)
    touched = held.contact[:, :4].any(axis=1)
    assert not touched[0]
    assert touched[8:].all()
    begin = int(np.argmax(touched))
    assert distance[begin - 2] > 0
    assert distance[begin + 1] < 5e-4


def test_a_hand_that_passes_by_touches_nothing():
    truth = simulate_truth(
        block(),
        [PinchAndLift((0.0, 0.0, 0.2), 0.006, 0.05)],
        {"right": Gripper(gap=0.036)},
        frame_count=6,
        parameters=FlexParameters(settling_time=0.1),
    )
    assert not truth.contact.any()
    assert np.ptp(truth.position, axis=0).max() < 1e-4


def test_what_was_touched_for_a_while_sticks_if_it_shall():
    parameters = FlexParameters(settling_time=0.1, hand_friction=1e-3)
    truth = lift(parameters, hold="attachment")
    rise = truth.position[-1, :, 2] - truth.position[0, :, 2]
    assert rise.min() > 0.8 * 0.08
    assert truth.contact[-1].all()
    begin = np.argmax(truth.contact, axis=0)
    assert all(truth.contact[b:, node].all() for node, b in enumerate(begin))


def test_hands_are_told_where_they_gave_way_to_what_they_hold(held):
    gripper, script = grasp()
    assert list(held.hands) == ["right"]
    assert held.hands["right"].shape == (34, 2, 4, 4)
    asked = gripper.bone_transforms(script.at(20 / 30))
    given = held.hands["right"][20]
    left, right = held.position[20, :4, 0].mean(), held.position[20, 4:, 0].mean()
    radius = held.body.radius
    # The script closes the jaws to 5 mm within the block; they stay outside of it.
    assert asked[0, 0, 3] - gripper.gap / 2 > left - radius + 0.003
    assert given[0, 0, 3] - gripper.gap / 2 == pytest.approx(left - radius, abs=7e-4)
    assert given[1, 0, 3] + gripper.gap / 2 == pytest.approx(right + radius, abs=7e-4)
    # Up and down nothing holds them back.
    np.testing.assert_allclose(given[:, 2, 3], asked[:, 2, 3], atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(given[:, :3, :3]), 1.0, atol=1e-9)
    assert held.hands["right"][33, :, 2, 3].min() > 0.09


def test_the_same_input_gives_the_same_bits(held):
    again = lift(frame_count=14)
    assert held.position[:14].tobytes() == again.position.tobytes()
    assert held.contact[:14].tobytes() == again.contact.tobytes()
    assert np.ptp(again.position, axis=0).max() > 1e-4


def test_a_stiffer_core_gives_way_less():
    soft = block()
    stiff = replace(soft, element_stiffness=np.full(6, 8.0))
    parameters = FlexParameters(settling_time=0.1)

    def narrowed(body):
        gripper, script = grasp(height=0.0)
        truth = simulate_truth(
            body, [script], {"right": gripper}, frame_count=12, parameters=parameters
        )
        width = truth.position[:, 4:, 0].mean(axis=1) - truth.position[:, :4, 0].mean(axis=1)
        return width[0] - width[-1]

    assert narrowed(soft) > 2 * narrowed(stiff) > 0


@pytest.mark.parametrize("name", ["cloth", "rope", "plush"])
def test_a_body_rests_where_it_was_laid(name):
    body = make_body(name, np.random.default_rng(0), resolution="tiny")
    truth = simulate_truth(
        body, [], {}, frame_count=2, parameters=FlexParameters(settling_time=0.1)
    )
    assert np.abs(truth.position[1] - truth.position[0]).max() < 5e-3
    assert truth.position[-1, :, 2].min() > 0.5 * body.radius
    assert np.ptp(truth.position[-1, :, 2]) >= 0.8 * body.size[2]


def test_a_torn_body_is_told_with_its_frame():
    gripper, script = grasp(height=40.0)
    with pytest.raises(SimulationDivergedError, match=r"plush was torn in frame \d+") as caught:
        simulate_truth(
            block(),
            [replace(script, end=0.5)],
            {"right": gripper},
            frame_count=20,
            hold="attachment",
            parameters=FlexParameters(settling_time=0.1),
        )
    assert 9 <= caught.value.frame <= 15
    assert 0 <= caught.value.node < 8


def test_frames_are_reported_and_work_stops_when_asked():
    class Impatient(Progress):
        def __init__(self):
            self.seen = []

        def report(self, stage, iteration, total, loss=None, message=""):
            self.seen.append((stage, iteration, total, message))

        def check_cancelled(self):
            if len(self.seen) == 2:
                raise CancelledError("stopped")

    progress = Impatient()
    with pytest.raises(CancelledError):
        simulate_truth(block(), [], {}, frame_count=5, progress=progress)
    assert progress.seen == [("simulate", 1, 5, "plush"), ("simulate", 2, 5, "plush")]


def test_nonsense_is_refused():
    with pytest.raises(UsageError, match="1 frame or more, not 0"):
        simulate_truth(block(), [], {}, frame_count=0)
    with pytest.raises(UsageError, match="right hand"):
        simulate_truth(block(), [grasp()[1]], {}, frame_count=3)
