import json
import math
import re
import shutil
from typing import Any

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, FakeSettings

from app.exports.permalink import state_from_query
from app.viewer.compare.live import LiveComparison
from app.viewer.content.content import open_run_content
from app.viewer.content.session_state import Pose
from app.viewer.export.snapshot import snapshot_csv, snapshot_npz, snapshot_ply, snapshot_yaml
from app.viewer.restoring import complete_state
from app.viewer.sessions import Sessions, TooManySessionsError
from physhandi.errors import MissingInputError, PhysHandiError, RunError, UsageError
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters


def watch(sessions: Sessions, kind="run", target="sheet") -> ViewerClient:
    session = sessions.get(sessions.open(kind, target, "me"))
    return ViewerClient(f"ws://127.0.0.1:{session.port}")


def object_springs(client: ViewerClient) -> int:
    found = re.search(r"object springs (\d+)", client.texts())
    return int(found[1]) if found else -1


def test_a_slider_re_simulates_and_undo_goes_back(sessions) -> None:
    with watch(sessions) as client:
        client.until(lambda: "simulated" in client.texts())
        first = object_springs(client)
        client.set("δ object [mm]", 60.0)
        client.until(
            lambda: (
                f"simulated {FRAMES}/{FRAMES}" in client.texts() and object_springs(client) > first
            )
        )
        client.until(lambda: " ms a frame" in client.texts())
        client.until(lambda: "δ object [mm] 35 → 60" in client.texts())
        client.set("Steps", "Undo")
        client.until(lambda: object_springs(client) == first)
        client.until(lambda: client.value("δ object [mm]") == 35.0)


def far_from_fitted(text: str) -> float:
    found = re.search(r"([\d.]+) mm from the fitted rollout", text)
    return float(found[1]) if found else 0.0


def test_nodes_of_the_sheet_collide_when_the_box_is_ticked(sessions) -> None:
    with watch(sessions) as client:
        client.until(lambda: "simulated" in client.texts())
        client.set("also rest neighbors", True)
        client.set("distance [mm]", 20.0)
        client.set("nodes collide", True)
        client.until(
            lambda: (
                "nodes collide off → on" in client.texts()
                and "also rest neighbors off → on" in client.texts()
                and f"simulated {FRAMES}/{FRAMES}" in client.texts()
                and far_from_fitted(client.texts()) > 3.0
            )
        )
        client.set("Steps", "Reset")
        client.until(lambda: "as fitted" in client.texts())
        client.until(lambda: client.value("nodes collide") is False)


def test_a_diverged_simulation_is_told_and_the_slider_still_works(sessions) -> None:
    with watch(sessions) as client:
        client.until(lambda: "simulated" in client.texts())
        client.set("δ object [mm]", 80.0)
        client.set("d_max object", 60)
        client.set("damping [N·s/m]", 300.0)
        client.until(lambda: "Stopped at frame" in client.texts())
        client.until(
            lambda: any(
                "diverged" in json.dumps(m, default=str)
                for m in client.messages
                if "Notification" in m["type"]
            )
        )
        client.set("Steps", "Reset")
        client.until(lambda: "Stopped" not in client.texts())


def test_playing_starts_when_somebody_looks_and_scrubbing_stops_it(sessions) -> None:
    with watch(sessions) as client:
        client.until(lambda: any(p.get("label") == "Pause" for p in client.gui.values()))
        # The clock may just be at the value that a slider is moved to, which is no change of it;
        # it does not run backwards.
        client.set("Frame", 8)
        client.set("Frame", 7)
        client.until(lambda: any(p.get("label") == "Play" for p in client.gui.values()))
        session = sessions.get(sessions.list()[0].id)
        client.until(lambda: session._playback.frame == 7)
        assert not session._playback.is_playing


def test_the_other_sequence_of_a_run_can_be_chosen(sessions, run) -> None:
    with watch(sessions) as client:
        client.until(lambda: "simulated" in client.texts())
        client.until(lambda: client.find("stiffness"))
        before = client.find("stiffness")
        client.set("Sequence", "drag")
        session = sessions.get(sessions.list()[0].id)
        client.until(lambda: session._content.sequence_name == "drag")
        # The old panel may still be there: wait for the slider of the new one.
        client.until(lambda: before not in client.gui and "object springs" in client.texts())
        client.until(lambda: any(p.get("label") == "stiffness" for p in client.gui.values()))
        client.set("stiffness", -1.0)
        # The fitted rollout is simulated to its end already; only another one tells its pace.
        client.until(lambda: "×0.1" in client.texts() and " ms a frame" in client.texts())
        client.until(lambda: f"simulated {FRAMES}/{FRAMES}" in client.texts())
        rollout, _ = session._object.at(0)
        control = run.array("sequences/drag/control.npy")
        np.testing.assert_array_equal(np.asarray(rollout.control), control)


