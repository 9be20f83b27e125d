"""A take of a hand as a run: the hand that is stored, and what it holds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.settings import BUNDLED
from physhandi.data.layout import SequenceFiles
from physhandi.errors import RunError, UsageError
from physhandi.fitted_object import FittedObject
from physhandi.fitting.steered_run import contacts_from
from physhandi.fitting.stored_take import TAKE_FILE, StoredTake
from physhandi.hand.curl import blended, curl_motion, finger_joints
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.pipeline import run_job
from physhandi.run import Run
from physhandi.simulation.contact_intervals import NEVER, ContactIntervals
from physhandi.simulation.fingers import CURLS, Fingers
from physhandi.simulation.steering import POSE, HandSurface, SteeredHand, SteeredMotion

AT, FRAMES = 20, 4
TOWEL = BUNDLED / "runs" / "towel_fold_quick"


def taken() -> SteeredMotion:
    """The bundled towel, whose hand goes up and turns by 0.6 rad in three frames."""
    rollout = FittedObject.of(TOWEL).fitted
    model, start = rollout.going_on(AT)
    control = np.array(rollout.control[AT], np.float32)
    joints = Run.open(TOWEL).array("sequences/towel_fold/hand_right_keypoint.npy")
    hand = SteeredHand(
        name="right", control=np.arange(len(control)), wrist=joints[AT, 0].astype(np.float64)
    )
    pose = np.linspace(0, 1, FRAMES)[:, None, None] * [[0.0, 0.0, 0.02, 0.6, *np.zeros(POSE - 4)]]
    return SteeredMotion(
        model=model,
        start=start,
        parameters=rollout.parameters,
        control=control,
        hands=(hand,),
        pose=pose,
    )


def run_of(take: SteeredMotion, folder: Path) -> Run:
    """Run what was steered as a user's worker does."""
    stored = StoredTake(take=take, sequence="towel_fold", frame=AT)
    run = Run.create(
        folder / "runs" / "steered",
        name="Steered",
        kind="simulation",
        sequences=[str(folder / "sequences" / "up")],
        config={"source": str(TOWEL), "parameters": {}, "take": stored.to_dict()},
    )
    stored.save(run.folder)
    run_job(run)
    return Run.open(run.folder)


@pytest.fixture(scope="module")
def steered(tmp_path_factory) -> Run:
    return run_of(taken(), tmp_path_factory.mktemp("steered"))


def test_the_hand_is_stored_as_it_was_steered(steered: Run) -> None:
    files, was = SequenceFiles("up"), SequenceFiles("towel_fold")
    source = Run.open(TOWEL)
    vertex = steered.array(files.hand_vertex("right"))
    before = source.array(was.hand_vertex("right"))[AT].astype(np.float64)
    np.testing.assert_allclose(vertex[0], before, atol=1e-7)
    wrist = source.array(was.hand_keypoint("right"))[AT, 0].astype(np.float64)
    c, s = np.cos(0.6), np.sin(0.6)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    expected = (before - wrist) @ turn.T + wrist + [0.0, 0.0, 0.02]
    np.testing.assert_allclose(vertex[-1], expected, atol=1e-6)
    joint = steered.array(files.hand_keypoint("right"))
    np.testing.assert_allclose(joint[-1, 0], wrist + np.array([0, 0, 0.02]), atol=1e-7)
    # The articulated hand and its skin say the same as the stored surface.
    motion = HandMotion.from_tensors(steered.tensors(files.hand_motion("right")))
    model = load_hand_model("right")
    offset = motion.vertices(model) - vertex
    np.testing.assert_allclose(offset, offset[:1].repeat(FRAMES, axis=0), atol=0.002)
    np.testing.assert_allclose(motion.keypoints(model), joint, atol=1e-5)
    skin = steered.tensors(files.hand_skin("right"))
    np.testing.assert_allclose(
        skin["translation"][:, 0], motion.scale * motion.wrist_translation, atol=1e-6
    )
    assert (np.sum(skin["rotation"][1:] * skin["rotation"][:-1], axis=-1) > 0).all()
    np.testing.assert_array_equal(
        steered.array(files.hand_face("right")), source.array(was.hand_face("right"))
    )


