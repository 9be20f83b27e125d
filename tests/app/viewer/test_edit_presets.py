"""Edits that users keep under a name: their files, what they fit, and the tab *Edit*."""

import hashlib
import json
import shutil
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.spring_world import two_springs
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FolderCatalog
from support.waiting import until

from app.viewer.physics.edit_presets import (
    EditPreset,
    EditPresetStore,
    ObjectMark,
    RecordingMark,
)
from app.viewer.sessions import Sessions
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.edits import AnyEdit, Cut, Join, Pin, ScaleMaterial

SOFT = ScaleMaterial(quantity="stiffness", factor=0.25, springs=((0, 1),))
PIN = Pin(nodes=(2,), places=((5.0, 5.0, 5.0),), frame=2)
HASH = hashlib.sha256(struct.pack("<2i", 0, 1)).hexdigest()
"""Of the one object spring of `two_springs`."""


@pytest.fixture
def store(tmp_path: Path) -> EditPresetStore:
    return EditPresetStore(tmp_path / "presets")


def preset(*edits: AnyEdit, name: str = "Torn", of: ObjectRollout | None = None) -> EditPreset:
    fitted = two_springs() if of is None else of
    return EditPreset(
        name=name,
        edits=edits,
        object=ObjectMark.of(fitted),
        recording=RecordingMark.of(fitted, "lift"),
    )


def good(**changes: object) -> dict[str, Any]:
    return {
        "format": "physhandi-edit-preset/1",
        "name": "Good",
        "object": {"nodes": 3, "springs": 1, "sha256": HASH},
        "recording": {"name": "lift", "frames": 4, "controls": 1},
        "edits": [{"kind": "cut", "springs": [[0, 1]]}],
    } | changes


def write(store: EditPresetStore, name: str, content: object) -> None:
    store.folder.mkdir(parents=True, exist_ok=True)
    text = content if isinstance(content, str) else json.dumps(content)
    (store.folder / name).write_text(text, encoding="utf-8")


def test_edits_are_kept_read_by_another_server_replaced_and_deleted(store) -> None:
    heard: list[int] = []
    store.subscribe(lambda: heard.append(1))
    kept = store.save(preset(SOFT, PIN, name="  Torn   corner "))
    assert kept.label == "★ Torn corner"
    (path,) = store.folder.iterdir()
    assert path.name == "torn-corner.json"
    stored = json.loads(path.read_text())
    assert {key: stored[key] for key in ("name", "object", "recording")} == {
        "name": "Torn corner",
        "object": {"nodes": 3, "springs": 1, "sha256": HASH},
        "recording": {"name": "lift", "frames": 4, "controls": 1},
    }
    assert stored["edits"][0]["factor"] == 0.25
    assert stored["edits"][1]["places"] == [[5.0, 5.0, 5.0]]
    other = EditPresetStore(store.folder.parent)
    assert other.presets() == ((kept,), ())
    other.save(preset(SOFT, name="torn CORNER"))
    (found,), _ = store.presets()
    assert (found.name, found.edits) == ("torn CORNER", (SOFT,))
    store.delete("torn CORNER")
    assert list(store.folder.iterdir()) == []
    assert len(heard) == 2


def test_edits_without_a_name_and_a_name_without_edits_are_not_kept(store) -> None:
    for name in ("", "x" * 61, "As fitted", "by hand", "<b>"):
        with pytest.raises(UsageError):
            store.save(preset(SOFT, name=name))
    with pytest.raises(UsageError, match="There are no edits yet"):
        store.save(preset())
    wide = Cut(springs=((2**31 - 2, 2**31 - 1),) * 200_000)
    with pytest.raises(UsageError, match="more than 4 MiB"):
        store.save(preset(wide))
    with pytest.raises(UsageError, match="no preset of edits of yours called 'Torn'"):
        store.delete("Torn")
    assert not store.folder.exists()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("a: [", "it holds no preset of edits"),
        ("[" * 5000, "it holds no preset of edits"),
        (good(format="physhandi-preset/1"), "- at `$.format`"),
        (good(color="red"), "unknown field `color`"),
        (good(name=7), "`$.name`"),
        (good(name="by hand"), "'by hand' is a preset of edits of the program"),
        (good(object={"nodes": -1, "springs": 1, "sha256": HASH}), "`$.object.nodes`"),
        (good(object={"nodes": 3, "springs": 1, "sha256": "x"}), "`$.object.sha256`"),
        (good(recording={"name": "lift"}), "required field `frames` - at `$.recording`"),
        (good(edits=[]), "field 'edits' is empty"),
        (good(edits=[{"kind": "melt"}]), "field 'edits' holds no edits"),
        (good(edits=[{"kind": "cut", "springs": [[0, -1]]}]), "`$[0].springs[0][1]`"),
        (" " * (4 * 2**20 + 1), "more than 4 MiB"),
    ],
)
def test_a_bad_file_says_what_is_wrong_and_the_others_stay(store, content, told) -> None:
    write(store, "bad.json", content)
    write(store, "fine.json", good(name="Fine"))
    found, (problem,) = store.presets()
    assert [kept.name for kept in found] == ["Fine"]
    assert found[0].edits == (Cut(springs=((0, 1),)),)
    assert problem.startswith("presets/edits/bad.json: ")
    assert told in problem


