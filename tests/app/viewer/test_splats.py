"""Splats in a live scene: groups that move as their nodes do, and what stands in their place."""

import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from support.viewer.splat_world import splats_on, splats_seen
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FolderCatalog, hear_all, make_run, rest_at, sheet

from app.exports.permalink import state_from_query
from app.viewer.content.content import open_run_content
from app.viewer.content.layers import default_layers, next_form
from app.viewer.content.session_state import SessionState
from app.viewer.scene.framing import frame_content
from app.viewer.scene.scene import SceneDrawing
from app.viewer.scene.splat_groups import MOST_GROUPS, SplatGroups
from physhandi.appearance.splats import Splats
from physhandi.data.layout import SPLATS_FILE
from physhandi.errors import RunError
from physhandi.run import Run


def rolled(node: np.ndarray, radius: float) -> np.ndarray:
    """Roll a flat sheet round a cylinder along y."""
    angle = node[:, 0] / radius
    round_ = [radius * np.sin(angle), node[:, 1], node[:, 2] + radius * (1 - np.cos(angle))]
    return np.stack(round_, axis=1).astype(np.float32)


def with_splats(run: Run, name: str, splats: Splats) -> None:
    """Copy a run beside itself, and give it splats."""
    copy = Run.create(
        run.folder.parent / name, name=name, kind="reconstruction", sequences=["lift"], config={}
    )
    with copy.begin_attempt() as attempt:
        shutil.copytree(run.out, attempt.out, dirs_exist_ok=True)
        attempt.save_tensors(SPLATS_FILE, splats.to_tensors())
        attempt.publish()


@pytest.fixture(scope="module")
def splat_root(tmp_path_factory):
    """A folder with the run of the sheet, and a copy of it whose object has splats."""
    root = tmp_path_factory.mktemp("splats")
    run = make_run(root / "runs" / "sheet")
    with_splats(run, "seen", splats_on(sheet()))
    with_splats(run, "odd", splats_on(sheet()[:70]))
    return root


@pytest.fixture
def catalog(splat_root) -> FolderCatalog:
    return FolderCatalog(splat_root)


def test_groups_follow_a_rigid_motion_exactly() -> None:
    groups = SplatGroups.of(splats_on(sheet()))
    turn, way = Rotation.from_rotvec([0.4, -2.1, 0.9]), np.array([0.3, -0.2, 0.5])
    node = (turn.apply(sheet()) + way).astype(np.float32)
    expected = turn.apply(groups.splats.center) + way
    assert np.abs(expected - groups.splats.center).max() > 0.3
    np.testing.assert_allclose(groups.place(node), expected, atol=2e-6)


def test_groups_lie_as_near_as_rigid_ones_can_to_where_nodes_carry_them() -> None:
    groups = SplatGroups.of(splats_on(sheet()), most=20)
    node = rolled(sheet(), 0.06)
    carried = groups.binding.carry(node[None])[0].astype(np.float64)
    expected = np.empty_like(carried)
    for group in range(groups.count):
        its = groups.group == group
        rest, now = groups.splats.center[its].astype(np.float64), carried[its]
        turn = Rotation.align_vectors(now - now.mean(axis=0), rest - rest.mean(axis=0))[0]
        expected[its] = turn.apply(rest - rest.mean(axis=0)) + now.mean(axis=0)
    np.testing.assert_allclose(groups.place(node), expected, atol=1e-5)
    lost = np.linalg.norm(expected - carried, axis=1)
    assert 0.0003 < np.sqrt(np.mean(lost**2)) < 0.004


def test_more_groups_lose_less_of_a_bend() -> None:
    splats, node = splats_on(sheet(), 4_000), rolled(sheet(), 0.05)
    lost = []
    for most in (8, 24, MOST_GROUPS):
        groups = SplatGroups.of(splats, most)
        assert groups.count == most
        offset = groups.place(node) - groups.binding.carry(node[None])[0]
        lost.append(float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))))
    assert lost[0] > 1.5 * lost[1]
    assert lost[1] > 1.2 * lost[2]
    assert lost[2] < 0.0012


def test_a_scene_opens_on_the_surface_and_moves_splats_that_a_link_asks_for(
    sessions, run, catalog
) -> None:
    position = run.array("sequences/lift/rollout.npy")
    splats = splats_on(sheet())
    session = sessions.get(sessions.open("run", "seen", "me"))
    layers = session._view.scene.layers
    assert (layers.splats, layers.surface, layers.nodes) == (False, True, False)
    assert "splats" in session.offers
    assert "splats" not in sessions.get(sessions.open("run", "sheet", "me")).offers
    session = sessions.get(sessions.open("run", "seen", "me", state=as_splats()))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        rest_at(client, 17)
        # Of both messages that move a group, its place comes last.
        carried = SplatGroups.of(splats).place(position[17])

        def is_there() -> bool:
            names = [name for name in client.nodes if name.startswith("/object/splats/")]
            if len(names) < MOST_GROUPS or not all(name in client.positions for name in names):
                return False
            return cdist(splats_seen(client)[0], carried).min(axis=1).max() < 1e-4

        client.until(is_there)
        middle, color = splats_seen(client)
        assert np.abs(position[17] - position[0]).max() > 0.05
        which = cdist(middle, carried).argmin(axis=1)
        assert sorted(which) == list(range(len(splats.center)))
        np.testing.assert_allclose(color, splats.color[which], atol=1 / 255)


