import math
import time
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import (
    FRAMES,
    PARAMETERS,
    FakeSettings,
    FolderCatalog,
    content_of,
    controls,
    hear_all,
    make_run,
    rest_at,
)

from app.viewer.physics.error_panel import ErrorPanel, load_track_error
from app.viewer.sessions import Sessions
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run

ERRORS = [None, *[0.001 * frame for frame in range(1, FRAMES)]]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that knows the error of every frame but the first."""
    errors = {"unit": "m", "frames": list(range(FRAMES)), "rollout": {"track_error": ERRORS}}
    run = make_run(tmp_path_factory.mktemp("measured") / "runs" / "sheet")
    with run.begin_attempt() as attempt:
        for name in run.sequence_names:
            at = f"sequences/{name}"
            for array in ("rollout", "control"):
                attempt.save_array(f"{at}/{array}.npy", run.array(f"{at}/{array}.npy"))
            attempt.save_tensors(f"{at}/model.safetensors", run.tensors(f"{at}/model.safetensors"))
            attempt.save_yaml(f"{at}/meta.yaml", run.yaml(f"{at}/meta.yaml"))
            attempt.save_json(f"{at}/frame_errors.json", errors)
        attempt.save_yaml("object/parameters.yaml", PARAMETERS.to_dict())
        attempt.publish()
    return Run.open(run.folder)


@pytest.fixture
def content():
    return content_of({}, controls((0.0, 0.0, 1.0)))


def shifted_rollout(content, ready: int) -> ObjectRollout:
    """A rollout whose nodes are 2 mm a frame to the side of the fitted one."""
    fitted = content.fitted
    rollout = ObjectRollout.empty(fitted.model, fitted.parameters, fitted.control)
    rollout.position[:] = fitted.position
    rollout.position[..., 0] += 0.002 * np.arange(FRAMES)[:, None]
    rollout.ready = ready
    return rollout


def shown(client: ViewerClient) -> str:
    texts = (str(p.get("content", "")) for p in client.gui.values())
    return next((text for text in texts if "from the" in text), "")


def curves(client: ViewerClient) -> list[np.ndarray]:
    return next(p["data"] for p in client.gui.values() if "series" in p)


def is_marked(client: ViewerClient, frame: int) -> bool:
    """Whether the plot, which is written after the words, marks a frame of those from 1 on."""
    shown = curves(client)
    return len(shown) == 4 and shown[3].nonzero()[0].tolist() == [frame - 1]


@pytest.fixture
def panel(server_client, content) -> Iterator[tuple[ErrorPanel, ViewerClient]]:
    server, client = server_client
    error = np.array([math.nan if e is None else e for e in ERRORS])
    panel = ErrorPanel(server, content, content.fitted, error)
    client.until(lambda: any("series" in p for p in client.gui.values()))
    yield panel, client
    panel.remove()


def test_errors_are_read_in_their_frames(measured, run) -> None:
    error = load_track_error(measured, "lift", FRAMES + 2)
    assert np.isnan(error[[0, FRAMES, FRAMES + 1]]).all()
    np.testing.assert_allclose(error[1:FRAMES], ERRORS[1:])
    assert load_track_error(run, "lift", FRAMES) is None


def test_the_fit_and_the_re_simulation_are_told_for_the_current_frame(panel, content) -> None:
    panel, client = panel
    panel.show(7, is_playing=False)
    client.until(lambda: "fit 7 mm from the tracks" in shown(client))
    assert "re-simulated" not in shown(client)
    panel.follow(shifted_rollout(content, FRAMES), at_once=True)
    client.until(lambda: "re-simulated 14 mm from the fit" in shown(client))
    client.until(lambda: is_marked(client, 7) and curves(client)[2].any())
    frames, track, again, now = curves(client)
    np.testing.assert_array_equal(frames, np.arange(1, FRAMES))
    np.testing.assert_allclose(track, np.arange(1, FRAMES))
    np.testing.assert_allclose(again, 2.0 * np.arange(1, FRAMES), atol=1e-4)
    assert now[6] >= 2.0 * (FRAMES - 1)
    panel.follow(content.fitted, at_once=True)
    client.until(lambda: "re-simulated" not in shown(client))


def test_the_plot_grows_with_the_simulation_and_not_more_often_than_it_is_read(
    panel, content, server_client, monkeypatch: pytest.MonkeyPatch
) -> None:
    (panel, client), (server, _) = panel, server_client
    clock = SimpleNamespace(now=time.monotonic() + 1.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("app.viewer.physics.error_panel.time", clock)
    rollout = shifted_rollout(content, 5)
    panel.show(3, is_playing=False)
    panel.follow(rollout, at_once=True)
    client.until(lambda: len(curves(client)[0]) == 4)
    hear_all(server, client)
    before = len(client.messages)
    for _ in range(48):
        clock.now += 0.005
        rollout.ready = min(rollout.ready + 1, FRAMES - 1)
        panel.follow(rollout, at_once=False)
    hear_all(server, client)
    assert len(client.messages) - before == 1  # That of being asked to say all.
    clock.now += 0.02
    panel.follow(rollout, at_once=False)
    client.until(lambda: len(curves(client)[0]) == FRAMES - 2)
    rollout.ready = FRAMES
    panel.follow(rollout, at_once=True)
    client.until(lambda: len(curves(client)[0]) == FRAMES - 1)
    assert panel.errors == pytest.approx((0.003, 0.006), abs=1e-7)


def test_the_frame_at_which_the_clock_stops_is_told(panel) -> None:
    panel, client = panel
    panel.show(2, is_playing=False)
    for frame in (3, 4, 5):
        panel.show(frame, is_playing=True)
    panel.show(5, is_playing=False)
    client.until(lambda: "fit 5 mm" in shown(client))
    client.until(lambda: is_marked(client, 5))


def test_a_session_follows_frames_and_sliders(measured) -> None:
    sessions = Sessions(FakeSettings(), FolderCatalog(measured.folder.parents[1]))
    try:
        session = sessions.get(sessions.open("run", "sheet", "me"))
        with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
            client.until(lambda: "object springs" in client.texts())
            rest_at(client, 9)
            client.until(lambda: "fit 9 mm from the tracks" in shown(client))
            client.set("stiffness", -1.0)
            client.until(lambda: "re-simulated" in shown(client))
            client.until(lambda: f"simulated {FRAMES}/{FRAMES}" in client.texts())
            rollout, _ = session._object.at(0)
            offset = rollout.position - measured.array("sequences/lift/rollout.npy")
            expected = 1e3 * np.linalg.norm(offset[9].astype(np.float64), axis=1).mean()
            assert expected > 0.1
            client.until(lambda: f"re-simulated {expected:.3g} mm" in shown(client))
            client.set("Steps", "Reset")
            client.until(lambda: "re-simulated" not in shown(client))
    finally:
        sessions.shutdown()


def test_a_slider_that_is_not_as_fitted_has_a_dot(sessions) -> None:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.until(lambda: "object springs" in client.texts())
        labels = lambda: {str(p.get("label")) for p in client.gui.values()}  # noqa: E731
        client.until(lambda: "drag [1/s]" in labels())
        client.set("drag [1/s]", 9.0)
        client.until(lambda: "● drag [1/s]" in labels())
        assert "drag [1/s]" not in labels()
        assert sum(label.startswith("● ") for label in labels()) == 1
        client.set("Steps", "Undo")
        client.until(lambda: "drag [1/s]" in labels())


def test_warnings_of_the_fit_are_told_without_what_html_could_mean(server_client, content) -> None:
    server, client = server_client
    codes = ["loose_nodes", "worse_than_static", "loose_nodes", "<b>x"]
    panel = ErrorPanel(server, content, content.fitted, None, codes)

    def told() -> str:
        texts = (str(p.get("content", "")) for p in client.gui.values())
        return next((text for text in texts if "Warnings" in text), "")

    client.until(lambda: "of the fit: loose nodes, worse than static," in told())
    assert "<b>x" not in told()
    panel.remove()
