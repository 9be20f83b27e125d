"""The camera between key frames: closed forms, smoothness, and files that make no sense."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import rest_at

from app.viewer.content.camera_path import (
    PATH_FORMAT,
    CameraPath,
    Turntable,
    parse_camera_path,
    read_camera_path,
)
from app.viewer.content.session_state import KeyFrame, Pose
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from physhandi.errors import UsageError

X, Y, Z = np.eye(3)


def key(frame: int, position: Any, look_at: Any = (0.0, 0.0, 0.0), fov: float = 0.8) -> KeyFrame:
    place, goal = np.array(position, float), np.array(look_at, float)
    return KeyFrame(frame=frame, pose=Pose(position=place, look_at=goal, up=Z, fov=fov))


def looking(frame: int, degrees: float) -> KeyFrame:
    """From the origin into a direction of the ground, 2 m far."""
    angle = np.radians(degrees)
    return key(frame, (0, 0, 0), (2 * np.cos(angle), 2 * np.sin(angle), 0.0))


def axes(pose: Pose) -> np.ndarray:
    """What is to the right, down and ahead (columns), and where the camera is."""
    return pose.camera(100, 80).T_world_camera[:3]


def made_path() -> CameraPath:
    random = np.random.default_rng(3)
    keys = [
        key(frame, random.normal(size=3) + 4 * Z, random.normal(size=3), random.uniform(0.3, 1))
        for frame in (0, 4, 5, 11, 30)
    ]
    return CameraPath(tuple(keys[::-1]))


def test_the_camera_passes_through_its_key_frames_and_rests_outside() -> None:
    path = made_path()
    assert [each.frame for each in path.keys] == [0, 4, 5, 11, 30]
    for each in path.keys:
        for time in (each.frame - 1e-9, each.frame, each.frame + 1e-9):
            found = path.at(time)
            np.testing.assert_allclose(axes(found), axes(each.pose), atol=1e-6)
            np.testing.assert_allclose(found.look_at, each.pose.look_at, atol=1e-6)
            assert found.fov == pytest.approx(each.pose.fov, abs=1e-6)
    np.testing.assert_array_equal(axes(path.at(-5)), axes(path.at(0)))
    np.testing.assert_array_equal(axes(path.at(99)), axes(path.at(30)))


def test_axes_stay_of_length_one_and_no_speed_jumps() -> None:
    path, step = made_path(), 1e-4
    for time in np.linspace(0, 30, 61):
        turn = axes(path.at(time))[:, :3]
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1.0)
    for each in path.keys[1:-1]:
        before, at, after = (axes(path.at(each.frame + step * side)) for side in (-1, 0, 1))
        assert np.abs(at - before).max() > 1e-3 * step
        np.testing.assert_allclose((at - before) / step, (after - at) / step, atol=2e-2)


def test_between_two_key_frames_the_camera_goes_and_turns_at_one_speed() -> None:
    start, goal = np.array([1.0, -2.0, 0.5]), np.array([3.0, 0.0, 1.5])
    path = CameraPath((key(10, start, start + 2 * X), key(20, goal, goal + 2 * Y)))
    for frame in range(10, 21):
        part = (frame - 10) / 10
        pose = path.at(frame)
        np.testing.assert_allclose(pose.position, start + part * (goal - start), atol=1e-9)
        angle = part * np.pi / 2
        ahead = [2 * np.cos(angle), 2 * np.sin(angle), 0]
        np.testing.assert_allclose(pose.look_at - pose.position, ahead, atol=1e-9)
        np.testing.assert_allclose(pose.up, Z, atol=1e-9)


def test_evenly_spaced_key_frames_are_joined_by_a_catmull_rom_spline() -> None:
    places = np.array([[0, 0, 1], [1, 0.4, 1], [2, 0.2, 1.3], [3.2, 0, 1]], float)
    path = CameraPath(tuple(key(4 * n, place, (0, 9, 0)) for n, place in enumerate(places)))
    middle = np.array([-1, 9, 9, -1]) @ places / 16
    np.testing.assert_allclose(path.at(6).position, middle, atol=1e-9)


def test_between_equal_key_frames_the_camera_rests() -> None:
    path = CameraPath(
        (key(0, (1, 0, 1)), key(10, (2, 1, 1)), key(20, (2, 1, 1)), key(24, (0, 3, 1)))
    )
    for frame in (10, 11.5, 15, 19, 20):
        np.testing.assert_allclose(axes(path.at(frame)), axes(path.keys[1].pose), atol=1e-9)
    assert np.linalg.norm(path.at(21).position - path.at(20).position) > 0.05
    assert np.linalg.norm(path.at(9).position - path.at(10).position) > 0.005
    alone = CameraPath((key(5, (1, 2, 3)),))
    np.testing.assert_array_equal(alone.at(40).position, [1, 2, 3])


def test_the_camera_turns_the_shortest_way_round() -> None:
    path = CameraPath((looking(0, 170), looking(10, -170)))
    ahead = [path.at(frame).look_at / 2 for frame in range(11)]
    np.testing.assert_allclose(ahead[5], [-1, 0, 0], atol=1e-9)
    steps = [np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a, b in pairwise(ahead)]
    np.testing.assert_allclose(steps, 2.0, atol=1e-4)


def test_a_turntable_goes_round_once_without_a_jump() -> None:
    own = key(0, (1, 0, 1)).pose
    frames = range(5, 13)
    way = [Turntable(360).pose(frame, own, frames).position for frame in (5, 7, 13)]
    np.testing.assert_allclose(way, [[1, 0, 1], [0, 1, 1], [1, 0, 1]], atol=1e-9)


def test_a_file_brings_the_path_back(tmp_path: Path) -> None:
    path, file = made_path(), tmp_path / "way.json"
    file.write_text(path.to_text())
    found = read_camera_path(file)
    assert isinstance(found, CameraPath)
    for time in (0, 2.5, 8, 20):
        np.testing.assert_allclose(axes(found.at(time)), axes(path.at(time)), atol=1e-6)
    table = parse_camera_path(f'{{"format": "{PATH_FORMAT}", "kind": "turntable", "turn": -90}}')
    assert table == Turntable(-90.0)


GOOD = {"frame": 3, "position": [1, 2, 3], "look_at": [0, 0, 0]}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"frame": -1}, "key frame 1: frame: expected a whole number"),
        ({"frame": 1.5}, "key frame 1: frame: expected a whole number"),
        ({"frame": True}, "key frame 1: frame: expected a whole number"),
        ({"frame": 3}, "keys: there are two key frames of frame 3"),
        ({"position": [1, 2]}, "key frame 1: position: expected three numbers"),
        ({"position": [1, 2, "3"]}, "key frame 1: position: expected a number"),
        ({"look_at": [1, 2, 3]}, "key frame 1: look_at: the camera cannot look at where it"),
        ({"up": [1, 2, 3]}, "key frame 1: up: the camera looks in this direction"),
        ({"up": [0, 0, 0]}, "key frame 1: up: "),
        ({"fov": 0}, "key frame 1: fov: expected a number from 1 to 170"),
        ({"fov": float("nan")}, "key frame 1: fov: expected a number"),
        ({"lens": 3}, "key frame 1: lens: there is no such field"),
    ],
)
def test_key_frames_that_make_no_sense_are_named(
    tmp_path: Path, change: dict[str, Any], told: str
) -> None:
    file = tmp_path / "way.json"
    keys = [GOOD, GOOD | {"frame": 8} | change]
    file.write_text(json.dumps({"format": PATH_FORMAT, "kind": "keys", "keys": keys}))
    with pytest.raises(UsageError) as refused:
        read_camera_path(file)
    assert str(refused.value).startswith(f"{file}: {told}")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "this is not JSON"),
        ("[]", "format: "),
        ('{"format": "other"}', "format: "),
        (f'{{"format": "{PATH_FORMAT}"}}', "kind: "),
        (
            f'{{"format": "{PATH_FORMAT}", "kind": "keys", "keys": []}}',
            "keys: expected a list of 1",
        ),
        (
            f'{{"format": "{PATH_FORMAT}", "kind": "keys", "keys": [1]}}',
            "key frame 0: expected named",
        ),
        (f'{{"format": "{PATH_FORMAT}", "kind": "turntable"}}', "turn: expected a number"),
        (f'{{"format": "{PATH_FORMAT}", "kind": "turntable", "turn": 1, "keys": []}}', "keys: "),
    ],
)
def test_files_that_are_no_camera_path_are_refused(text: str, told: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_camera_path(text)
    assert str(refused.value).startswith(told)


FIRST, SECOND, THIRD = (0.9, 0.0, 0.5), (0.0, 0.9, 0.5), (-0.9, 0.1, 0.6)


def places_of_keys(session: Session) -> dict[int, list[float]]:
    path = session.camera_path
    found = {} if path is None else {each.frame: each.pose.position for each in path.keys}
    return {frame: [round(float(x), 6) for x in place] for frame, place in found.items()}


def stand(client: ViewerClient, session: Session, frame: int, position: Any) -> None:
    client.set("Frame", frame)
    client.until(lambda: session.state.frame == frame)
    client.tell_camera(position=position, look_at=(0.0, 0.0, 0.0))


def is_sent_to(client: ViewerClient, position: Any) -> bool:
    kind = "SetCameraPositionMessage"
    places = [m["position"] for m in client.messages if m["type"] == kind]
    return bool(places) and np.allclose(places[-1], position, atol=1e-5)


def shows_way(client: ViewerClient) -> bool:
    kinds = [m["type"] for m in client.messages if m.get("name") == "/camera_path/way"]
    return bool(kinds) and kinds[-1] != "RemoveSceneNodeMessage"


def test_key_frames_are_set_visited_moved_and_deleted(sessions: Sessions) -> None:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    assert isinstance(session, Session)
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        rest_at(client, 1)
        for frame, place in ((3, FIRST), (8, SECOND)):
            stand(client, session, frame, place)
            client.set("Camera path", "Add key frame")
            client.until(lambda at=frame: client.value("Key frame") == f"frame {at}")
        assert places_of_keys(session) == {3: list(FIRST), 8: list(SECOND)}
        client.until(lambda: shows_way(client))
        assert {"/camera_path/3", "/camera_path/8"} <= set(client.nodes)
        way = client.array("/camera_path/way", "points")
        np.testing.assert_allclose(way[[0, -1]], [FIRST, SECOND], atol=1e-6)
        client.set("Key frame", "frame 3")
        client.set("This one", "Go to")
        client.until(lambda: session.state.frame == 3 and is_sent_to(client, FIRST))
        client.set("Play along the path", True)
        client.until(lambda: not shows_way(client))
        path = session.camera_path
        assert path is not None
        client.set("Frame", 6)
        client.until(lambda: is_sent_to(client, path.at(6).position))
        client.set("Play along the path", False)
        client.until(lambda: shows_way(client))
        stand(client, session, 5, THIRD)
        client.set("This one", "Move here")
        client.until(lambda: client.value("Key frame") == "frame 5")
        assert places_of_keys(session) == {5: list(THIRD), 8: list(SECOND)}
        # A copy of the scene, as a link makes one, goes on with the path; another end has no room.
        copy = sessions.get(sessions.copy(session))
        assert isinstance(copy, Session)
        assert places_of_keys(copy) == {5: list(THIRD), 8: list(SECOND)}
        late = replace(session.state.camera_keys[0], frame=10_000)
        state = replace(session.state, camera_keys=(late,))
        with pytest.raises(UsageError, match="key frame 0: frame: 'lift' has frames 0 to"):
            sessions.open("run", "sheet", "me", state=state)
        client.set("This one", "Delete")
        client.until(lambda: client.value("Key frame") == "frame 8")
        assert places_of_keys(session) == {8: list(SECOND)}
        client.set("This one", "Delete")
        client.until(lambda: client.value("Key frame") == "none yet")
        assert session.camera_path is None