def as_splats() -> SessionState:
    """What a link to splats asks for."""
    state = state_from_query({"show": "hands,splats,ground"})
    return replace(state, is_playing=True)


def test_a_key_goes_through_what_an_object_is_shown_as(sessions) -> None:
    session = sessions.get(sessions.open("run", "seen", "me"))
    layers = session._view.scene.layers
    parts = ("/object/surface", "/object/splats", "/object/nodes")
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        rest_at(client, 5)
        client.until(lambda: drawn(client, parts) == {parts[0]})
        seen = []
        for part in (*parts[1:], parts[0]):
            client.until(lambda: commands(client).get("0"))
            client.send("CommandTriggerMessage", uuid=commands(client)["0"])
            client.until(lambda part=part: drawn(client, parts) == {part})
            seen.append((layers.splats, layers.surface, layers.nodes))
        assert seen == [(True, False, False), (False, False, True), (False, True, False)]
        labels = ("Splats", "Surface", "Object nodes")
        client.until(lambda: [client.value(label) for label in labels] == [False, True, False])


def drawn(client: ViewerClient, parts: tuple[str, ...]) -> set[str]:
    """Which of these parts of the scene are there and not hidden."""
    return {part for part in parts if part in client.nodes and client.visible.get(part, True)}


def commands(client: ViewerClient) -> dict[str, str]:
    """The ids of the commands, by their keys."""
    return {
        m["props"]["hotkey"]: m["uuid"]
        for m in client.messages
        if m["type"] == "RegisterCommandMessage" and m["props"]["modifier"] is None
    }


def test_the_surface_stands_for_splats_where_colors_mean_something(sessions) -> None:
    parts = ("/object/splats", "/object/surface")
    session = sessions.get(sessions.open("run", "seen", "me", state=as_splats()))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        rest_at(client, 9)
        client.until(lambda: drawn(client, parts) == {"/object/splats"})
        client.set("Color by", "speed")
        client.until(lambda: drawn(client, parts) == {"/object/surface"})
        client.until(lambda: len(client.nodes["/object/surface"].get("color", ())) > 3)
        assert client.value("Splats")
        assert not client.value("Surface")
        client.set("Color by", "plain")
        client.until(lambda: drawn(client, parts) == {"/object/splats"})


def test_what_comes_next_is_what_there_is(catalog) -> None:
    content = open_run_content(catalog, "seen")
    layers = default_layers(content)
    bare = replace(content, splats=None)
    assert next_form(layers, content) == "splats"
    assert next_form(default_layers(bare), bare) == "nodes"
    assert next_form(replace(layers, surface=False, splats=True), content) == "nodes"
    assert next_form(replace(layers, surface=False), content) == "surface"
    flat = replace(content, surface=None)
    assert (default_layers(flat).splats, default_layers(flat).nodes) == (True, False)
    assert next_form(replace(layers, surface=False), replace(bare, surface=None)) == "nodes"


def test_a_playing_frame_of_many_splats_is_small(server, catalog) -> None:
    content = open_run_content(catalog, "seen")
    content = replace(content, splats=splats_on(sheet(), 20_000))
    rollout = content.fitted
    assert rollout is not None
    scene = SceneDrawing(server, content, frame_content(content))
    scene.layers.splats, scene.layers.surface = True, False
    scene.draw(0, rollout, 0, is_playing=True)
    with ViewerClient(f"ws://127.0.0.1:{server.get_port()}") as client:
        hear_all(server, client)
        assert sum(name.startswith("/object/splats/") for name in client.nodes) == MOST_GROUPS
        assert (
            sum(client.nodes[n]["buffer"].size for n in client.nodes if "splats/" in n) == 160_000
        )
        before = client.bytes_received
        for frame in range(1, 7):
            scene.draw(frame, rollout, frame, is_playing=True)
            hear_all(server, client)
        # What lies on the ground reaches below it, and no line of the grid may be seen through it.
        ground: Any = server.scene._handle_from_node_name["/ground"]
        deep, extent = ground.position[2], frame_content(content).extent
        scene.layers.splats, scene.layers.surface = False, True
        scene.draw(7, rollout, 7, is_playing=True)
        assert ground.position[2] - deep == pytest.approx(0.014 * extent, rel=1e-3)
        moved = client.positions["/object/splats/000"]
        assert np.isfinite(moved).all()
        assert 3_000 < (client.bytes_received - before) / 6 < 40_000


def test_splats_of_another_object_are_refused_by_name(catalog) -> None:
    with pytest.raises(RunError, match=r"splats\.safetensors is damaged: rest_node has 70 nodes"):
        open_run_content(catalog, "odd")