def test_the_run_is_simulated_again_with_the_same_bits(steered: Run) -> None:
    stored = StoredTake.load(steered)
    assert stored is not None
    rollout = steered.array(SequenceFiles("up").rollout)
    frames = np.stack([position for position, _ in stored.take.simulate()])
    np.testing.assert_array_equal(rollout, frames)
    np.testing.assert_array_equal(FittedObject.of(steered).simulate().position, rollout)
    assert np.abs(rollout[-1] - rollout[0]).max() > 0.01
    surface = FittedObject.of(steered).surface()
    assert surface is not None
    assert surface.vertex_count == FittedObject.of(TOWEL).surface().vertex_count


def test_a_damaged_take_is_named(steered: Run, tmp_path: Path) -> None:
    assert StoredTake.load(Run.open(TOWEL)) is None
    path = steered.folder / TAKE_FILE
    content = path.read_bytes()
    try:
        path.write_bytes(content[:-8])
        with pytest.raises(RunError, match=TAKE_FILE):
            StoredTake.load(steered)
    finally:
        path.write_bytes(content)


def test_contacts_that_hold_at_the_start_hold_for_good() -> None:
    contacts = ContactIntervals(
        node=np.arange(4, dtype=np.int32),
        control=np.int32([9, 8, 7, 6]),
        distance=np.float32([0.1, 0.2, 0.3, 0.4]),
        rank=np.int32([0, 1, 2, 3]),
        interval=np.int32([[0, 5], [5, 9], [6, NEVER], [0, 6]]),
    )
    kept = contacts_from(contacts, 5)
    assert kept is not None
    assert kept.node.tolist() == [1, 3]
    assert kept.control.tolist() == [8, 6]
    assert kept.interval.tolist() == [[0, NEVER]] * 2
    assert contacts_from(None, 5) is None
    nothing = contacts_from(replace(contacts, interval=contacts.interval + 50), 5)
    assert nothing is not None
    assert len(nothing.node) == 0


