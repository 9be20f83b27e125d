"""Colors, legend, clicks and keys of a live session, as a client sees them."""

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import PARAMETERS, hear_all, rest_at, show_parts

from app.keys import KEYS, LAYER_KEYS, Key
from app.viewer.color.colormaps import table
from app.viewer.content.layers import COLORINGS, Layers
from app.viewer.inspect.inspector import MARK
from app.viewer.ui.gestures import END_KEY

FRAME = 12


@pytest.fixture
def paused(sessions, run):
    """A session of the sheet that rests at one frame, and its client."""
    position = run.array("sequences/lift/rollout.npy")
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        show_parts(client)
        rest_at(client, FRAME)
        client.until(lambda: session._playback.frame == FRAME and not session._playback.is_playing)
        client.until(lambda: np.array_equal(shown(client), position[FRAME]))
        yield session, client


def shown(client) -> np.ndarray:
    """Where the nodes are drawn."""
    return client.array("/object/nodes", "points")


def color_count(client, name: str = "/object/nodes") -> int:
    """How many colors a node of the scene has."""
    return len(client.nodes.get(name, {}).get("colors", ())) // 3


def history(client, kind: str) -> list[np.ndarray]:
    """The curves of the plot of a quantity; none if there is none."""
    plots = (p["data"] for p in client.gui.values() if kind in str(p.get("series")))
    return list(next(plots, ()))


def texts(client) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def press(client, hotkey: str, modifier: str | None = None) -> None:
    client.until(lambda: (hotkey, modifier) in commands(client))
    client.send("CommandTriggerMessage", uuid=commands(client)[hotkey, modifier])


def commands(client) -> dict[tuple[str, str | None], str]:
    """The ids of the commands that are heard, by their keys."""
    return {
        (m["props"]["hotkey"], m["props"]["modifier"]): m["uuid"]
        for m in client.messages
        if m["type"] == "RegisterCommandMessage"
    }


def show_only_nodes(session, client) -> None:
    """Hide what holds the sheet, so that only nodes can be hit from above."""
    layers = session._view.scene.layers
    press(client, "6"), press(client, "5")
    client.until(lambda: not (layers.controls or layers.virtual_springs))
    client.until(lambda: client.visible.get("/springs/virtual") is False)


def click(client, target, *, shift: bool = False) -> None:
    """Click at a point of the scene, from above."""
    client.send(
        "ScenePointerMessage",
        event_type="click",
        ray_origin=(float(target[0]), float(target[1]), 3.0),
        ray_direction=(0.0, 0.0, -1.0),
        screen_pos=((0.5, 0.5),),
        modifier="shift" if shift else None,
    )


def test_colors_follow_the_choice_and_the_legend_says_what_they_mean(paused, run) -> None:
    _, client = paused
    client.until(lambda: color_count(client) == 1)
    client.set("Color by", "speed")
    client.until(lambda: color_count(client) == 81)
    client.until(lambda: "<b>Speed</b><span>m/s</span>" in texts(client))
    position = run.array("sequences/lift/rollout.npy")
    speed = 30.0 * np.linalg.norm(position[FRAME] - position[FRAME - 1], axis=1)
    ramp = table("sequential").astype(int)

    def is_painted() -> bool:
        """Whether the range, which is told after the colors, is that of the colors."""
        color, high = client.array("/object/nodes", "colors"), client.value("Range")[1]
        step = np.array([np.abs(ramp - c).sum(axis=1).argmin() for c in color.astype(int)])
        return np.allclose(step / 255, np.clip(speed / high, 0, 1), rtol=0, atol=0.01)

    client.until(is_painted)
    low, high = client.value("Range")
    assert low == 0
    assert 0.5 * speed.max() < high < 5 * speed.max()
    color = client.array("/object/nodes", "colors")
    # The springs have the colors of both ends, and the plain ones are hidden.
    client.until(lambda: client.visible.get("/springs/object") is False)
    client.until(lambda: color_count(client, "/springs/object_painted") > 1)

    client.set("Range", (0.0, 2.0 * high))
    client.until(lambda: client.value("Hold range") is True)
    client.until(lambda: client.array("/object/nodes", "colors").tolist() != color.tolist())
    client.set("Hold range", False)
    client.until(lambda: client.array("/object/nodes", "colors").tolist() == color.tolist())
    client.set("Color by", "plain")
    client.until(lambda: color_count(client) == 1)