def test_edits_fit_every_object_with_the_same_nodes_and_springs() -> None:
    here = two_springs()
    more = replace(here.model, spring_nodes=np.array([[1, 0], [3, 0]], np.int32))
    turned = replace(here, model=more)
    preset(SOFT).check(turned, "lift")
    # Stored edits of the fit change nothing: the springs before them count.
    edited = replace(here, model=replace(here.model, pin_place=here.model.pin_place))
    edited.unedited = here.model
    preset(SOFT, PIN).check(edited, "lift")
    # Springs and nodes alone mean the same in every recording of the object.
    preset(SOFT).check(here, "another")


def test_what_differs_is_told() -> None:
    here, model = two_springs(), two_springs().model
    four = replace(
        model,
        object_node=np.zeros((4, 3), np.float32),
        initial_velocity=np.zeros((4, 3), np.float32),
        spring_nodes=np.array([[0, 1], [4, 0]], np.int32),
        clearance=np.zeros(4, np.float32),
    )
    joined = replace(model, spring_nodes=np.array([[0, 2], [3, 0]], np.int32))
    ends = np.array([[3, 1], [3, 0]], np.int32)
    held = np.repeat(model.attached, 2, axis=0)
    loose = replace(model, object_spring_count=0, spring_nodes=ends, attached=held)
    for other, told in (
        (four, "“Torn” cannot be applied: it was made on an object with 3 nodes, and this one has"),
        (loose, "it was made on an object with 1 springs, and this one has 0"),
        (joined, "this object has 1 springs, too, but they join other nodes"),
    ):
        with pytest.raises(UsageError, match=told):
            preset(SOFT).check(replace(here, model=other), "lift")
    both = preset(SOFT, PIN)
    with pytest.raises(UsageError, match="“Pin 1 node from frame 2 on” belongs to the recording"):
        both.check(here, "drag")
    with pytest.raises(UsageError, match="with 4 frames and 1 control nodes, and here it has 3"):
        both.check(two_springs(3), "lift")
    with pytest.raises(UsageError, match=r"Edit 2 .*there is no object node 9"):
        preset(SOFT, Join(springs=((0, 9),))).check(here, "lift")


@pytest.fixture
def twin(catalog: FolderCatalog) -> Iterator[str]:
    """Another run whose object has the same nodes and springs."""
    folder = catalog.root / "runs" / "twin"
    shutil.copytree(catalog.root / "runs" / "sheet", folder)
    yield folder.name
    shutil.rmtree(folder)  # The folder is every test's.


def watch(sessions: Sessions, run: str = "sheet", **options: Any) -> tuple[Any, ViewerClient]:
    session = sessions.get(sessions.open("run", run, "me", **options))
    return session, ViewerClient(f"ws://127.0.0.1:{session.port}")


def options(client: ViewerClient) -> tuple[str, ...]:
    found = client.find("Kept edits")
    return tuple(client.gui[found]["options"]) if found else ()


def keep(client: ViewerClient, name: str) -> None:
    client.set("Name of edits", name)
    client.set("Keep edits", True)
    client.until(lambda: client.value("Kept edits") == f"★ {name}")


def soften(session: Any, client: ViewerClient) -> None:
    """Make all springs half as stiff."""
    client.set("Selection", "All")
    client.until(lambda: session._edit.selection.nodes)
    client.set("Multiply", "Stiffness")
    client.until(lambda: session._object.panel.history.setting.edits)


