"""Two runs in one session, as a client without a browser sees them."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import (
    FRAMES,
    PARAMETERS,
    FakeSettings,
    FolderCatalog,
    hear_all,
    make_run,
)

from app.viewer.compare.drawing import GHOST
from app.viewer.compare.pair import open_pair
from app.viewer.compare.request import CompareAsk
from app.viewer.compare.sides import ComparedSide, compared_rollouts
from app.viewer.export.snapshot import snapshot_npz
from app.viewer.scene.nodes import Plane
from app.viewer.sessions import Sessions
from physhandi.errors import MissingInputError, PhysHandiError, UsageError
from physhandi.object_rollout import load_fitted, load_surface
from physhandi.run import Run
from physhandi.simulation.object_surface import ObjectSurface

OFFSET = np.array([0.0, 0.003, 0.004])
"""By how much B's nodes are elsewhere: 5 mm."""
TURNED = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""A camera whose right hand is the world's y axis."""


def another_run(
    source: Run, folder: Path, *, step: int = 1, rate: float = 30.0, has_object: bool = True
) -> Run:
    """Copy a run with its nodes moved by `OFFSET` a frame, or every `step`-th node and no more."""
    run = Run.create(folder, name=folder.name, kind="reconstruction", sequences=["lift"], config={})
    at = "sequences/lift"
    with run.begin_attempt() as attempt:
        attempt.save_yaml("object/parameters.yaml", PARAMETERS.to_dict())
        meta = source.yaml(f"{at}/meta.yaml") | {"frame_rate": rate}
        position = source.array(f"{at}/rollout.npy")
        attempt.save_array(f"{at}/control.npy", source.array(f"{at}/control.npy"))
        tensors = source.tensors(f"{at}/model.safetensors")
        if step == 1:
            position = position + (np.arange(FRAMES)[:, None, None] * OFFSET).astype(np.float32)
        else:
            position = position[: FRAMES // 2, ::step]
            meta["frame_count"] = len(position)
            for name in ("object_node", "initial_velocity", "clearance"):
                tensors[name] = tensors[name][::step]
            for name in ("rest_length", "stiffness", "damping", "attached"):
                tensors[name] = tensors[name][:0]
            tensors["spring_nodes"] = tensors["spring_nodes"][:0]
            tensors["object_spring_count"] = np.zeros(1, np.int32)
        if has_object:
            attempt.save_array(f"{at}/rollout.npy", position)
            attempt.save_tensors(f"{at}/model.safetensors", tensors)
        attempt.save_yaml(f"{at}/meta.yaml", meta)
        attempt.publish()
    return Run.open(folder)


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> FolderCatalog:
    root = tmp_path_factory.mktemp("compare")
    source = make_run(root / "runs" / "sheet")
    another_run(source, root / "runs" / "moved")
    another_run(source, root / "runs" / "coarse", step=2)
    another_run(source, root / "runs" / "slow", rate=15.0)
    another_run(source, root / "runs" / "hands", has_object=False)
    return FolderCatalog(root)


@pytest.fixture(scope="module")
def sessions(catalog: FolderCatalog) -> Iterator[Sessions]:
    sessions = Sessions(FakeSettings(), catalog)
    yield sessions
    sessions.shutdown()


@contextmanager
def watch(sessions: Sessions, query: str) -> Iterator[ViewerClient]:
    """Look at a comparison, which is closed afterwards."""
    session_id = sessions.open("comparison", query, "me")
    session = sessions.get(session_id)
    assert session is not None
    try:
        with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
            yield client
    finally:
        sessions.close(session_id)


def said(client: ViewerClient) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def press(client: ViewerClient, hotkey: str) -> None:
    """Press a key, as the browser tells it."""
    client.until(lambda: hotkey in commands(client))
    client.send("CommandTriggerMessage", uuid=commands(client)[hotkey])


def commands(client: ViewerClient) -> dict[str, str]:
    """The ids of the commands that are heard, by their keys."""
    return {
        message["props"]["hotkey"]: message["uuid"]
        for message in client.messages
        if message["type"] == "RegisterCommandMessage" and message["props"]["modifier"] is None
    }


def nodes(client: ViewerClient, side: str) -> np.ndarray:
    return client.array(f"/compare/{side}/object/compared", "points")


def across(client: ViewerClient) -> np.ndarray:
    """The way from A to B."""
    a, b = (np.array(client.positions.get(f"/compare/{side}", (0, 0, 0))) for side in "ab")
    return b - a


def stand_along(client: ViewerClient, way: tuple[float, float, float]) -> bool:
    """Turn the camera, again and again as a browser does, until B stands this way from A."""
    client.tell_camera(wxyz=TURNED)
    distance = float(np.linalg.norm(across(client)))
    return distance > 0.2 and np.allclose(across(client) / distance, way, atol=1e-6)


def curves(client: ViewerClient) -> list[np.ndarray]:
    """Ticks, mean and largest difference, and the mark of the tick on the screen."""
    found = (p["data"] for p in client.gui.values() if "data" in p and "series" in p)
    return [np.asarray(column) for column in next(found, ())]


def is_laid(client: ViewerClient, surface: ObjectSurface, side: str, position: np.ndarray) -> bool:
    """Whether a side's surface is where its nodes are: all sides beside another one have one."""
    path, expected = f"/compare/{side}/object/surface", surface.place(position)
    there = client.nodes.get(path, {}).get("vertices", np.zeros(0))
    is_there = there.size == expected.size
    return is_there and np.allclose(client.array(path, "vertices"), expected, atol=1e-6)


def is_aimed(client: ViewerClient) -> bool:
    """Whether the camera shows both sides: with a long lens, and the way the first one looks.

    The server tells lens, place and what is looked at one after the other.
    """
    told = {m["type"]: m for m in client.messages if m.get("initial")}
    kinds = "SetCameraPositionMessage", "SetCameraLookAtMessage"
    if client.camera["fov"] > 0.3 or not set(kinds) <= set(told):
        return False
    (place, seen) = (
        np.array(told[k][f]) for k, f in zip(kinds, ("position", "look_at"), strict=True)
    )
    ahead = np.subtract(client.camera["look_at"], client.camera["position"])
    first = seen - place
    lengths = np.linalg.norm(ahead) * np.linalg.norm(first)
    return bool(ahead @ first > (1.0 - 1e-6) * lengths)


def test_both_sides_follow_one_clock_beside_each_other(
    sessions: Sessions, catalog: FolderCatalog
) -> None:
    run = catalog.run("sheet")
    rollout = run.array("sequences/lift/rollout.npy")
    surface = load_surface(run, load_fitted(run, "lift"), ())
    with watch(sessions, "a=sheet&b=moved&f=11") as client:
        client.until(lambda: "mean 55 mm" in said(client))
        client.until(lambda: "Each node of A from the same node of B" in said(client))
        client.until(lambda: is_laid(client, surface, "a", rollout[11]))
        client.until(lambda: is_laid(client, surface, "b", rollout[11] + 11 * OFFSET))
        # B stands to the right of the camera, wherever it looks, and the button exchanges them.
        client.until(lambda: is_aimed(client))
        client.until(lambda: stand_along(client, (0.0, 1.0, 0.0)))
        client.set("Swap sides", True)
        client.until(lambda: stand_along(client, (0.0, -1.0, 0.0)))
        # One clock: another frame moves both.
        client.set("Frame", 4)
        client.until(lambda: "mean 20 mm" in said(client))
        client.until(lambda: is_laid(client, surface, "a", rollout[4]))
        client.until(lambda: is_laid(client, surface, "b", rollout[4] + 4 * OFFSET))
        # The curves grow while they are measured; the mark is drawn with them.
        client.until(lambda: len(curves(client)[0]) == FRAMES)
        client.until(lambda: np.flatnonzero(curves(client)[3]).tolist() == [4])
        _, mean, largest, now = curves(client)
        np.testing.assert_allclose(mean, 5.0 * np.arange(FRAMES), atol=1e-3)
        np.testing.assert_allclose(largest, mean, atol=1e-3)
        assert now[4] > 0


def test_an_overlay_colors_the_difference_with_numbers(sessions: Sessions) -> None:
    with watch(sessions, "a=sheet&b=moved&f=11&mode=overlay&color=difference") as client:
        client.until(lambda: "≥100" in said(client) and "mean 55 mm" in said(client))
        # Neither is moved aside, which viser need not say.
        assert np.allclose(client.positions.get("/compare/a", 0.0), 0.0)
        # 55 of 100 mm is the middle of the scale: green, more than red and blue. The legend may
        # tell the scale before anything is drawn in it. A is the shadow of its nodes.
        client.until(lambda: surface_color(client, "b").argmax() == 1)
        client.until(lambda: client.visible.get("/compare/a/object/compared", True))
        client.until(lambda: only_color(client, "object/compared", "a").tolist() == [*GHOST])
        client.set("Frame", 0)
        client.until(lambda: surface_color(client, "b")[1] < 60)
        # Without the surface nodes and springs tell the same.
        client.set("Surface", False)
        client.set("Object nodes", True)
        client.set("Object springs", True)
        client.set("Frame", 11)
        client.until(lambda: client.visible.get("/compare/b/object/surface") is False)
        client.until(lambda: only_color(client, "object/compared").argmax() == 1)
        client.until(lambda: only_color(client, "springs/object_painted").argmax() == 1)
        # B fades into the white background, and A comes back in its own colors.
        client.set("A ↔ B", 0.0)
        client.until(lambda: client.visible.get("/compare/b/object/compared") is False)
        client.set("Colors of A and B", "of A and B")
        client.until(lambda: only_color(client, "object/compared", "a").tolist() == [47, 111, 222])


def test_surfaces_in_one_place_are_seen_through_and_named(
    sessions: Sessions, catalog: FolderCatalog
) -> None:
    run = catalog.run("sheet")
    surface = load_surface(run, load_fitted(run, "lift"), ())
    position = run.array("sequences/lift/rollout.npy")[3]

    def opacity(client: ViewerClient, side: str) -> float | None:
        return client.nodes.get(f"/compare/{side}/object/surface", {}).get("opacity", -1.0)

    with watch(sessions, "a=sheet&b=moved&f=3&mode=overlay") as client:
        client.until(lambda: is_laid(client, surface, "a", position))
        client.until(lambda: is_laid(client, surface, "b", position + 3 * OFFSET))
        assert np.allclose(client.positions.get("/compare/b", 0.0), 0.0)
        # Colors come by messages of their own, after the vertices.
        client.until(lambda: [surface_color(client, side).argmax() for side in "ab"] == [2, 0])
        client.until(lambda: opacity(client, "a") == opacity(client, "b") == 0.7)
        title = "/compare/title_b"
        client.until(lambda: client.nodes.get(title, {}).get("text") == "B · moved (orange)")
        client.set("A ↔ B", 0.75)
        client.until(lambda: (opacity(client, "a"), opacity(client, "b")) == (0.35, 0.7))
        client.set("A ↔ B", 1.0)
        client.until(lambda: client.visible.get("/compare/a/object/surface") is False)
        client.until(lambda: opacity(client, "b") is None)


def surface_color(client: ViewerClient, side: str) -> np.ndarray:
    """The mean color of a side's surface; bright red if it has none."""
    color = client.nodes.get(f"/compare/{side}/object/surface", {}).get("color", (255, 254, 254))
    return np.frombuffer(bytes(color), np.uint8).reshape(-1, 3)[0].astype(float)


def only_color(client: ViewerClient, part: str, side: str = "b") -> np.ndarray:
    """The one color that all of a part has; bright red if it has none or several."""
    colors = client.nodes.get(f"/compare/{side}/{part}", {}).get("colors", np.zeros(0))
    found = np.unique(colors.reshape(-1, 3), axis=0)
    return found[0] if len(found) == 1 else np.array([255, 254, 254])


def test_a_wipe_cuts_both_at_one_line(sessions: Sessions, catalog: FolderCatalog) -> None:
    run = catalog.run("sheet")
    sheet = run.array("sequences/lift/rollout.npy")[0]
    surface = load_surface(run, load_fitted(run, "lift"), ())
    whole = area(surface.place(sheet), surface.face)

    def areas(client: ViewerClient) -> np.ndarray:
        """How much of the sheet's surface both sides show."""
        shown = [client.nodes.get(f"/compare/{side}/object/surface", {}) for side in "ab"]
        if not all("faces" in node for node in shown):
            return np.zeros(2)
        arrays = [np.asarray(node["vertices"], float).reshape(-1, 3) for node in shown]
        faces = [np.asarray(node["faces"], int).reshape(-1, 3) for node in shown]
        if any(face.max() >= len(array) for array, face in zip(arrays, faces, strict=True)):
            return np.zeros(2)  # Faces come after the vertices that they join.
        return np.array([area(*its) for its in zip(arrays, faces, strict=True)])

    def parts(client: ViewerClient) -> tuple[int, int]:
        """How many nodes both sides show, if together they are the sheet; else none."""
        paths = [f"/compare/{side}/object/compared" for side in "ab"]
        if not set(paths) <= set(client.nodes):
            return 0, 0
        a, b = nodes(client, "a"), nodes(client, "b")
        both = np.concatenate([a, b])
        ordered = [part[np.lexsort(part.T.round(5))] for part in (both, sheet)]
        is_whole = len(both) == len(sheet) and np.allclose(*ordered, atol=1e-6)
        return (len(a), len(b)) if is_whole else (0, 0)

    # At another frame the clock stands still; the slider must have heard of it before it is moved.
    with watch(sessions, "a=sheet&b=moved&f=1&mode=wipe") as client:
        client.until(lambda: client.find("Frame") and client.value("Frame") == 1)
        client.set("Frame", 0)
        # At frame 0 both are one sheet: the parts together are the whole.
        client.until(lambda: abs(areas(client).sum() - whole) < 1e-5 * whole)
        assert areas(client).min() > 0.3 * whole
        client.set("Object nodes", True)
        client.until(lambda: min(parts(client)) > 10)
        before, _ = parts(client)
        client.until(lambda: client.gui.get(client.find("Line"), {}).get("visible") is True)
        client.set("Line", 0.2)
        client.until(lambda: 0 < parts(client)[0] < before)
        client.until(lambda: abs(areas(client).sum() - whole) < 1e-5 * whole)
        client.until(lambda: 0.1 * whole < areas(client)[0] < 0.3 * whole)
        client.set("Line", 0.0)
        client.until(lambda: client.visible.get("/compare/a/object/surface") is False)
        client.until(lambda: abs(areas(client)[1] - whole) < 1e-5 * whole)


def area(vertex: np.ndarray, face: np.ndarray) -> float:
    """How large triangles are together [m²]."""
    a, b, c = np.asarray(vertex, float)[face].transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_a_surface_is_cut_where_the_plane_is() -> None:
    # A unit square of two triangles, whose colors grow along x; x < 0.25 is kept.
    vertex = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    face = np.array([[0, 1, 2], [0, 2, 3]])
    color = np.array([[0, 9, 9], [200, 9, 9], [200, 9, 9], [0, 9, 9]], np.uint8)
    along_x = np.array([1.0, 0.0, 0.0], np.float32)
    for sign, kept, border in ((1.0, 0.25, True), (-1.0, 0.75, False)):
        plane = Plane(direction=sign * along_x, limit=sign * 0.25, has_border=border)
        part, its_face, its_color = plane.cut(vertex, face, color)
        assert area(part, its_face) == pytest.approx(kept, rel=1e-6)
        used = part[its_face.ravel()]
        assert (sign * used[:, 0] <= sign * 0.25 + 1e-6).all()
        assert np.isclose(used[:, 0], 0.25).any()
        np.testing.assert_allclose(its_color[:, 0], 200.0 * part[:, 0], atol=0.6)
        # Triangles look the same way as before.
        a, b, c = part[its_face].transpose(1, 0, 2)
        assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    whole = Plane(direction=along_x, limit=2.0, has_border=True).cut(vertex, face, color)
    np.testing.assert_array_equal(whole[0][whole[1]], vertex[face])
    assert (
        len(Plane(direction=along_x, limit=-1.0, has_border=True).cut(vertex, face, color)[1]) == 0
    )


def test_other_nodes_and_lengths_say_so(sessions: Sessions) -> None:
    with watch(sessions, "a=sheet&b=coarse&f=2") as client:
        client.until(lambda: "the common 0.3 s play" in said(client).replace("  ", " "))
        client.until(lambda: "made of different nodes" in said(client))
        frame = client.gui[client.find("Frame")]
        assert frame["max"] == FRAMES // 2 - 1


def test_what_cannot_be_compared_is_refused_or_told(catalog: FolderCatalog) -> None:
    for query, field in (
        ("a=sheet&b=sheet", "both run 'sheet'"),
        ("a=../x&b=sheet", "a"),
        ("a=sheet", "b"),
        ("b=sheet", "a"),
        ("a=sheet&b=moved&x=1", "x"),
        ("a=sheet&b=moved&f=-1", "f"),
        ("a=sheet&b=moved&mode=round", "mode"),
        ("a=sheet&b=moved&color=red", "color"),
    ):
        with pytest.raises(UsageError, match=f"(^|: .*){field}"):
            CompareAsk.parse(query)
    with pytest.raises(UsageError, match="In both: lift"):
        open_pair(catalog, CompareAsk(a="sheet", b="moved", sequence="drag"))
    with pytest.raises((PhysHandiError, MissingInputError)):
        open_pair(catalog, CompareAsk(a="sheet", b="nowhere"))
    told = open_pair(catalog, CompareAsk(a="sheet", b="hands"))
    assert not told.can_measure
    assert "B has no fitted object" in told.notes[0]
    slow = open_pair(catalog, CompareAsk(a="sheet", b="slow"))
    assert slow.clock.frames(10) == (10, 5)
    assert "A has 30 and B 15 frames/s" in slow.notes[0]


def test_without_a_second_object_there_is_no_empty_plot(sessions: Sessions) -> None:
    def shown(client: ViewerClient) -> list[bool]:
        return [p["visible"] for p in client.gui.values() if "data" in p and "series" in p]

    with watch(sessions, "a=sheet&b=hands") as client:
        client.until(lambda: "B has no fitted object" in said(client))
        client.until(lambda: shown(client) == [False])
    with watch(sessions, "a=sheet&b=moved") as client:
        client.until(lambda: "between A and B" in said(client))
        client.until(lambda: shown(client) == [True])


def test_an_ask_survives_its_query() -> None:
    ask = CompareAsk(a="x", b="y-1", sequence="a b&c", mode="wipe", color="difference", f=12)
    assert CompareAsk.parse(ask.query) == ask
    assert CompareAsk(a="x", b="y").query == "a=x&b=y"


def test_a_copy_and_a_closed_session_know_the_pair(sessions: Sessions) -> None:
    first = sessions.open("comparison", "a=sheet&b=moved&mode=overlay&f=7", "me")
    session = sessions.get(first)
    assert session is not None
    copied_id = sessions.copy(session)
    copied = sessions.get(copied_id)
    assert copied is not None
    assert copied.target == session.target == "a=sheet&b=moved&mode=overlay&f=7"
    assert sessions.find(first, "somebody else") is None
    sessions.close(first, "Enough.")
    sessions.close(copied_id)
    closed = sessions.closed_session(first, "me")
    assert closed is not None
    assert (closed.kind, closed.target) == ("comparison", session.target)


def test_a_side_without_a_rollout_is_left_out_of_files(catalog: FolderCatalog) -> None:
    content = open_pair(catalog, CompareAsk(a="sheet", b="moved")).contents[0]
    there, waiting = (
        ComparedSide(
            name=name,
            title=name,
            detail="",
            rollout=rollout,
            frame=4,
            content=content,
            content_frame=4,
        )
        for name, rollout in (("ours", content.fitted), ("phystwin", None))
    )
    assert compared_rollouts({"a": there, "b": waiting}) == {"ours": (content.fitted, 4)}


def test_the_numbers_of_both_sides_can_be_saved(sessions: Sessions) -> None:
    with watch(sessions, "a=sheet&b=moved&f=3") as client:
        client.until(lambda: client.find("Motion") != "")
        session = sessions.get(sessions.list()[0].id)
        assert session is not None
        with np.load(io.BytesIO(snapshot_npz(session.snapshot()))) as data:
            moved = data["b_position"] - data["a_position"]
        np.testing.assert_allclose(moved[3], np.tile(3 * OFFSET, (moved.shape[1], 1)), atol=1e-6)


def test_the_camera_comes_back_by_a_key(sessions: Sessions) -> None:
    with watch(sessions, "a=sheet&b=moved&f=3") as client:
        client.until(lambda: is_aimed(client))
        first = np.array(client.camera["look_at"])
        away = np.add(first, 0.5)
        client.tell_camera(look_at=away.tolist(), position=np.add(away, (1.0, 0.0, 0.0)).tolist())
        press(client, "R")
        client.until(lambda: np.linalg.norm(np.array(client.camera["look_at"]) - first) < 0.15)


def test_a_camera_that_was_not_moved_by_a_user_keeps_both_sides_in_its_picture(
    sessions: Sessions,
) -> None:
    with watch(sessions, "a=sheet&b=moved&f=3") as client:
        client.until(lambda: is_aimed(client))
        aimed = np.array(client.camera["position"])
        (session,) = sessions._sessions.values()
        first = session._server.initial_camera
        # A browser may hear where its first camera stands after it was told to look at both.
        client.tell_camera(
            position=first.position.tolist(), look_at=first.look_at.tolist(), fov=0.8
        )
        client.until(lambda: np.allclose(client.camera["position"], aimed, atol=1e-6))
        client.until(lambda: is_aimed(client))
        # Or of a part of it: both sides would be too small, or out of the picture.
        target, lens = np.array(client.camera["look_at"]), client.camera["fov"]
        for part in (
            {"fov": 0.8},
            {"look_at": first.look_at.tolist()},
            {"position": first.position.tolist()},
        ):
            (name,) = part
            client.tell_camera(**part)
            client.until(lambda name=name, part=part: client.camera[name] != part[name])
            client.until(lambda: np.allclose(client.camera["position"], aimed, atol=1e-6))
            client.until(lambda: np.allclose(client.camera["look_at"], target, atol=1e-6))
            assert client.camera["fov"] == lens
        # A window that is narrower needs a camera that is farther away.
        client.tell_camera(image_width=320)
        client.until(lambda: not np.allclose(client.camera["position"], aimed, atol=0.01))
        client.until(lambda: is_aimed(client))
        moved = np.add(client.camera["position"], 0.4).tolist()
        client.tell_camera(position=moved)
        client.tell_camera(image_width=900)
        # The sides follow the camera, so that it was heard, and it stays where the user put it.
        client.until(lambda: stand_along(client, (0.0, 1.0, 0.0)))
        hear_all(session._server, client)
        assert list(client.camera["position"]) == moved