def test_a_hand_that_closes_is_stored_with_its_bones(tmp_path: Path) -> None:
    take, source = taken(), Run.open(TOWEL)
    files, was = SequenceFiles("up"), SequenceFiles("towel_fold")
    vertex = source.array(was.hand_vertex("right"))[AT].astype(np.float64)
    skin = source.tensors(was.hand_skin("right"))
    motion = curl_motion(skin, "right", AT, CURLS)
    shapes = blended(motion, skin["vertex_bone"], skin["vertex_weight"], vertex)
    hand = replace(take.hands[0], curls=shapes.astype(np.float32))
    pose = take.pose.copy()
    pose[:, 0, 6] = np.linspace(0.0, 0.5, FRAMES)
    run = run_of(replace(take, hands=(hand,), pose=pose), tmp_path)
    stored = run.array(files.hand_vertex("right"))
    # At the end the curl is one of those whose shape is known.
    expected = hand.moved(shapes[np.flatnonzero(CURLS == 0.5)[0]], pose[-1, 0])
    np.testing.assert_allclose(stored[-1], expected, atol=1e-6)
    assert np.linalg.norm(stored[-1] - hand.moved(vertex, pose[-1, 0]), axis=1).max() > 0.02
    np.testing.assert_allclose(run.array(files.control)[-1], expected, atol=1e-5)
    # Skin, motion and keypoints say the same.
    model = load_hand_model("right")
    moved = HandMotion.from_tensors(run.tensors(files.hand_motion("right")))
    offset = np.linalg.norm(moved.vertices(model) - stored, axis=2).mean(axis=1)
    np.testing.assert_allclose(offset, offset[0], atol=5e-4)
    joint = run.array(files.hand_keypoint("right"))
    np.testing.assert_allclose(moved.keypoints(model), joint, atol=1e-4)
    skinned = run.tensors(files.hand_skin("right"))["rotation"]
    turn = np.einsum("jca,fja->fjc", model.joint_axes, moved.articulation)
    expected = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix()
    found = Rotation.from_quat(skinned[:, 1:].reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_finger_that_bends_is_stored_with_its_bones(tmp_path: Path) -> None:
    take, source = taken(), Run.open(TOWEL)
    files, was = SequenceFiles("up"), SequenceFiles("towel_fold")
    vertex = source.array(was.hand_vertex("right"))[AT].astype(np.float64)
    joint = source.array(was.hand_keypoint("right"))[AT].astype(np.float64)
    skin = source.tensors(was.hand_skin("right"))
    motion = curl_motion(skin, "right", AT, CURLS)
    fingers = Fingers(**finger_joints(skin, "right", AT, CURLS, joint))
    shapes = blended(motion, skin["vertex_bone"], skin["vertex_weight"], vertex)
    hand = SteeredHand.of_surface(
        "right",
        HandSurface(shapes=shapes, fingers=fingers),
        control=take.hands[0].control,
        recorded=take.control.astype(np.float64),
        place=take.control,
        wrist=take.hands[0].wrist,
    )
    pose = take.pose.copy()
    pose[:, 0, 11:15] = np.linspace(0.0, 1.0, FRAMES)[:, None] * [0.1, -0.4, -0.3, -0.2]
    run = run_of(replace(take, hands=(hand,), pose=pose), tmp_path)
    stored = run.array(files.hand_vertex("right"))
    # The stored surface is where the control nodes are, and its tip where the bones bring it.
    np.testing.assert_allclose(run.array(files.control)[-1], stored[-1], atol=1e-5)
    keypoint = run.array(files.hand_keypoint("right"))
    np.testing.assert_allclose(keypoint[-1, 8], hand.tip(1, pose[-1, 0]), atol=1e-6)
    still = hand.moved(joint, pose[-1, 0])
    assert np.linalg.norm(keypoint[-1, 8] - still[8]) > 0.02
    np.testing.assert_allclose(
        np.delete(keypoint[-1], [6, 7, 8], 0), np.delete(still, [6, 7, 8], 0), atol=1e-6
    )
    model = load_hand_model("right")
    moved = HandMotion.from_tensors(run.tensors(files.hand_motion("right")))
    np.testing.assert_allclose(moved.keypoints(model), keypoint, atol=1e-4)
    offset = np.linalg.norm(moved.vertices(model) - stored, axis=2).mean(axis=1)
    np.testing.assert_allclose(offset, offset[0], atol=5e-4)


def test_edited_springs_stay_in_a_run_that_was_steered(tmp_path: Path) -> None:
    take = taken()
    stiffness = take.model.stiffness.copy()
    stiffness[:5] *= 0.5
    edited = replace(take, model=replace(take.model, stiffness=stiffness), is_edited=True)
    object_ = FittedObject.of(run_of(edited, tmp_path))
    np.testing.assert_array_equal(object_.model.stiffness, stiffness)
    softer = object_.changed({"stiffness": 0.5 * object_.parameters.stiffness}).model
    own = slice(0, softer.object_spring_count)
    np.testing.assert_allclose(softer.stiffness[own], 0.5 * stiffness[own], rtol=1e-6)
    with pytest.raises(UsageError, match="were edited before it was steered"):
        object_.changed({"connection_radius": 0.9 * object_.parameters.connection_radius})


def test_what_was_gripped_by_hand_is_stored_and_built_again(tmp_path: Path) -> None:
    take = taken()
    node = int(np.argmin(take.start[0][:, 0]))
    held = take.hold_point(node, take.start, take.pose[0], "point 1")
    free = held.let_go(0, take.start, held.pose[0])
    pose = np.zeros((FRAMES, 2, POSE))
    pose[:, 1, 2] = np.linspace(0, 0.02, FRAMES)
    run = run_of(replace(free, pose=pose), tmp_path)
    object_ = FittedObject.of(run)
    rollout = run.array(SequenceFiles("up").rollout)
    np.testing.assert_array_equal(object_.simulate().position, rollout)
    assert rollout[-1, node, 2] > rollout[0, node, 2] + 0.01
    # With a smaller radius springs are built anew: those of the point, none of the hand.
    radius = take.parameters.virtual_connection_radius
    built = object_.changed({"virtual_connection_radius": 0.8 * radius}).model
    virtual = built.spring_nodes[built.object_spring_count :] - [0, built.node_count]
    assert virtual.tolist() == [[node, len(take.control)]]
    with pytest.raises(UsageError, match="virtual_connection_radius"):
        object_.changed({"virtual_connection_radius": 0.4 * radius})
    attached = run.array(SequenceFiles("up").attachment)
    above = take.model.object_node[node] + [0.0, 0.0, 0.5 * radius]
    np.testing.assert_allclose(attached[-1], above, atol=1e-6)
    assert len(attached) == len(take.control) + 1