def test_kept_edits_are_one_step_in_another_run_and_deleted(
    twin: str, sessions: Sessions, storage, noted
) -> None:
    session, client = watch(sessions)
    with client:
        client.until(lambda: options(client) == ("as fitted", "by hand"))
        client.set("Name of edits", "Half")
        client.set("Keep edits", True)
        client.until(lambda: client.is_told("There are no edits yet"))
        soften(session, client)
        client.until(lambda: client.value("Kept edits") == "by hand")
        keep(client, "Half")
        edits = session._object.panel.history.setting.edits
        assert [edit.title for edit in edits] == [
            f"Stiffness ×0.5 of {len(edits[0].springs)} springs"
        ]

        other, beside = watch(sessions, twin)
        with beside:
            beside.until(lambda: "★ Half" in options(beside))
            assert beside.value("Kept edits") == "as fitted"
            beside.set("drag [1/s]", 7.0)
            beside.until(lambda: other._object.panel.history.index == 1)
            beside.set("Kept edits", "★ Half")
            beside.until(lambda: beside.value("History") == "2 · Edits “Half”")
            history = other._object.panel.history
            assert (history.setting.edits, history.current.drag) == (edits, 7.0)
            beside.until(lambda: other._object.newest.edits == edits)
            fitted, model = other._content.fitted.model, other._object.newest.model
            own = slice(model.object_spring_count)
            np.testing.assert_allclose(model.stiffness[own], 0.5 * fitted.stiffness[own])
            beside.set("Steps", "Undo")
            beside.until(lambda: history.setting.edits == ())
            assert history.current.drag == 7.0
            beside.until(lambda: beside.value("History").startswith("1 · drag"))
            beside.set("Steps", "Redo")
            beside.until(lambda: beside.value("Kept edits") == "★ Half")
            beside.set("Kept edits", "as fitted")
            beside.until(lambda: beside.value("History") == "3 · Edits as fitted")

            client.until(lambda: client.find("Delete edits “Half”"))
            client.set("Delete edits “Half”", True)
            beside.until(lambda: options(beside) == ("as fitted", "by hand"))
            client.until(lambda: client.value("Kept edits") == "by hand")
    assert list(storage.edit_presets.folder.iterdir()) == []
    until(lambda: len(noted) == 2)
    assert noted == [("me", "keep edits", None), ("me", "delete edits", None)]


def test_kept_edits_are_there_after_a_reload_and_damaged_files_are_told(
    sessions: Sessions, storage
) -> None:
    session, client = watch(sessions)
    with client:
        soften(session, client)
        keep(client, "Half")
    edits = session._object.panel.history.setting.edits
    sessions.close(session.id)
    write(storage.edit_presets, "bad.json", good(color="<i>red</i>"))
    again, client = watch(sessions)
    with client:
        client.until(lambda: "presets/edits/bad.json: it holds no preset of edits" in said(client))
        assert "<i>red" not in said(client)
        client.set("Kept edits", "★ Half")
        client.until(lambda: again._object.panel.history.setting.edits == edits)
        client.until(lambda: client.value("History") == "1 · Edits “Half”")


def said(client: ViewerClient) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def test_edits_of_another_object_or_recording_change_nothing(sessions: Sessions, storage) -> None:
    write(storage.edit_presets, "other.json", good(name="Other"))
    session, client = watch(sessions)
    with client:
        client.until(lambda: "★ Other" in options(client))
        client.set("Kept edits", "★ Other")
        client.until(lambda: client.is_told("an object with 3 nodes, and this one has 81."))
        client.until(lambda: client.value("Kept edits") == "as fitted")
        assert session._object.panel.history.steps == (session._object.panel.history.begin,)
        client.set("Selection", "All")
        client.until(lambda: session._edit.selection.nodes)
        client.set("Nodes", "Pin")
        client.until(lambda: session._object.panel.history.setting.edits)
        keep(client, "Pinned")
        before = client.find("Kept edits")
        client.set("Sequence", "drag")
        client.until(lambda: "★ Pinned" in options(client) and client.find("Kept edits") != before)
        client.set("Kept edits", "★ Pinned")
        client.until(lambda: client.is_told("belongs to the recording 'lift', and this one is"))
        history = session._object.panel.history
        assert history.steps == (history.begin,)


def test_nothing_is_kept_where_nothing_may_be(sessions: Sessions, storage) -> None:
    write(storage.edit_presets, "good.json", good())
    _, client = watch(sessions, may_keep=False)
    with client:
        client.until(lambda: client.find("Multiply") and client.find("History"))
        client.until(lambda: "No edits." in said(client))
        labels = {props.get("label") for props in client.gui.values()}
        assert not labels & {"Kept edits", "Name of edits", "Keep edits", "Delete edits"}
