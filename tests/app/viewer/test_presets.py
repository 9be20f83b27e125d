import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from app.viewer.physics import kept_files
from app.viewer.physics.history import History
from app.viewer.physics.keep_panel import PresetChoice
from app.viewer.physics.presets import (
    AS_FITTED,
    BY_HAND,
    PRESET_FORMAT,
    PresetStore,
    builtin_presets,
    checked_name,
)
from app.viewer.ui.guard import Guard
from physhandi.errors import UsageError
from physhandi.simulation.parameters import SimulationParameters, parameter_changes

FITTED = SimulationParameters(connection_radius=0.035, drag=2.0, substeps_per_frame=230)


@pytest.fixture
def store(tmp_path: Path) -> PresetStore:
    return PresetStore(tmp_path / "presets")


def write(store: PresetStore, name: str, content: object) -> None:
    store.folder.mkdir(exist_ok=True)
    text = content if isinstance(content, str) else json.dumps(content)
    (store.folder / name).write_text(text, encoding="utf-8")


def good(**changes: object) -> dict[str, object]:
    return {"format": PRESET_FORMAT, "name": "Good", "parameters": {"drag": 5.0}} | changes


def test_built_in_presets_change_what_they_say() -> None:
    by_name = {preset.name: preset for preset in builtin_presets()}
    assert by_name[AS_FITTED].apply(FITTED) == (FITTED, False)
    stiff, is_automatic = by_name["stiff"].apply(FITTED)
    assert (stiff.stiffness_scale, is_automatic, stiff.drag) == (5.0, True, 2.0)
    # As the profiles of the paper and of PhysTwin have it (docs/conventions.md).
    paper, _ = by_name["paper's hold"].apply(FITTED)
    assert (paper.virtual_connection_radius, paper.virtual_max_neighbors) == (0.002, 3)
    twin, _ = by_name["PhysTwin's hold"].apply(FITTED)
    assert (twin.virtual_connection_radius, twin.virtual_max_neighbors) == (0.04, 50)
    assert (twin.use_control_velocity, twin.substeps_per_frame) == (False, 667)
    assert (twin.stiffness, twin.connection_radius) == (FITTED.stiffness, 0.035)
    assert by_name["on the moon"].apply(FITTED)[0].gravity == pytest.approx(1.62)


def test_presets_that_make_no_sense_for_an_object_are_not_offered() -> None:
    floating = SimulationParameters(ground_height=None)
    for unit, fitted, missing in (
        ("m", FITTED, set()),
        ("m", floating, {"ice", "trampoline"}),
        ("squares", FITTED, {"paper's hold", "PhysTwin's hold", "on the moon", "weightless"}),
    ):
        offered = {p.name for p in builtin_presets() if p.suits(fitted, unit)}
        assert {p.name for p in builtin_presets()} - offered == missing


def test_a_preset_is_kept_read_by_another_server_and_deleted(store) -> None:
    heard: list[int] = []
    stop = store.subscribe(lambda: heard.append(1))
    now = SimulationParameters.from_dict(FITTED.to_dict() | {"drag": 7.5, "ground_height": None})
    changes = parameter_changes(FITTED, now, is_automatic=True)
    store.save("  Wet   towel ", changes, "m")
    (path,) = store.folder.iterdir()
    assert path.name == "wet-towel.yaml"
    assert yaml.safe_load(path.read_text())["parameters"] == {
        "drag": 7.5,
        "ground_height": None,
        "substeps_per_frame": "auto",
    }
    (preset,), problems = PresetStore(store.folder).presets()
    assert (preset.name, preset.label, problems) == ("Wet towel", "★ Wet towel", ())
    assert preset.apply(FITTED) == (now, True)
    store.delete("Wet towel")
    assert list(store.folder.iterdir()) == []
    assert len(heard) == 2
    stop()
    store.save("Other", {"drag": 1.0}, "m")
    assert len(heard) == 2


def test_a_listener_that_fails_keeps_a_change_neither_from_its_user_nor_from_others(
    store, caplog
) -> None:
    heard: list[int] = []

    def fail() -> None:
        raise RuntimeError("this panel was removed")

    store.subscribe(fail)
    store.subscribe(lambda: heard.append(1))
    assert store.save("Wet towel", {"drag": 7.5}, "m").name == "Wet towel"
    assert heard == [1]
    store.delete("Wet towel")
    assert heard == [1, 1]
    told = [str(r.exc_info[1]) for r in caplog.records if r.name == kept_files.__name__]
    assert told == ["this panel was removed"] * 2


def test_the_same_name_replaces_and_another_one_of_the_same_letters_does_not(store) -> None:
    store.save("A b", {"drag": 1.0}, "m")
    store.save("a B", {"drag": 2.0}, "m")
    store.save("A-b", {"drag": 3.0}, "m")
    found = {p.name: p.changes["drag"] for p in store.presets()[0]}
    assert found == {"a B": 2.0, "A-b": 3.0}
    assert sorted(path.name for path in store.folder.iterdir()) == ["a-b-2.yaml", "a-b.yaml"]


