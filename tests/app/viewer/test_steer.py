"""Steering in a live scene: the mode, held keys, the gizmo, and the way back to playback."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from viewer_client import ViewerClient
from viewer_world import rest_at
from waiting import until

from app.viewer.session import Session
from app.viewer.sessions import Sessions
from app.viewer.steer.steer_panel import GIZMO

AT = 8
STEER, BACK = "Steer (G)", "Back to playback (G)"
NODES = "/object/nodes"


@pytest.fixture
def scene(sessions: Sessions) -> Iterator[tuple[Session, ViewerClient]]:
    """The sheet, its nodes shown, at rest in a frame in which it is lifted."""
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.tell_camera(position=(0.0, -1.0, 0.5), look_at=(0.0, 0.0, 0.0))
        client.until(lambda: "simulated" in client.texts())
        client.set("Surface", False)
        client.set("Object nodes", True)
        rest_at(client, AT)
        client.until(lambda: session._playback.frame == AT and NODES in client.nodes)
        yield session, client


def hold(session: Session, *keys: str) -> None:
    session.keys.hear(json.dumps({"held": keys}))


def nodes(client: ViewerClient) -> np.ndarray:
    """Where the middle of the object is drawn."""
    return client.array(NODES, "points").mean(axis=0)


def steer(client: ViewerClient) -> np.ndarray:
    """Begin to steer; returns where the gizmo is."""
    client.set(STEER, True)
    client.until(lambda: GIZMO in client.nodes and client.find(BACK))
    return np.array(client.positions[GIZMO])


def test_a_held_key_moves_hand_gizmo_and_object_until_it_is_let_go(scene, run) -> None:
    session, client = scene
    told: list[str | None] = []
    session.keys.listen(told.append)
    control = run.array("sequences/lift/control.npy")[AT]
    start = steer(client)
    np.testing.assert_allclose(start, control.mean(axis=0), atol=1e-6)
    assert json.loads(told[-1]) == {"steering": True, "what": "the controls"}
    first = nodes(client)
    hold(session, "KeyD")  # To the right of somebody who looks along y.
    client.until(lambda: client.positions[GIZMO][0] > start[0] + 0.03)
    hold(session)
    client.until(lambda: nodes(client)[0] - first[0] > 0.02)
    place = np.array(client.positions[GIZMO]) - start
    np.testing.assert_allclose(place[1:], 0.0, atol=1e-6)
    assert session._playback.frame == AT

    session.keys.hear('{"press": "undo"}')
    client.until(lambda: np.allclose(client.positions[GIZMO], start, atol=1e-9))
    client.until(lambda: abs(nodes(client)[0] - first[0]) < 0.005)
    client.set(BACK, True)
    client.until(lambda: client.find(STEER))
    assert json.loads(told[-1]) == {"steering": False}
    client.until(lambda: np.allclose(nodes(client), run_nodes(run)[AT], atol=1e-6))
    hold(session, "KeyD")  # Nobody is steered.


def run_nodes(run) -> np.ndarray:
    return run.array("sequences/lift/rollout.npy").mean(axis=1)


def test_the_hand_follows_the_gizmo_and_no_farther_than_it_reaches(scene) -> None:
    session, client = scene
    start = steer(client)
    object_ = session._steer._object

    def drag(position, wxyz=(1.0, 0.0, 0.0, 0.0)) -> None:
        fields = {"name": GIZMO, "owner": ""}
        client.send("TransformControlsDragStartMessage", **fields)
        client.send("TransformControlsUpdateMessage", wxyz=wxyz, position=position, **fields)
        client.send("TransformControlsDragEndMessage", **fields)

    half = 0.5**0.5
    drag([float(v) for v in start + np.array([0.0, 0.02, 0.03])], (half, 0.0, 0.0, half))
    goal = [0.0, 0.02, 0.03, 0.0, 0.0, np.pi / 2]
    client.until(lambda: np.allclose(object_.newest.pose[0], goal, atol=1e-5))
    for place, why in (((np.nan,) * 3, "finite numbers"), ((1e9, 0.0, 0.0), "no farther")):
        drag(place)
        client.until(
            lambda why=why: any(
                why in json.dumps(message, default=str)
                for message in client.messages
                if "Notification" in message["type"]
            )
        )
    assert object_.order_of(0).goal == pytest.approx(goal, abs=1e-6)


def test_the_clock_and_a_user_who_leaves_end_it(scene) -> None:
    session, client = scene
    for label, value in (("Frame", AT + 3), ("Play", True)):
        steer(client)
        hold(session, "KeyW")
        client.set(label, value)
        client.until(lambda: client.find(STEER))
        assert not session._steer.is_on
    assert session._playback.is_playing
    steer(client)
    client.set(BACK, True)  # What was playing before plays on.
    client.until(lambda: client.find(STEER) and session._playback.is_playing)
    steer(client)
    client.connection.close()
    until(lambda: not session._steer.is_on)