def test_colors_are_sent_only_when_they_change(paused, run) -> None:
    session, client = paused
    position = run.array("sequences/lift/rollout.npy")
    client.set("Color by", "stiffness")
    client.until(lambda: color_count(client) == 81)

    def hear_out() -> None:
        with session._lock:  # Until a frame that is being drawn is drawn to its end.
            server = session._server
        hear_all(server, client)

    def sent(field: str) -> int:
        return sum(
            m["type"] == "SceneNodeUpdateMessage" and field in m["updates"] for m in client.messages
        )

    hear_out()
    before = sent("colors")
    session._playback.seek(FRAME + 3)
    client.until(lambda: np.array_equal(shown(client), position[FRAME + 3]))
    hear_out()
    assert sent("colors") == before
    client.set("Color by", "speed")
    client.until(lambda: sent("colors") > before)


def test_a_scene_opens_on_the_surface_which_is_drawn_plain_and_in_colors(sessions, run) -> None:
    position = run.array("sequences/lift/rollout.npy")
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.until(lambda: "/object/surface" in client.nodes)
        rest_at(client, FRAME)
        client.until(lambda: session._playback.frame == FRAME and not session._playback.is_playing)
        # It came with hand and forces alone: nothing else was sent.
        assert not [n for n in client.nodes if n.startswith(("/object/nodes", "/springs"))]
        surface = session._content.surface
        expected = surface.place(position[FRAME])
        client.until(lambda: np.array_equal(client.array("/object/surface", "vertices"), expected))
        np.testing.assert_array_equal(client.array("/object/surface", "faces"), surface.face)
        # No view has seen this object: it has one color.
        assert len(client.nodes["/object/surface"]["color"]) == 3
        client.set("Color by", "speed")
        count = 3 * (1 + surface.vertex_count)
        client.until(lambda: len(client.nodes["/object/surface"]["color"]) == count)
        color = np.frombuffer(bytes(client.nodes["/object/surface"]["color"]), np.uint8)
        color = color.reshape(-1, 3)
        np.testing.assert_allclose(color[0], np.maximum(color[1:].mean(axis=0), 32), atol=0.5)
        painted = session._view.scene.painter.paint(
            session._content.fitted, FRAME, session._view.scene.layers
        )
        np.testing.assert_array_equal(color[1:], painted.vertices(surface))
        assert len(np.unique(color[1:], axis=0)) > 20
        press(client, "3")
        client.until(lambda: client.visible.get("/object/surface") is False)


def test_a_click_reads_a_node_and_its_history_until_escape(paused, run) -> None:
    session, client = paused
    position = run.array("sequences/lift/rollout.npy")
    show_only_nodes(session, client)
    click(client, position[FRAME][40])
    client.until(lambda: "object node 40" in texts(client))
    client.until(lambda: {"/picked/point", "/picked/name"} <= set(client.nodes))
    np.testing.assert_allclose(client.array("/picked/point", "points")[0], position[FRAME][40])
    assert tuple(client.nodes["/picked/point"]["colors"]) == MARK
    assert client.nodes["/picked/name"]["text"] == "object node 40"
    said = texts(client)
    for name in ("position", "velocity", "stiffness", "damping", "strain", "held by"):
        assert name in said
    client.set("History of", "height")
    client.until(lambda: history(client, "height") and len(history(client, "height")[0]) > 2)
    _, height, now = history(client, "height")
    np.testing.assert_allclose(height, 1e3 * position[:, 40, 2], rtol=1e-6)
    # The frame on the screen is marked.
    assert int(np.argmax(now)) == FRAME

    press(client, "escape")
    client.until(lambda: "object node 40" not in texts(client))
    client.until(lambda: not history(client, "height"))


