"""The physics panel as its users work it, and what they keep of it."""

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, PARAMETERS
from support.waiting import LIMIT_S, until

from app.viewer.physics.history import TriedSetting
from app.viewer.physics.keep_panel import SavedRun, run_changes
from app.viewer.physics.parameters import Knob
from app.viewer.sessions import Sessions
from physhandi.errors import UsageError
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters


def watch(sessions: Sessions) -> ViewerClient:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    return ViewerClient(f"ws://127.0.0.1:{session.port}")


def drawn(client: ViewerClient) -> str:
    """All HTML of the panel that takes room."""
    return "\n".join(
        str(props["content"])
        for props in client.gui.values()
        if "content" in props and props.get("visible", True)
    )


def finish(client: ViewerClient) -> None:
    done = f"simulated {FRAMES}/{FRAMES}", "ms a frame", "mm from the fitted rollout"
    client.until(lambda: all(text in client.texts() for text in done))


def type_substeps(client: ViewerClient, number: int) -> None:
    client.set("substeps", "by hand")
    client.until(lambda: client.gui.get(client.find("number"), {}).get("visible") is True)
    client.set("number", number)


def test_a_held_simulation_is_stepped_and_the_strip_shows_what_is_new(sessions) -> None:
    with watch(sessions) as client:
        session = sessions.get(sessions.list()[0].id)
        client.set("Simulation", "Hold")
        client.until(lambda: "Held: the next simulation waits" in client.texts())
        assert "new" not in drawn(client)
        client.set("drag [1/s]", 9.0)
        client.until(lambda: f"frame 0 of {FRAMES - 1} is new" in drawn(client))
        for _ in range(4):
            client.set("Simulation", "1 frame")
        client.until(lambda: "Held at frame 4" in client.texts())
        client.until(lambda: f"frames 0 to 4 of {FRAMES - 1} are new" in drawn(client))
        assert f"{100 * 4 / (FRAMES - 1):.1f}%" in drawn(client)
        client.until(lambda: client.value("Frame") == 4)
        rollout, frame = session._object.at(4)
        assert (rollout.parameters.drag, frame) == (9.0, 4)
        assert session._object.at(5)[0].parameters.drag == PARAMETERS.drag
        client.set("Simulation", "Go")
        client.until(lambda: "every frame is new" in drawn(client))
        client.set("Steps", "Reset")
        client.until(lambda: "is new" not in drawn(client))


def test_stepping_begins_a_simulation_even_of_the_fitted_parameters(sessions) -> None:
    with watch(sessions) as client:
        client.set("Simulation", "1 frame")
        client.until(lambda: "Held at frame 1" in client.texts())
        client.set("Simulation", "Go")
        finish(client)
        client.until(lambda: "0 mm from the fitted rollout" in client.texts())


def test_presets_are_chosen_and_one_parameter_is_put_back(sessions) -> None:
    with watch(sessions) as client:
        client.set("Preset", "limp")
        finish(client)
        changed = "stiffness ×1 → ×0.1, damping [N·s/m] 2 → 0, drag [1/s] 3 → 0.5"
        client.until(lambda: changed in client.texts())
        client.until(lambda: client.value("drag [1/s]") == 0.5)
        client.set("Put back", "damping [N·s/m]")
        client.until(lambda: "stiffness ×1 → ×0.1, drag [1/s] 3 → 0.5" in client.texts())
        client.until(lambda: client.value("damping [N·s/m]") == 2.0)
        client.until(lambda: client.value("Preset") == "by hand")
        client.set("Steps", "Undo")
        client.until(lambda: client.value("Preset") == "limp")
        client.set("Preset", "as fitted")
        client.until(lambda: "nothing: parameters as fitted" in client.texts())
        client.until(lambda: client.value("stiffness") == 0.0)


