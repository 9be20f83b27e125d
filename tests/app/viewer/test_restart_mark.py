"""Where the timeline says that prediction starts from the observed state."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from support.physics.spring_world import content_of, two_springs
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, FakeSettings, FolderCatalog, make_run

from app.exports.making import load_rollout, store_rollout
from app.viewer.clock.restart_mark import mark_html, restart_frame
from app.viewer.sessions import Sessions
from physhandi.data.layout import SequenceFiles
from physhandi.fitted_object import FittedObject
from physhandi.simulation.restart import Restart

AT = 14


def test_the_tick_stands_where_the_slider_has_the_frame() -> None:
    html = mark_html(AT, FRAMES)
    assert f"{100 * AT / (FRAMES - 1):.1f}%" in html
    assert f"at frame {AT}" in html


def test_only_a_restart_that_a_frame_follows_is_marked() -> None:
    rollout = two_springs(frames=4)
    still = np.zeros((3, 3), np.float32)
    for frame, marked in ((0, 0), (2, 2), (3, None), (7, None)):
        restart = Restart(frame=frame, position=still, velocity=still)
        assert restart_frame(content_of(replace(rollout, restart=restart))) == marked
    assert restart_frame(content_of(rollout)) is None


def drawn(client: ViewerClient) -> str:
    """All HTML of the panel that takes room."""
    return "\n".join(
        str(props["content"])
        for props in client.gui.values()
        if "content" in props and props.get("visible", True)
    )


def test_a_live_simulation_restarts_too_and_another_sequence_does_not(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs/sheet")
    state = run.array("sequences/lift/rollout.npy")[AT] + np.float32([0.004, 0.003, -0.005])
    restart = Restart(frame=AT, position=state, velocity=np.zeros_like(state))
    save_file(restart.to_tensors(), run.out / SequenceFiles("lift").restart)
    told = f"prediction starts from the observed state at frame {AT}"
    sessions = Sessions(FakeSettings(), FolderCatalog(tmp_path))
    session = sessions.get(sessions.open("run", "sheet", "me"))
    try:
        with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
            client.until(lambda: told in drawn(client))
            client.set("drag [1/s]", 9.0)
            client.until(lambda: "every frame is new" in drawn(client))
            rollout, _ = session._object.at(FRAMES - 1)
            expected = FittedObject.of(run, "lift").simulate(drag=9.0)
            np.testing.assert_array_equal(rollout.position, expected.position)
            np.testing.assert_array_equal(rollout.strains(AT + 1), expected.strains(AT + 1))
            plain = rollout.model.rest_length - rollout.model_in(AT + 1).rest_length
            assert np.abs(plain).max() > 1e-4
            client.set("Sequence", "drag")
            client.until(lambda: session._content.sequence_name == "drag")
            client.until(lambda: told not in drawn(client))
    finally:
        sessions.shutdown()


def test_a_rollout_that_is_handed_over_for_a_file_keeps_its_restart(tmp_path: Path) -> None:
    rollout = two_springs(frames=4)
    state = rollout.position[1] + np.float32([0.1, 0.0, 0.0])
    state[0] = 0.0
    restart = Restart(frame=1, position=state, velocity=np.zeros_like(state))
    store_rollout(tmp_path, replace(rollout, restart=restart))
    again = load_rollout(tmp_path)
    np.testing.assert_array_equal(again.strains(2), replace(rollout, restart=restart).strains(2))
    assert again.strains(2)[0] != pytest.approx(rollout.strains(2)[0], abs=1e-3)