def test_an_error_in_a_callback_is_logged_and_shown(sessions, caplog) -> None:
    with watch(sessions) as client:
        client.until(lambda: "simulated" in client.texts())
        session = sessions.get(sessions.list()[0].id)

        def fail(*_: object) -> None:
            raise ValueError("the spring snapped")

        session._object.panel._simulate = fail
        client.set("drag [1/s]", 9.0)
        client.until(
            lambda: any("the spring snapped" in json.dumps(m, default=str) for m in client.messages)
        )
        assert "Traceback" in caplog.text


def test_a_recording_shows_keypoints_depth_and_cameras(sessions, recording) -> None:
    with watch(sessions, "sequence", recording.sequence.name) as client:
        client.until(lambda: "/observed" in client.nodes)
        client.until(lambda: {"/cameras/view0", "/cameras/view1"} <= set(client.nodes))
        client.until(lambda: "/hand/skeleton_0" in client.nodes)
        assert not any(name.startswith("/object") for name in client.nodes)
        assert not any(p.get("label") == "Preset" for p in client.gui.values())


def test_a_bare_cloud_stands_still_where_a_tracked_hand_plays(
    sessions, catalog, recording, monkeypatch
) -> None:
    bare = catalog.root / "sequences" / "bare"
    shutil.copytree(recording.sequence.folder, bare)
    for found in bare.rglob("keypoint.npy"):
        found.unlink()
    for name, plays in ((recording.sequence.name, True), ("bare", False)):
        session = sessions.get(sessions.open("sequence", name, "me"))
        asked: list[bool] = []
        monkeypatch.setattr(session._playback, "play", lambda *, on=True, to=asked: to.append(on))
        with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
            client.until(lambda asked=asked: asked)
        assert asked == [plays]
    shutil.rmtree(bare)  # The folder is every test's.


def test_hands_without_an_object_are_seen_before_the_first_video(
    sessions, catalog, recording
) -> None:
    name = recording.sequence.name
    run = Run.create(
        catalog.root / "runs" / "hands",
        name="hands",
        kind="reconstruction",
        sequences=[str(recording.sequence.folder)],
        config={},
    )
    vertex = np.random.default_rng(0).normal(0, 0.05, (4, 60, 3)).astype(np.float32)
    with run.begin_attempt() as attempt:
        attempt.save_array(f"sequences/{name}/hand_right_vertex.npy", vertex)
        meta = {"frame_rate": 30.0, "frame_count": 4, "metric": False, "length_unit": "squares"}
        attempt.save_yaml(f"sequences/{name}/meta.yaml", meta)
        attempt.publish()
    with watch(sessions, "run", "hands") as client:
        client.until(lambda: {"/hand/right", "/cameras/view1"} <= set(client.nodes))
        assert not any(p.get("label") == "Preset" for p in client.gui.values())
        session = sessions.get(sessions.list()[0].id)
        assert session.offers == ("recorded", "video")
        assert set(session._tabs._tabs) == {"Play", "Look", "Inspect", "Export"}
        pose = Pose.first(session._server.initial_camera)
        camera = recording.sequence.views[0].camera
        np.testing.assert_allclose(pose.position, camera.T_world_camera[:3, 3], atol=1e-6)
        client.until(lambda: client.nodes["/cameras/view0"]["scale"] > 0.2)
        ground = session._server.scene._handle_from_node_name["/ground"]
        client.until(lambda: not ground.visible)
        client.set("View from", "view1")
        client.until(lambda: client.nodes["/cameras/view1"]["scale"] > 0.2)
        assert session._inspector._scene._hand_opacity < 1.0  # The video's hand is seen through it.
        client.set("View from", "Overview")
        client.until(lambda: client.nodes["/cameras/view1"]["scale"] < 0.2)
        client.until(lambda: ground.visible)
        assert session._inspector._scene._hand_opacity is None
    for query, looks_from in (
        ({"f": "2"}, "view0"),
        ({"f": "2", "cam": "1,1,1,0,0,0"}, None),
        ({"f": "2", "show": "hands"}, None),
        ({"f": "2", "show": "hands", "from": "view1"}, "view1"),
    ):
        content = open_run_content(catalog, "hands")
        state = complete_state(state_from_query(query), content)
        assert state.layers.looks_from == looks_from, query