def test_every_control_takes_the_same_value_again_after_a_reset(sessions) -> None:
    with watch(sessions) as client:
        session = sessions.get(sessions.list()[0].id)
        panel = session._object.panel
        history, fitted = panel.history, panel.history.setting
        client.set("Simulation", "Hold")  # What is asked for matters, and not what becomes of it.

        def press(name: str, expected: TriedSetting) -> None:
            client.set("Steps", name)
            client.until(lambda: history.setting == expected)
            written = threading.Event()
            with panel._lock:  # All that follows from it is handed to the event loop by then.
                session._guard.on_event_loop(written.set)
            client.until(written.is_set)
            for knob, control in controls:
                assert control.handle.value == knob.to_slider(expected.parameters)

        def take(label: str, value: Any, in_force: Callable[[], bool]) -> None:
            client.set(label, value)
            client.until(in_force)
            chosen = history.setting
            press("Reset", fitted)
            client.set(label, value)
            client.until(lambda: history.setting == chosen)
            press("Undo", fitted)
            press("Redo", chosen)
            press("Reset", fitted)

        controls = panel._sliders._controls
        assert len(controls) > 15
        for knob, control in controls:
            if control.handle.disabled:  # There is no ground whose height could be moved.
                continue
            start = control.handle.value
            value = not start
            if isinstance(knob, Knob):
                value = (start + (knob.high if start < knob.high else knob.low)) / 2
                value = round(value) if knob.is_integer else value
            expected = knob.from_slider(value)
            assert expected != getattr(fitted.parameters, knob.field)
            take(
                knob.label,
                value,
                lambda field=knob.field, to=expected: getattr(history.current, field) == to,
            )
        take("Preset", "limp", lambda: history.current.drag == 0.5)
        take("substeps", "automatic", lambda: history.is_automatic)


def test_own_presets_are_shared_by_all_scenes_and_deleted(sessions, storage, noted) -> None:
    with watch(sessions) as client, watch(sessions) as other:
        # Each slider is heard in a thread of its own: one after the other.
        client.set("drag [1/s]", 11.0)
        client.until(lambda: "drag [1/s] 3 → 11" in client.texts())
        client.set("substeps", "automatic")
        client.until(lambda: "substeps 30 → automatic" in client.texts())
        client.set("name", "Wet sheet")
        client.set("Save as", "Preset")
        client.until(lambda: client.value("Preset") == "★ Wet sheet")
        other.until(lambda: other.find("Preset"))
        other.until(lambda: "★ Wet sheet" in other.gui[other.find("Preset")]["options"])
        other.set("Preset", "★ Wet sheet")
        other.until(lambda: "substeps 30 → automatic" in other.texts())
        other.until(lambda: other.value("drag [1/s]") == 11.0)
        storage.presets.folder.joinpath("bad.yaml").write_text("format: <i>nothing</i>")
        other.until(lambda: other.find("Delete preset “Wet sheet”"))
        other.set("Delete preset “Wet sheet”", True)
        client.until(lambda: client.value("Preset") == "by hand")
        client.until(lambda: "presets/bad.yaml: format is missing" in drawn(client))
        assert [path.name for path in storage.presets.folder.iterdir()] == ["bad.yaml"]
        until(lambda: len(noted) == 2)
        assert noted == [("me", "keep a preset", None), ("me", "delete a preset", None)]


def test_the_ground_is_lowered_and_taken_away(sessions) -> None:
    with watch(sessions) as client:
        session = sessions.get(sessions.list()[0].id)
        client.until(lambda: "/ground" in client.positions)
        before = client.positions["/ground"][2]
        client.set("height [mm]", -40.0)
        finish(client)
        client.until(lambda: client.positions["/ground"][2] < before - 0.03)
        assert client.positions["/ground"][2] == pytest.approx(before - 0.04, abs=1e-6)
        assert session._object.at(0)[0].parameters.ground_height == pytest.approx(-0.04)
        client.set("ground", False)
        client.until(lambda: "ground on → off" in client.texts())
        client.until(lambda: session._object.at(FRAMES - 1)[0].parameters.ground_height is None)
        client.until(lambda: client.visible.get("/ground") is False)
        finish(client)
        client.set("ground", True)
        client.until(lambda: "ground" not in client.texts().partition("Changed")[2])