def test_json_is_read_and_stays_json(store) -> None:
    write(store, "good.json", good())
    (preset,), _ = store.presets()
    assert preset.changes == {"drag": 5.0}
    store.save("Good", {"drag": 6.0}, "m")
    assert json.loads((store.folder / "good.json").read_text())["parameters"] == {"drag": 6.0}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("a: [", "it is not YAML or JSON"),
        ("just text", "it holds no fields"),
        (good(format="other/1"), "expected 'physhandi-preset/1'"),
        (good(color="red"), "field 'color' is unknown"),
        (good(name=7), "name and length_unit must be text"),
        (good(name="<b>x</b>"), "letters, digits"),
        (good(name="soft"), "is a preset of the program"),
        (good(parameters={}), "parameters is empty"),
        (good(parameters={"drag": [1, 2]}), "parameters.drag is a list"),
        (good(parameters={"dragg": 1}), "no simulation parameter 'dragg'. Do you mean 'drag'"),
        (good(parameters={"friction": 3}), r"friction is 3.0; expected"),
        (good(parameters={"drag": "fast"}), "drag is 'fast'; expected a number"),
        (good(parameters={"frame_rate": 60}), "frame_rate belongs to the recording"),
        ("x" * 70_000, "more than 64 kB"),
    ],
)
def test_a_bad_file_says_what_is_wrong_and_the_others_stay(store, content, told) -> None:
    write(store, "bad.yaml", content)
    write(store, "fine.yaml", good(name="Fine"))
    presets, problems = store.presets()
    assert [preset.name for preset in presets] == ["Fine"]
    (problem,) = problems
    assert problem.startswith("presets/bad.yaml: ")
    assert told in problem


def test_two_files_of_one_name_are_told(store) -> None:
    write(store, "a.yaml", good())
    write(store, "b.yaml", good(name="good"))
    presets, problems = store.presets()
    assert len(presets) == 1
    assert problems == ("presets/b.yaml: name 'good' is that of a.yaml too. Rename one.",)


def test_nothing_is_kept_without_a_name_or_a_change(store) -> None:
    for name in ("", "  ", "x" * 61, "As Fitted"):
        with pytest.raises(UsageError):
            checked_name(name)
    with pytest.raises(UsageError, match="Nothing is changed"):
        store.save("Empty", {}, "m")
    with pytest.raises(UsageError, match="no preset of yours called 'soft'"):
        store.delete("soft")
    assert not store.folder.exists()


class SharedList:
    """A list that viser's event loop, the program and a user's callback share."""

    def __init__(self, options: tuple[str, ...]) -> None:
        self.options = options
        self.value = options[0]
        self._heard: Callable[[Any], None] = lambda _: None

    def choose(self, value: str) -> None:
        self.receive(value)
        self.call()

    def receive(self, value: str) -> None:
        """Store a choice, as viser does before it calls anybody."""
        self.value = value

    def call(self) -> None:
        self._heard(SimpleNamespace(client=object()))

    def on_update(self, heard: Callable[[Any], None]) -> None:
        self._heard = heard


class Loop:
    """An event loop that works when it is told to."""

    def __init__(self) -> None:
        self._waiting: list[Callable[[], None]] = []

    def call_soon_threadsafe(self, action: Callable[[], None]) -> None:
        self._waiting.append(action)

    def work(self) -> None:
        while self._waiting:
            self._waiting.pop(0)()


def adopt(history: History, parameters: SimulationParameters, is_automatic: bool) -> None:
    history.replace(parameters, is_automatic=is_automatic)


@pytest.fixture
def shown_list() -> tuple[History, PresetChoice, SharedList, Loop]:
    """A history, the list of its presets, the control and its event loop."""
    history, lists, loop = History(FITTED), [], Loop()

    def add_dropdown(_name: str, options: tuple[str, ...], **_: object) -> SharedList:
        lists.append(SharedList(options))
        return lists[-1]

    gui: Any = SimpleNamespace(add_dropdown=add_dropdown)
    server: Any = SimpleNamespace(get_event_loop=lambda: loop)
    choice = PresetChoice(
        gui,
        Guard(server),
        history,
        length_unit="m",
        store=None,
        choose=lambda *setting: adopt(history, *setting),
    )
    loop.work()
    return history, choice, lists[0], loop


def test_a_choice_made_the_moment_the_list_changes_is_not_lost(shown_list) -> None:
    history, choice, shown, loop = shown_list
    shown.choose("limp")
    assert (history.current.drag, shown.value) == (0.5, "limp")
    history.set("drag", 9.0)
    choice.show()
    loop.work()
    assert shown.value == BY_HAND
    history.undo()
    choice.show()  # Says "limp"…
    shown.receive(AS_FITTED)  # …but the user has just chosen the fitted parameters…
    loop.work()
    assert shown.value == AS_FITTED
    shown.call()  # …which is heard now.
    choice.show()
    loop.work()
    assert (history.current, shown.value) == (FITTED, AS_FITTED)
    history.undo()
    choice.show()
    loop.work()
    assert shown.value == "limp"


def test_what_a_list_no_longer_offers_is_followed_again(shown_list) -> None:
    history, choice, shown, loop = shown_list
    shown.choose("limp")
    shown.options = (AS_FITTED, "limp")  # It was made with fewer presets than there are now.
    choice.refresh()
    loop.work()
    assert (shown.value, "stiff" in shown.options) == ("limp", True)
    history.reset()
    choice.show()
    loop.work()
    assert shown.value == AS_FITTED


def test_what_comes_after_the_server_has_stopped_is_let_go() -> None:
    loop, done = asyncio.new_event_loop(), []
    server: Any = SimpleNamespace(get_event_loop=lambda: loop)
    guard = Guard(server)
    guard.on_event_loop(lambda: done.append("before"))
    loop.call_soon(loop.stop)
    loop.run_forever()
    loop.close()
    guard.on_event_loop(lambda: done.append("after"))
    assert done == ["before"]
