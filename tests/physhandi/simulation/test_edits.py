"""Edits of springs and nodes against an oracle that keeps springs in a plain list."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene
from reference.spring_mass import simulate

from physhandi.errors import UsageError
from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.edits import (
    MOST_EDITS,
    Attach,
    Cut,
    Join,
    Pin,
    Release,
    ScaleMaterial,
    apply_edits,
    checked_edits,
    decode_edits,
    encode_edits,
    keeps_what_is_joined,
)
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.rod import Rod
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.steering import POSE, SteeredHand, SteeredMotion

STIFFNESS, VIRTUAL, DAMPING, FLOOR = 30.0, 45.0, 1.5, 0.004
"""What springs get that are added."""
EDITS = (
    Cut(springs=((0, 1), (3, 2), (2, 7)), virtual=((5, 0),)),
    ScaleMaterial(quantity="stiffness", factor=0.25, springs=((0, 2), (6, 4)), virtual=((4, 0),)),
    ScaleMaterial(quantity="damping", factor=3.0, springs=((0, 2), (0, 1))),
    Join(springs=((1, 0), (0, 1), (0, 3))),
    Pin(nodes=(0, 6), places=((0.01, 0.0, 0.02), (0.0, 0.03, 0.05)), frame=1),
    Attach(nodes=(3, 4), controls=(2, 0), lengths=(0.03, 0.02), frame=1),
    Release(nodes=(6, 5), frame=2),
    ScaleMaterial(quantity="stiffness", factor=2.0, springs=((0, 1),)),
)


def by_hand(scene):
    """Make the same edits on a list of springs, each with the frames between which it acts."""
    count, controls = len(scene.node), scene.control.shape[1]
    springs = [
        [set(map(int, ends)), rest, stiffness, damping, 0, 99]
        for ends, rest, stiffness, damping in zip(
            scene.springs, scene.rest, scene.stiffness, scene.damping, strict=True
        )
    ]
    gone = [{0, 1}, {2, 3}, {2, 7}, {5, count}]
    springs = [spring for spring in springs if spring[0] not in gone]
    for spring in springs:
        spring[2] *= 0.25 if spring[0] in ({0, 2}, {4, 6}, {4, count}) else 1.0
        spring[3] *= 3.0 if spring[0] == {0, 2} else 1.0
    # Nodes 0 and 3 are joined already; the new one comes behind the object's own springs.
    own = sum(max(spring[0]) < count for spring in springs)
    length = np.linalg.norm(scene.node[1] - scene.node[0])
    springs.insert(own, [{0, 1}, length, 2.0 * STIFFNESS, DAMPING, 0, 99])
    usual = np.median([spring[1] for spring in springs[: own + 1]])
    short = max(FLOOR, 0.1 * usual)
    places = np.array([[0.01, 0.0, 0.02 + short], [0.0, 0.03, 0.05 + short]])
    springs.append([{0, count + controls}, short, VIRTUAL, DAMPING, 1, 99])
    springs.append([{6, count + controls + 1}, short, VIRTUAL, DAMPING, 1, 99])
    # Node 4 is tied to control 0 already.
    springs.append([{3, count + 2}, 0.03, VIRTUAL, DAMPING, 1, 99])
    for spring in springs:
        if max(spring[0]) >= count and min(spring[0]) in {5, 6}:
            spring[5] = 2
    pins = np.repeat(places[None], len(scene.control), axis=0)
    return replace(
        scene,
        springs=np.array([sorted(spring[0]) for spring in springs]),
        rest=np.array([spring[1] for spring in springs]),
        stiffness=np.array([spring[2] for spring in springs]),
        damping=np.array([spring[3] for spring in springs]),
        attached=np.array([spring[4:] for spring in springs]),
        control=np.concatenate([scene.control, pins], axis=1),
    )


def edited(scene, edits=EDITS):
    model, parameters = as_model(scene)
    parameters = parameters.replace(
        stiffness=STIFFNESS,
        virtual_stiffness=VIRTUAL,
        damping=DAMPING,
        virtual_rest_length_floor=FLOOR,
        rest_length_floor=0.0,
    )
    return model, apply_edits(model, edits, parameters), parameters


def test_an_edited_object_moves_as_the_oracle_whose_springs_were_edited_by_hand(device) -> None:
    scene = cube_scene()
    before, after, parameters = edited(scene)
    expected = by_hand(scene)
    assert np.sort(after.spring_nodes, axis=1).tolist() == expected.springs.tolist()
    np.testing.assert_allclose(after.rest_length, expected.rest, rtol=1e-6)
    np.testing.assert_allclose(after.stiffness, expected.stiffness, rtol=1e-6)
    np.testing.assert_allclose(after.damping, expected.damping, rtol=1e-6)
    virtual = expected.attached[after.object_spring_count :]
    assert np.minimum(after.attached, 99).tolist() == virtual.tolist()
    control = after.with_pins(scene.control.astype(np.float32))
    np.testing.assert_allclose(control, expected.control, atol=1e-8)
    np.testing.assert_array_equal(after.with_pins(control), control)
    position = Simulator(after, parameters, device).rollout(control).position
    np.testing.assert_allclose(position, simulate(expected)[0], atol=2e-7)
    unedited = Simulator(before, parameters, device).rollout(scene.control).position
    assert np.abs(position - unedited).max(axis=(1, 2))[1:].min() > 1e-4


def test_the_model_that_is_edited_stays_as_it_was_and_without_edits_is_the_one() -> None:
    scene = cube_scene()
    before, after, parameters = edited(scene)
    fresh, _ = as_model(scene)
    for name, value in before.to_tensors().items():
        np.testing.assert_array_equal(value, fresh.to_tensors()[name])
    assert apply_edits(before, (), parameters) is before
    assert "pin_place" not in before.to_tensors()
    again = SpringMassModel.from_tensors(after.to_tensors())
    np.testing.assert_array_equal(again.pin_place, after.pin_place)
    assert again.pin_count == 2
    with pytest.raises(ValueError, match="at most 1 control nodes"):
        replace(bare_model(), pin_place=np.zeros((2, 3), np.float32), control_count=1)
    with pytest.raises(ValueError, match="not finite"):
        replace(after, pin_place=np.full((2, 3), np.nan, np.float32))


def bare_model() -> SpringMassModel:
    return as_model(bare_scene([[0, 0, 0], [0.1, 0, 0]], None, [(0, 1)], [0.1], [50], [1]))[0]


def test_springs_mean_the_same_whatever_others_there_are() -> None:
    scene = cube_scene()
    kept = np.array([0, 2, 5, *range(20, len(scene.springs))])
    fewer = replace(
        scene,
        springs=scene.springs[kept],
        rest=scene.rest[kept],
        stiffness=scene.stiffness[kept],
        damping=scene.damping[kept],
    )
    pair = tuple(int(end) for end in scene.springs[5])
    absent = tuple(int(end) for end in scene.springs[6])
    edits = (ScaleMaterial(quantity="stiffness", factor=7.0, springs=(pair, absent)),)
    before, after, _ = edited(fewer, edits)
    ratio = after.stiffness / before.stiffness
    np.testing.assert_allclose(ratio, np.where(np.arange(len(kept)) == 2, 7.0, 1.0), rtol=1e-6)


def test_a_pinned_node_stays_while_the_others_fall(device) -> None:
    node = [[0, 0, 0.5], [0.1, 0, 0.5], [0.2, 0, 0.5]]
    scene = bare_scene(
        node,
        None,
        [(0, 1), (1, 2)],
        [0.1, 0.1],
        [200.0, 200.0],
        [5.0, 5.0],
        frames=31,
        gravity=9.81,
        drag=1.0,
        substeps=200,
    )
    model, parameters = as_model(scene)
    parameters = parameters.replace(virtual_stiffness=500.0, damping=5.0)
    pinned = apply_edits(model, (Pin(nodes=(0,), places=((0.0, 0.0, 0.5),)),), parameters)
    control = pinned.with_pins(np.zeros((31, 0, 3), np.float32))
    position = Simulator(pinned, parameters, device).rollout(control).position
    length = float(pinned.rest_length[-1])
    assert length == pytest.approx(0.01)
    # Three nodes of 1 kg hang on a spring of 500 N: it is longer by 6 % at rest.
    assert np.linalg.norm(position[:, 0] - model.object_node[0], axis=1).max() < 2.2 * length
    assert position[-1, 2, 2] < 0.35
    released = apply_edits(pinned, (Release(nodes=(0,), frame=15),), parameters)
    later = Simulator(released, parameters, device).rollout(control).position
    np.testing.assert_array_equal(later[:16], position[:16])
    assert later[-1, 0, 2] < 0.4
    assert apply_edits(pinned, (Release(nodes=(0,)),), parameters).virtual_spring_count == 0


def test_pins_stay_where_they_are_whatever_hand_is_steered() -> None:
    scene = cube_scene()
    _, after, parameters = edited(scene)
    control = after.with_pins(scene.control.astype(np.float32))[0]
    moving = np.arange(after.control_count - after.pin_count)
    hand = SteeredHand(name="right", control=moving, wrist=np.zeros(3))
    motion = SteeredMotion(
        model=after,
        start=(after.object_node, after.initial_velocity),
        parameters=parameters,
        control=control,
        hands=(hand,),
        pose=0.1 * np.eye(POSE)[:1] * [[[0.0]], [[1.0]]],
    )
    moved = motion.controls()[1] - control
    np.testing.assert_allclose(moved[:4], np.tile([[0.1, 0, 0]], (4, 1)), atol=1e-7)
    np.testing.assert_array_equal(moved[4:], 0.0)
    again = SteeredMotion.from_tensors(motion.to_tensors(), parameters)
    np.testing.assert_array_equal(again.controls(), motion.controls())


def test_edits_are_stored_and_read_as_they_were() -> None:
    assert decode_edits(encode_edits(EDITS), "x") == EDITS
    listed = [Cut(springs=[[0, 1]]), Pin(nodes=[2], places=[[0, 0, 1]])]
    assert checked_edits(listed) == (
        Cut(springs=((0, 1),)),
        Pin(nodes=(2,), places=((0.0, 0.0, 1.0),)),
    )
    assert hash(checked_edits(listed)) == hash(checked_edits(listed))
    assert not keeps_what_is_joined(EDITS)
    assert keeps_what_is_joined(EDITS[1:3])
    assert keeps_what_is_joined(())


def test_edits_say_what_they_do() -> None:
    assert [edit.title for edit in EDITS] == [
        "Cut 4 springs",
        "Stiffness ×0.25 of 3 springs",
        "Damping ×3 of 2 springs",
        "Join 3 pairs of nodes",
        "Pin 2 nodes from frame 1 on",
        "Attach 2 nodes to the hand from frame 1 on",
        "Release 2 nodes from frame 2 on",
        "Stiffness ×2 of 1 spring",
    ]
    assert Release(nodes=(1,)).title == "Release 1 node"
    of_recording = [edit.is_of_recording for edit in EDITS]
    assert of_recording == [True, True, False, False, True, True, True, False]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{}", "x holds no edits: Expected `array`"),
        (b'[{"kind": "melt"}]', "scale, cut, join, pin, attach, release"),
        (b'[{"kind": "cut", "springs": [[0, -1]]}]', r"\$\[0\]\.springs\[0\]\[1\]"),
        (b'[{"kind": "cut", "springs": [[0]]}]', r"\$\[0\]\.springs\[0\]"),
        (b'[{"kind": "cut", "spring": []}]', "unknown field `spring`"),
        (b'[{"kind": "scale", "quantity": "mass", "factor": 2}]', "quantity"),
        (b'[{"kind": "scale", "quantity": "damping", "factor": 0}]', "factor"),
        (b'[{"kind": "pin", "nodes": [0], "places": [[0, 0, 1e99]]}]', "places"),
        (b'[{"kind": "release", "nodes": [0], "frame": -1}]', "frame"),
        (b"[" * 3000, "x holds no edits"),
        (b'\xff["', "x holds no edits"),
    ],
)
def test_foreign_data_is_refused_by_the_place_in_it(content: bytes, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        decode_edits(content, "x")


def test_too_many_edits_are_refused() -> None:
    edits = [Cut()] * (MOST_EDITS + 1)
    assert len(checked_edits(edits[1:])) == MOST_EDITS
    with pytest.raises(UsageError, match="no edits"):
        checked_edits(edits)
    with pytest.raises(UsageError, match="no edits"):
        decode_edits(msgspec.json.encode(edits), "x")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (Cut(springs=((0, 8),)), r"Edit 2 \(Cut 1 spring\): there is no object node 8; .* 0 to 7"),
        (Cut(virtual=((8, 0),)), "no object node 8"),
        (Cut(virtual=((0, 4),)), "no control node 4; the object has numbers 0 to 3"),
        (Join(springs=((2, 2),)), "nodes 2 and 2 are at one place"),
        (Pin(nodes=(1, 1), places=((0, 0, 0), (0, 0, 1))), "different nodes"),
        (Pin(nodes=(1, 2), places=((0, 0, 0),)), "one value for each of the 2"),
        (Attach(nodes=(1,), controls=(4,), lengths=(0.1,)), "no control node that moves 4"),
        (Release(nodes=(9,)), "no object node 9"),
    ],
)
def test_edits_of_what_is_not_there_are_refused(edit, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        edited(cube_scene(), (ScaleMaterial(quantity="damping", factor=2.0), edit))


def test_a_rope_that_bends_is_not_cut() -> None:
    model, parameters = as_model(cube_scene())
    rod = Rod(
        node=np.arange(4, dtype=np.int32),
        held_by=0,
        length=np.full(4, 0.03, np.float32),
        natural_curvature=np.zeros((4, 2), np.float32),
        stiffness=1.0,
        damping=0.0,
        twist_stiffness=1.0,
    )
    rope = replace(model, rod=rod)
    for edit in (Cut(springs=((0, 1),)), Join(springs=((0, 1),)), Release(nodes=(4,))):
        with pytest.raises(UsageError, match="this rope bends as one rod"):
            apply_edits(rope, (edit,), parameters)
    pinned = apply_edits(rope, (Pin(nodes=(3,), places=((0.0, 0.0, 0.0),)),), parameters)
    assert pinned.pin_count == 1
    assert pinned.attached[-1].tolist() == [0, NEVER]