def test_a_click_beside_everything_keeps_what_was_read(paused, run) -> None:
    session, client = paused
    position = run.array("sequences/lift/rollout.npy")
    show_only_nodes(session, client)
    click(client, position[FRAME][40])
    client.until(lambda: "object node 40" in texts(client))
    click(client, (9.0, 9.0, 0.0))
    press(client, "arrowright")
    client.until(lambda: session._playback.frame == FRAME + 1)
    assert "object node 40" in texts(client)


def test_keys_move_the_clock_switch_layers_and_turn_colors_over(paused) -> None:
    session, client = paused
    press(client, "home")
    client.until(lambda: session._playback.frame == 0)
    press(client, "end")
    client.until(lambda: session._playback.frame == 19)
    press(client, "arrowleft", "shift")
    client.until(lambda: session._playback.frame == 9)
    press(client, "J")
    client.until(lambda: client.value("Speed") == pytest.approx(0.7))
    client.until(lambda: session._playback.is_playing)
    press(client, "L")
    client.until(lambda: client.value("Speed") == pytest.approx(1.0))
    # Again and again: the clock is started last of all that the key before does.
    client.until(lambda: press(client, "K") or not session._playback.is_playing)
    layers = session._view.scene.layers
    press(client, "2")
    client.until(lambda: not layers.nodes and client.visible.get("/object/nodes") is False)
    # The run has no hand: its key does nothing.
    press(client, "1")
    press(client, "C")
    client.until(lambda: client.value("Color by") == "error")
    assert layers.hands
    press(client, "C", "shift")
    client.until(lambda: client.value("Color by") == "plain")
    press(client, "C", "shift")
    client.until(lambda: client.value("Color by") == COLORINGS[-1])
    press(client, "T")
    client.until(lambda: layers.dark)
    client.tell_camera(position=(9.0, 9.0, 9.0))
    press(client, "R")
    client.until(lambda: abs(client.camera["position"][0]) < 2.0)


def test_a_re_simulated_rollout_has_the_same_colors(paused) -> None:
    session, client = paused
    client.set("Color by", "difference")
    client.until(lambda: "<b>Difference</b>" in texts(client))
    client.set("drag [1/s]", 15.0)
    client.until(lambda: session._object.at(FRAME)[0].parameters.drag == 15.0)
    client.until(lambda: client.value("Range")[1] > 1.5)
    rollout, at = session._object.at(FRAME)
    assert rollout.parameters.drag != PARAMETERS.drag
    distance = 1e3 * rollout.frame_distance(session._content.fitted, at)
    assert distance > 0
    # The range grows while the rollout is simulated.
    client.until(lambda: distance < client.value("Range")[1] * 2)
    client.until(lambda: color_count(client) == 81)


def test_every_hot_key_is_bound_once_and_listed(paused) -> None:
    _, client = paused
    bound = [
        (m["props"]["hotkey"], m["props"]["modifier"])
        for m in client.messages
        if m["type"] == "RegisterCommandMessage" and m["props"]["hotkey"] is not None
    ]
    keys: list[Key] = [key for group in KEYS for key in group.keys if key.action is not None]
    listed = [(hotkey, key.modifier) for key in keys for hotkey in key.hotkeys]
    assert len(set(listed)) == len(listed)
    assert len(set(bound)) == len(bound)
    groups = {group.title: group.keys for group in KEYS}
    elsewhere = {(hotkey, key.modifier) for key in groups["Compare"] for hotkey in key.hotkeys}
    assert set(listed) - elsewhere <= set(bound) - {END_KEY} <= set(listed)
    assert {field for field, _ in LAYER_KEYS} <= set(vars(Layers()))