def test_downloads_hold_what_is_on_the_screen(sessions, run) -> None:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    session._playback.seek(4)
    snapshot = session.snapshot()
    ply = snapshot_ply(snapshot)
    header, _, body = ply.partition(b"end_header\n")
    count = 111 + session._content.surface.vertex_count
    assert b"element vertex %d\n" % count in header
    row = np.frombuffer(body[: 111 * 15], dtype="<3f4, 3u1")
    np.testing.assert_array_equal(row["f0"][:81], run.array("sequences/lift/rollout.npy")[4])
    np.testing.assert_array_equal(row["f0"][81:], run.array("sequences/lift/control.npy")[4])
    import io

    with np.load(io.BytesIO(snapshot_npz(snapshot))) as rollout:
        np.testing.assert_array_equal(rollout["position"], run.array("sequences/lift/rollout.npy"))
    rows = snapshot_csv(snapshot).decode().splitlines()
    assert len(rows) == FRAMES + 1
    import yaml

    parameters = SimulationParameters.from_dict(yaml.safe_load(snapshot_yaml(snapshot)))
    assert parameters == session._content.fitted.parameters


@pytest.fixture
def nobody_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long opening takes, no session counts as left."""
    monkeypatch.setattr("app.viewer.sessions._MAKES_ROOM_AFTER", math.inf)


@pytest.mark.usefixtures("nobody_makes_room")
def test_there_are_only_so_many_sessions(catalog) -> None:
    sessions = Sessions(FakeSettings(live_sessions=2), catalog)
    try:
        first = sessions.open("run", "sheet", "me")
        second = sessions.open("run", "sheet", "you")
        assert first != second
        assert len(first) >= 24
        with pytest.raises(TooManySessionsError, match="2 live sessions are open"):
            sessions.open("run", "sheet", "me")
        assert sessions.close(first)
        assert not sessions.close(first)
        sessions.open("run", "sheet", "me")
        assert [info.owner for info in sessions.list()] == ["you", "me"]
    finally:
        sessions.shutdown()
    assert sessions.list() == []
    assert sessions.live.is_closed


@pytest.mark.usefixtures("nobody_makes_room")
def test_what_cannot_be_shown_takes_no_place(catalog, tmp_path) -> None:
    sessions = Sessions(FakeSettings(live_sessions=1), catalog)
    try:
        with pytest.raises(RunError):
            sessions.open("run", "nothing", "me")
        with pytest.raises(UsageError):
            sessions.open("folder", "sheet", "me")
        empty = Run.create(
            catalog.root / "runs" / "empty",
            name="e",
            kind="reconstruction",
            sequences=["x"],
            config={},
        )
        with pytest.raises(MissingInputError, match="has no result for sequence 'x' yet"):
            sessions.open("run", empty.id, "me")
        sessions.open("run", "sheet", "me")
        with pytest.raises(PhysHandiError):
            sessions.open("run", "sheet", "me")
    finally:
        sessions.shutdown()


def test_a_session_that_nobody_looks_at_is_closed(catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.viewer.sessions._REAP_INTERVAL", 0.2)
    settings = FakeSettings()
    sessions = Sessions(settings, catalog)
    try:
        watched = sessions.open("run", "sheet", "me")
        with ViewerClient(f"ws://127.0.0.1:{sessions.get(watched).port}") as client:
            client.until(lambda: sessions.list()[0].client_count == 1)
            sessions.open("run", "sheet", "nobody")
            assert len(sessions.list()) == 2
            settings.live_idle_s = 0.4  # Not before both are there, however long that takes.
            client.until(lambda: len(sessions.list()) == 1)
            assert sessions.list()[0].id == watched
    finally:
        sessions.shutdown()


def test_the_clock_starts_before_all_else_so_that_nobody_has_stopped_it_yet(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    welcome, was_playing = LiveComparison.welcome, list[bool]()

    def watched(self: LiveComparison, client: Any) -> None:
        (session,) = sessions._sessions.values()
        was_playing.append(session._playback.is_playing)
        welcome(self, client)

    monkeypatch.setattr(LiveComparison, "welcome", watched)
    with watch(sessions) as client:
        client.until(lambda: was_playing == [True])
