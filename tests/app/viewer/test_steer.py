"""Steering in a live scene: the mode, held keys, the gizmo, and the way back to playback."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FakeSettings, FolderCatalog, rest_at
from support.waiting import LIMIT_S, until

from app.settings import BUNDLED
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from app.viewer.steer.steer_panel import GIZMO, Recorded
from app.viewer.steer.steered import SteeredObject
from physhandi.data.sequence import Sequence
from physhandi.fitted_object import FittedObject
from physhandi.pipeline import run_job
from physhandi.run import Run
from physhandi.simulation.steering import POSE, SteeredMotion

AT = 8
STEER, BACK = "Steer (G)", "Back to playback (G)"
NODES = "/object/nodes"
HAND = "/hand/right"
DOTS = "/steer/dots"
TIPS = [4, 8, 12, 16, 20]


@pytest.fixture
def scene(sessions: Sessions) -> Iterator[tuple[Session, ViewerClient]]:
    """The sheet, its nodes shown, at rest in a frame in which it is lifted."""
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.tell_camera(position=(0.0, -1.0, 0.5), look_at=(0.0, 0.0, 0.0))
        wait(client, lambda: "simulated" in client.texts())
        client.set("Surface", False)
        client.set("Object nodes", True)
        rest_at(client, AT)
        wait(client, lambda: session._playback.frame == AT and NODES in client.nodes)
        yield session, client


def wait(client: ViewerClient, condition: Callable[[], object]) -> None:
    """Take in messages until a condition holds, however busy the machine is."""
    client.until(condition, LIMIT_S)


def hold(session: Session, *keys: str) -> None:
    session.keys.hear(json.dumps({"held": keys}))


def nodes(client: ViewerClient) -> np.ndarray:
    """Where the middle of the object is drawn."""
    return client.array(NODES, "points").mean(axis=0)


def steer(client: ViewerClient) -> np.ndarray:
    """Begin to steer; returns where the gizmo is."""
    client.set(STEER, True)
    wait(client, lambda: GIZMO in client.nodes and client.find(BACK))
    return np.array(client.positions[GIZMO])


def test_a_held_key_moves_hand_gizmo_and_object_until_it_is_let_go(scene, run) -> None:
    session, client = scene
    told: list[str | None] = []
    session.keys.listen(told.append)
    control = run.array("sequences/lift/control.npy")[AT]
    start = steer(client)
    np.testing.assert_allclose(start, control.mean(axis=0), atol=1e-6)
    says = {
        "steering": True,
        "what": "the controls",
        "both": False,
        "turns": True,
        "curls": False,
        "finger": "",
        "recording": False,
    }
    assert json.loads(told[-1]) == says
    first = nodes(client)
    hold(session, "KeyD")  # To the right of somebody who looks along y.
    wait(client, lambda: client.positions[GIZMO][0] > start[0] + 0.03)
    hold(session)
    wait(client, lambda: nodes(client)[0] - first[0] > 0.02)
    place = np.array(client.positions[GIZMO]) - start
    np.testing.assert_allclose(place[1:], 0.0, atol=1e-6)
    assert session._playback.frame == AT

    session.keys.hear('{"press": "undo"}')
    wait(client, lambda: np.allclose(client.positions[GIZMO], start, atol=1e-9))
    wait(client, lambda: abs(nodes(client)[0] - first[0]) < 0.005)
    client.set(BACK, True)
    wait(client, lambda: client.find(STEER))
    assert json.loads(told[-1]) == {"steering": False}
    wait(client, lambda: np.allclose(nodes(client), run_nodes(run)[AT], atol=1e-6))
    hold(session, "KeyD")  # Nobody is steered.


def run_nodes(run) -> np.ndarray:
    return run.array("sequences/lift/rollout.npy").mean(axis=1)


def drag(client: ViewerClient, place: np.ndarray, wxyz=(1.0, 0.0, 0.0, 0.0)) -> None:
    """Drag the gizmo to a place at once."""
    fields = {"name": GIZMO, "owner": ""}
    position = [float(value) for value in place]
    client.send("TransformControlsDragStartMessage", **fields)
    client.send("TransformControlsUpdateMessage", wxyz=wxyz, position=position, **fields)
    client.send("TransformControlsDragEndMessage", **fields)


def test_the_hand_follows_the_gizmo_and_no_farther_than_it_reaches(scene) -> None:
    session, client = scene
    start = steer(client)
    object_ = session._steer._object

    half = 0.5**0.5
    drag(client, start + np.array([0.0, 0.02, 0.03]), (half, 0.0, 0.0, half))
    goal = [0.0, 0.02, 0.03, 0.0, 0.0, np.pi / 2]
    wait(client, lambda: np.allclose(object_.newest.pose[0, :6], goal, atol=1e-5))
    for place, why in (((np.nan,) * 3, "finite numbers"), ((1e9, 0.0, 0.0), "no farther")):
        drag(client, np.array(place))
        wait(
            client,
            lambda why=why: any(
                why in json.dumps(message, default=str)
                for message in client.messages
                if "Notification" in message["type"]
            ),
        )
    np.testing.assert_allclose(object_.newest.pose[0, :6], goal, atol=1e-4)


def press(session: Session, name: str) -> None:
    session.keys.hear(json.dumps({"press": name}))


def record(session: Session, client: ViewerClient) -> Recorded:
    """Record how the hand goes up and turns; what is taken back before is not recorded."""
    object_ = session._steer._object
    press(session, "record")
    hold(session, "KeyE", "KeyJ")
    wait(client, lambda: object_.newest.pose[0, 2] > 0.02)
    hold(session)
    wait(client, lambda: len(object_.recorded) > 12)
    press(session, "undo")
    wait(client, lambda: len(object_.recorded) > 5)
    assert max(frame.pose[0, 2] for frame in object_.recorded) == 0.0
    hold(session, "KeyE", "KeyJ")
    wait(client, lambda: object_.newest.pose[0, 2] > 0.02)
    press(session, "record")
    wait(client, lambda: client.find("Keep"))
    hold(session)
    recorded = session._steer._recorded
    np.testing.assert_array_equal(recorded.motion.pose, [frame.pose for frame in recorded.frames])
    return recorded


def test_a_recording_is_trimmed_and_played_whenever_that_is_wanted(
    scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, client = scene
    steer(client)
    recorded = record(session, client)
    last = len(recorded.frames) - 1
    # A take is short, and may have ended before anybody asks whether it is played.
    replay, begun = SteeredObject.replay, list[SteeredMotion]()
    monkeypatch.setattr(
        SteeredObject, "replay", lambda its, motion: (replay(its, motion), begun.append(motion))
    )

    def plays() -> None:
        begun.clear()
        client.set("Take", "Play take")
        wait(client, lambda: begun and not session._steer._object.is_replaying)
        assert len(begun[0].pose) == last - 2
        # The hand is steered on from where the take has brought it.
        np.testing.assert_array_equal(session._steer._object.newest.pose, recorded.frames[-1].pose)

    client.set("Keep", (3, last))
    wait(client, lambda: session._steer._motion_folder.motion.frame_count == last - 2)
    plays()
    client.set(BACK, True)
    wait(client, lambda: client.find(STEER))
    client.set("Frame", AT + 4)
    wait(client, lambda: session._playback.frame == AT + 4)
    plays()
    assert session._playback.frame == AT
    client.set("Take", "Discard")
    wait(client, lambda: not client.find("Keep"))


def test_a_recording_is_kept_as_a_run_and_a_recording(
    scene, begun: list[Run], noted: list[tuple[str, str, str | None]], tmp_path: Path
) -> None:
    session, client = scene
    steer(client)
    recorded = record(session, client)
    last = len(recorded.frames) - 1
    client.set("Keep", (3, last))
    wait(client, lambda: session._steer._motion_folder.motion.frame_count == last - 2)
    client.set("take name", "Up & round")
    wait(client, lambda: session._steer._motion_folder._name.value == "Up & round")
    client.set("Save as run and recording", True)
    wait(client, lambda: noted)
    assert noted == [("me", "keep a take", begun[0].id)]
    run_job(begun[0])
    wait(client, lambda: "Saved as run" in session._steer._motion_folder._progress.content)
    run = Run.open(begun[0].folder)
    rollout = run.array("sequences/Up_round/rollout.npy")
    np.testing.assert_array_equal(rollout, [frame.position for frame in recorded.frames[3:]])
    np.testing.assert_array_equal(FittedObject.of(run).simulate().position, rollout)
    sequence = Sequence.load(tmp_path / "sequences" / "Up_round")
    sequence.validate()
    np.testing.assert_array_equal(sequence.marker, rollout)
    np.testing.assert_array_equal(sequence.control, recorded.motion.controls()[3:])
    assert sequence.meta.provenance == {
        "origin": "steered by hand in the viewer",
        "run": "sheet",
        "sequence": "lift",
        "frame": AT,
        "hands": ["controls"],
    }
    scores = run.json("metrics.json")["Up_round"]["future"]
    assert scores["rollout"]["track_error"] == 0.0 < scores["static"]["track_error"]
    client.set("Save as run and recording", True)
    wait(client, lambda: client.is_told("There is a recording 'Up_round'"))
    assert len(begun) == 1


def test_a_point_that_is_clicked_is_held_and_pulled_until_it_is_let_go(scene) -> None:
    session, client = scene
    start = steer(client)
    object_ = session._steer._object
    wait(client, lambda: session._inspector._grab is not None)
    with session._lock:  # Nothing is drawn meanwhile, so that it is where the click goes.
        rollout, _, frame = session._inspector._shown
        corner = open_corner(rollout.position[frame])
        click = looking_down_at(rollout.position[frame][corner])
        session._inspector._click(click, prefers_hand=False)
    wait(client, lambda: client.value("Move") == "point 1")
    place = object_.motion.hands[1].wrist
    wait(client, lambda: np.allclose(client.positions[GIZMO], place, atol=1e-6))
    held = object_.motion.model.spring_nodes - [0, object_.motion.model.node_count]
    assert [corner, len(object_.motion.control) - 1] in held.tolist()
    assert {hand.name for hand in object_.motion.hands} == {"controls", "point 1"}
    hold(session, "KeyE")
    wait(client, lambda: object_.newest.position[corner, 2] > place[2] + 0.03)
    hold(session)
    np.testing.assert_array_equal(object_.newest.pose[0], 0.0)
    press(session, "grip")
    wait(client, lambda: np.allclose(client.positions[GIZMO], start, atol=1e-6))
    wait(client, lambda: object_.newest.position[corner, 2] < place[2] + 0.02)
    assert [hand.name for hand in object_.motion.hands] == ["controls"]
    for count in (2, 2, 1):  # Before it was let go, pulled, and held.
        press(session, "undo")
        wait(client, lambda count=count: len(object_.motion.hands) == count)


def open_corner(place: np.ndarray) -> int:
    """The farthest node of which nothing lies above; as time goes by the sheet comes to hang."""
    across = np.linalg.norm(place[:, None, :2] - place[None, :, :2], axis=-1)
    is_covered = ((across < 0.02) & (place[None, :, 2] > place[:, None, 2])).any(axis=1)
    return int(np.argmax(np.where(is_covered, -np.inf, place[:, :2].sum(axis=1))))


def looking_down_at(place: np.ndarray) -> SimpleNamespace:
    """A click of somebody above a point."""
    return SimpleNamespace(
        client=SimpleNamespace(camera=SimpleNamespace(fov=0.8, image_height=800)),
        ray_origin=(*place[:2], 2.0),
        ray_direction=(0.0, 0.0, -1.0),
    )


def test_a_gizmo_that_is_let_go_is_told_again_where_its_hand_is(scene) -> None:
    """A browser takes in what comes for its next picture, and so older places after the drag."""
    session, client = scene
    start = steer(client)
    object_ = session._steer._object
    fields = {"name": GIZMO, "owner": ""}
    goal = start + np.array([0.0, 0.01, 0.02])
    client.send("TransformControlsDragStartMessage", **fields)
    position = [float(value) for value in goal]
    client.send(
        "TransformControlsUpdateMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=position, **fields
    )
    wait(client, lambda: np.allclose(object_.newest.pose[0, :3], goal - start, atol=1e-9))
    client.positions[GIZMO] = tuple(start)
    client.send("TransformControlsDragEndMessage", **fields)
    wait(client, lambda: np.allclose(client.positions[GIZMO], goal, atol=1e-6))


@pytest.fixture
def towel() -> Iterator[Session]:
    """The bundled towel, which a hand with bones holds."""
    sessions = Sessions(FakeSettings(), FolderCatalog(BUNDLED))
    yield sessions.get(sessions.open("run", "towel_fold_quick", "me"))
    sessions.shutdown()


def test_the_fingers_of_a_hand_close_while_a_key_is_held(towel: Session) -> None:
    session = towel
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.tell_camera(position=(0.0, -1.0, 0.5), look_at=(0.0, 0.0, 0.0))
        rest_at(client, AT)
        wait(client, lambda: session._playback.frame == AT and HAND in client.nodes)
        start = steer(client)
        object_ = session._steer._object
        wait(client, lambda: object_.newest.pull is not None)
        before = session._content.hands[0].vertex[AT]
        wait(client, lambda: np.allclose(client.array(HAND, "vertices"), before, atol=1e-6))
        hold(session, "KeyR")
        wait(client, lambda: object_.newest.pose[0, 6] == 1.0)
        hold(session)
        np.testing.assert_array_equal(object_.newest.pose[0, :6], 0.0)

        def moved() -> np.ndarray:
            return np.linalg.norm(client.array(HAND, "vertices") - before, axis=1)

        control = object_.motion.control_at(object_.newest.pose)
        wait(client, lambda: np.allclose(client.array(HAND, "vertices"), control, atol=1e-5))
        near = np.linalg.norm(before - start, axis=1) < 0.03
        assert near.any()
        assert moved()[near].max() < 1e-3
        assert moved().max() > 0.03


@pytest.fixture
def index(towel: Session) -> Iterator[tuple[ViewerClient, SteeredObject, np.ndarray]]:
    """The towel whose index finger is chosen by a click on its dot; and the joints of its hand."""
    session = towel
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        told: list[str | None] = []
        session.keys.listen(told.append)
        rest_at(client, AT)
        wait(client, lambda: session._playback.frame == AT and HAND in client.nodes)
        wrist = steer(client)
        object_ = session._steer._object
        wait(client, lambda: object_.newest.pull is not None and DOTS in client.nodes)
        joint = session._content.hands[0].joint[AT].astype(float)
        np.testing.assert_allclose(wrist, joint[0], atol=1e-6)
        dots = client.array(DOTS, "batched_positions")
        np.testing.assert_allclose(np.linalg.norm(dots - joint[TIPS], axis=1), 0.0077, atol=0.002)
        wait(client, lambda: session._inspector._grab is not None)
        session._inspector._click(looking_down_at(dots[1]), prefers_hand=False)
        wait(client, lambda: client.value("Move") == "right index finger")
        wait(client, lambda: np.allclose(client.positions[GIZMO], joint[8], atol=1e-6))
        assert json.loads(told[-1])["finger"] == "index finger"
        yield client, object_, joint


def tip_of(object_: SteeredObject) -> np.ndarray:
    return object_.motion.hands[0].tip(1, object_.newest.pose[0])


def test_a_fingertip_follows_the_gizmo_and_its_wrist_stays(towel: Session, index) -> None:
    client, object_, joint = index
    before = client.array(HAND, "vertices")
    target = joint[8] + [0.005, 0.0, 0.03]
    drag(client, target)
    wait(client, lambda: np.allclose(tip_of(object_), target, atol=2e-6))
    pose = object_.newest.pose[0]
    np.testing.assert_array_equal(pose[:11], 0.0)  # Wrist, curl and thumb.
    np.testing.assert_array_equal(pose[15:], 0.0)
    # What is drawn, and what holds the object, is the finger that went up.
    control = object_.motion.control_at(object_.newest.pose)
    wait(client, lambda: np.allclose(client.array(HAND, "vertices"), control, atol=1e-5))
    moved = client.array(HAND, "vertices") - before
    nearest = np.argmin(np.linalg.norm(before - joint[8], axis=1))
    np.testing.assert_allclose(moved[nearest], target - joint[8], atol=0.008)
    at_wrist = np.linalg.norm(before - joint[0], axis=1) < 0.03
    assert np.linalg.norm(moved[at_wrist], axis=1).max() < 1e-4

    # A hand that moves takes its finger along, bent as it is.
    hold(towel, "KeyE")
    wait(client, lambda: object_.newest.pose[0, 2] > 0.01)
    hold(towel)
    np.testing.assert_allclose(object_.newest.pose[0, 7:], pose[7:], atol=1e-3)
    for state in (pose, np.zeros(POSE)):
        press(towel, "undo")
        wait(client, lambda state=state: np.allclose(object_.newest.pose[0], state, atol=1e-3))
    wait(client, lambda: np.allclose(client.positions[GIZMO], joint[8], atol=1e-6))


def test_a_fingertip_goes_as_far_as_it_can_and_its_gizmo_comes_back_to_it(index) -> None:
    client, object_, joint = index
    drag(client, joint[8] + [0.0, 0.0, 0.5])
    wait(client, lambda: tip_of(object_)[2] > joint[8, 2] + 0.04)
    wait(client, lambda: np.allclose(client.positions[GIZMO], tip_of(object_), atol=1e-4))
    assert client.positions[GIZMO][2] < joint[8, 2] + 0.06
    notices = len(client.messages)
    drag(client, np.full(3, np.nan))
    wait(client, lambda: client.is_told("finite", since=notices))
    client.set("Move", "right hand")
    wait(client, lambda: np.allclose(client.positions[GIZMO], joint[0], atol=1e-6))


def test_a_hand_lets_go_and_grips_what_is_near_it(scene) -> None:
    session, client = scene
    steer(client)
    object_ = session._steer._object
    height = object_.newest.position[:, 2].max()
    press(session, "record")
    wait(client, lambda: len(object_.recorded) > 2)
    press(session, "grip")
    wait(client, lambda: client.find("Grip (X)"))
    wait(client, lambda: client.find("Keep"))  # What was recorded before it let go.
    wait(client, lambda: object_.newest.position[:, 2].max() < height - 0.03)
    told = len(client.messages)
    press(session, "grip")
    wait(client, lambda: client.is_told("Nothing to grip", since=told))
    press(session, "undo")
    wait(client, lambda: object_.motion.holds(0) and client.find("Let go (X)"))


def test_the_clock_and_a_user_who_leaves_end_it(scene) -> None:
    session, client = scene
    for label, value in (("Frame", AT + 3), ("Play", True)):
        steer(client)
        hold(session, "KeyW")
        client.set(label, value)
        wait(client, lambda: client.find(STEER))
        assert not session._steer.is_on
    assert session._playback.is_playing
    steer(client)
    client.set(BACK, True)  # What was playing before plays on.
    wait(client, lambda: client.find(STEER) and session._playback.is_playing)
    steer(client)
    client.connection.close()
    until(lambda: not session._steer.is_on)


@pytest.fixture
def two_hands(tmp_path: Path) -> Iterator[Session]:
    """The bundled towel with a left hand beyond it, the mirror image of the right one."""
    held = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    recording = [str(BUNDLED / "towel_fold")]
    run = Run.create(
        tmp_path / "runs" / "two", name="Two", kind="reconstruction", sequences=recording, config={}
    )
    folder = "sequences/towel_fold"
    mirror = np.array([-1, 1, 1], np.float32)
    with run.begin_attempt() as attempt:
        shutil.copytree(held.out, attempt.out, dirs_exist_ok=True)
        for name in ("vertex", "keypoint"):
            place = held.array(f"{folder}/hand_right_{name}.npy")
            attempt.save_array(f"{folder}/hand_left_{name}.npy", place * mirror)
        face = held.array(f"{folder}/hand_right_face.npy")
        attempt.save_array(f"{folder}/hand_left_face.npy", face[:, ::-1])
        skin = held.tensors(f"{folder}/hand_right_skin.safetensors")
        flip = np.diag([*mirror, 1]).astype(np.float32)
        mirrored = {
            "T_bone_hand": flip @ skin["T_bone_hand"] @ flip,
            "vertex": skin["vertex"] * mirror,
            "faces": skin["faces"][:, ::-1].copy(),
            "translation": skin["translation"] * mirror,
            "rotation": skin["rotation"] * np.array([1, -1, -1, 1], np.float32),
        }
        attempt.save_tensors(f"{folder}/hand_left_skin.safetensors", skin | mirrored)
        control = held.array(f"{folder}/control.npy")
        both = np.concatenate([control, control * mirror], axis=1)
        attempt.save_array(f"{folder}/control.npy", both)
        model = held.tensors(f"{folder}/model.safetensors")
        model["control_count"] = 2 * model["control_count"]
        attempt.save_tensors(f"{folder}/model.safetensors", model)
        attempt.publish()
    sessions = Sessions(FakeSettings(), FolderCatalog(tmp_path))
    yield sessions.get(sessions.open("run", "two", "me"))
    sessions.shutdown()


def move_both(session: Session, client: ViewerClient) -> None:
    """Let go with two hands, take that back, and record how they are dragged and lifted by keys."""
    object_ = session._steer._object
    client.set("Move", "both hands")
    wait(client, lambda: session._steer._status.content.count("pulls at the") == 2)
    press(session, "grip")
    wait(client, lambda: not object_.motion.holds(0) and client.find("Grip (X)"))
    press(session, "undo")
    wait(client, lambda: object_.motion.holds(0) and client.find("Let go (X)"))
    before, hands = object_.newest.pose, object_.motion.hands
    middle = np.mean([hand.wrist for hand in hands], axis=0)
    wait(client, lambda: np.allclose(client.positions[GIZMO], middle, atol=1e-6))
    press(session, "record")
    wait(client, lambda: object_.is_recording)
    moved = before.copy()
    moved[:, :3] += [0.0, 0.01, 0.02]
    drag(client, middle + np.array([0.0, 0.01, 0.02]))
    wait(client, lambda: np.allclose(object_.newest.pose, moved, atol=1e-5))
    hold(session, "KeyE")
    wait(client, lambda: object_.newest.pose[:, 2].min() > 0.03)
    hold(session)
    press(session, "record")
    wait(client, lambda: client.find("Keep"))
    controls = session._steer._recorded.motion.controls()
    for hand in hands:
        assert (controls[-1, hand.control, 2] - controls[0, hand.control, 2]).min() > 0.029


def test_the_other_hand_s_finger_moves_alone_and_both_hands_move_at_once(
    two_hands: Session,
) -> None:
    session = two_hands
    right, left = session._content.hands
    assert left.joint is not None
    joint = left.joint[AT].astype(float)
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        rest_at(client, AT)
        wait(client, lambda: session._playback.frame == AT and "/hand/left" in client.nodes)
        steer(client)
        object_ = session._steer._object
        wait(client, lambda: object_.newest.pull is not None and DOTS in client.nodes)
        wait(client, lambda: len(client.array(DOTS, "batched_positions")) == 11)
        wait(client, lambda: "pulls at the right hand" in session._steer._status.content)
        dots = client.array(DOTS, "batched_positions")
        dot = dots[np.argmin(np.linalg.norm(dots - joint[8], axis=1))]
        wait(client, lambda: session._inspector._grab is not None)
        session._inspector._click(looking_down_at(dot), prefers_hand=False)
        wait(client, lambda: client.value("Move") == "left index finger")
        wait(client, lambda: np.allclose(client.positions[GIZMO], joint[8], atol=1e-6))
        wait(client, lambda: "pulls at the left hand" in session._steer._status.content)
        target = joint[8] + [-0.005, 0.0, 0.03]
        drag(client, target)

        def tip() -> np.ndarray:
            return object_.motion.hands[1].tip(1, object_.newest.pose[1])

        wait(client, lambda: np.allclose(tip(), target, atol=2e-6))
        moved = object_.newest.pose[1]
        np.testing.assert_array_equal(object_.newest.pose[0], 0.0)
        np.testing.assert_array_equal(moved[:11], 0.0)  # Wrist, curl and thumb.
        assert np.abs(moved[11:15]).max() > 0.1
        client.set("Move", "left hand")
        wait(client, lambda: np.allclose(client.positions[GIZMO], joint[0], atol=1e-6))
        hold(session, "KeyR")
        wait(client, lambda: object_.newest.pose[1, 6] == 1.0)
        hold(session)
        np.testing.assert_array_equal(object_.newest.pose[0], 0.0)
        wait(
            client, lambda: np.allclose(client.array(HAND, "vertices"), right.vertex[AT], atol=1e-5)
        )
        move_both(session, client)