def test_too_few_substeps_are_warned_of_with_the_number_that_is_needed(sessions) -> None:
    with watch(sessions) as client:
        type_substeps(client, 4)
        client.until(lambda: "Too few substeps: 4 a frame" in client.texts())
        found = re.search(r"at least (\d+) are needed", client.texts())
        assert found is not None
        assert 4 < int(found[1]) <= PARAMETERS.substeps_per_frame
        client.set("number", int(found[1]))
        # All of it is one text, in which the number of substeps is that of the rollout it tells of.
        client.until(lambda: f"substeps {found[1]}<br/>" in client.texts())
        finish(client)
        assert f"substeps {found[1]}<br/>" in client.texts()
        assert "Too few" not in client.texts()
        client.set("δ virtual [mm]", 0.5)
        client.until(lambda: "No virtual spring: nothing holds the object" in client.texts())


def test_a_run_is_saved_with_what_the_sliders_changed(sessions, begun, noted) -> None:
    with watch(sessions) as client:
        client.set("drag [1/s]", 11.0)
        client.until(lambda: "drag [1/s] 3 → 11" in client.texts())
        client.set("gravity [m/s²]", 1.5)
        client.until(lambda: "gravity [m/s²] 9.81 → 1.5" in client.texts())
        client.set("Save as", "Run")
        client.until(lambda: client.is_told("Type a name"))
        assert begun == []
        client.set("name", "Moon <b>sheet</b>")
        client.set("Save as", "Run")
        client.until(lambda: begun)
        (run,) = begun
        opened = Run.open(run.folder)
        assert (opened.kind, opened.name) == ("simulation", "Moon <b>sheet</b>")
        assert opened.config["parameters"] == {
            "drag": 11.0,
            "gravity": 1.5,
            "uses_sequence_gravity": False,
        }
        assert Run.open(Path(opened.config["source"])).id == "sheet"
        until(lambda: noted)
        assert noted == [("me", "keep a run", run.id)]
        link = f"<a href='../../runs/{run.id}' target='_blank' rel='noopener'>"
        client.until(lambda: f"Saving run {link}Moon &lt;b&gt;sheet&lt;/b&gt;</a>" in drawn(client))
        with run.begin_attempt() as attempt:
            attempt.fail("the disk is full")
        client.until(lambda: "failed: the disk is full" in drawn(client))


def test_a_simulation_that_diverged_is_not_saved(sessions, begun) -> None:
    with watch(sessions) as client:
        client.set("stiffness", 1.0)
        client.until(lambda: "stiffness ×1 → ×10" in client.texts())
        type_substeps(client, 2)
        # More substeps may not do either: it must be these that it stopped with.
        client.until(lambda: "substeps 2<br/>" in client.texts())
        client.until(lambda: "Stopped at frame" in client.texts())
        client.until(lambda: "then it stopped" in drawn(client))
        client.set("name", "Broken")
        client.set("Save as", "Run")
        client.until(lambda: client.is_told("as a run it would"))
        assert begun == []


def test_what_a_run_is_told_gives_the_parameters_of_the_scene(run) -> None:
    stored = SimulationParameters.from_dict(run.yaml("object/parameters.yaml"))
    world = {"frame_rate": 60.0, "ground_height": 0.1, "gravity": 9.7}
    fitted = stored.in_world(**world)
    now = fitted.replace(ground_height=None, gravity=3.0, friction=1.5)
    changes = run_changes(run, fitted, now, is_automatic=False)
    assert "frame_rate" not in changes
    again = SimulationParameters.from_dict(stored.to_dict() | changes).in_world(**world)
    shown = {"uses_sequence_ground": False, "uses_sequence_gravity": False}
    assert again == now.replace(**shown)
    assert run_changes(run, fitted, fitted, is_automatic=True) == {"substeps_per_frame": "auto"}


def test_a_saved_run_is_followed_until_it_ends(storage, begun) -> None:
    run = storage.saver.save("sheet", "lift", "  A   name ", {"drag": 1.0})
    assert (run.name, begun) == ("A name", [run])
    told: list[SavedRun] = []
    thread = storage.saver.follow(run, told.append, threading.Event())
    until(lambda: len(told) == 1)
    with run.begin_attempt() as attempt:
        until(lambda: len(told) == 2)
        attempt.save_array("x.npy", np.zeros(3))
        attempt.publish()
    thread.join(LIMIT_S)
    assert [saved.state for saved in told] == ["queued", "running", "succeeded"]
    for name in ("", "x" * 81):
        with pytest.raises(UsageError, match="Type a name"):
            storage.saver.save("sheet", "lift", name, {})
