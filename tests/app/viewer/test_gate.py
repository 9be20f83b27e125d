import asyncio
import gzip
import json
import logging
import queue
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import uvicorn
import viser._messages
from fastapi import FastAPI
from support.viewer.viewer_client import PROTOCOL, ViewerClient
from support.viewer.viewer_world import FRAMES, hear_all, rest_at
from support.waiting import LIMIT_S, until
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from app.graceful_server import GracefulServer
from app.settings import WEB_ASSETS
from app.viewer.content.session_state import SessionState
from app.viewer.edit.selection import DrawnShape
from app.viewer.gate import create_gate
from app.viewer.sessions import Sessions


@pytest.fixture
def address(sessions: Sessions) -> Iterator[str]:
    app = FastAPI()
    app.include_router(create_gate(sessions))

    async def named(scope, receive, send) -> None:
        """Take the owner from a header, as the gatekeeper takes it from a cookie."""
        owner = dict(scope.get("headers", [])).get(b"x-owner", b"me").decode()
        await app(scope | {"state": {"owner": owner}}, receive, send)

    config = uvicorn.Config(
        named, host="127.0.0.1", port=0, log_level="warning", ws_per_message_deflate=False
    )
    server = GracefulServer(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    until(lambda: server.started)
    port = server.servers[0].sockets[0].getsockname()[1]
    yield f"127.0.0.1:{port}"
    server.should_exit = True
    thread.join()


def fetch(url: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    request = urllib.request.Request(url, body, headers=headers)  # noqa: S310
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def test_the_page_is_viser_s_with_one_script_and_nothing_else_is_served(address, sessions) -> None:
    session = sessions.open("run", "sheet", "me")
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    script = (WEB_ASSETS / "scene_frame.js").read_bytes()
    expected = page.read_bytes().replace(b"</head>", b"<script>%b</script></head>" % script)
    base = f"http://{address}/viewer/{session}"
    assert fetch(f"{base}/") == (200, expected)
    status, packed = fetch(f"{base}/", **{"Accept-Encoding": "gzip"})
    assert (status, gzip.decompress(packed)) == (200, expected)
    for path in (
        "/index.html",
        "/../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
    ):
        assert fetch(base + path)[0] == 404


def test_an_unknown_session_is_not_found(address) -> None:
    assert fetch(f"http://{address}/viewer/AAAAAAAAAAAAAAAAAAAAAAAA/")[0] == 404
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{address}/viewer/AAAA", subprotocols=[PROTOCOL], proxy=None)
    assert refused.value.response.status_code == 404


def test_keys_come_by_a_websocket_of_their_own_and_are_let_go_with_it(address, sessions) -> None:
    name = sessions.open("run", "sheet", "me")
    held: queue.Queue[frozenset[str]] = queue.Queue()
    keys = sessions.get(name).keys
    keys.attach(held.put, lambda _: None)
    url = f"ws://{address}/viewer/{name}/keys"
    with pytest.raises(InvalidStatus) as refused:
        connect(url, additional_headers={"X-Owner": "somebody else"}, proxy=None)
    assert refused.value.response.status_code == 404
    with connect(url, proxy=None) as page:
        assert json.loads(page.recv(timeout=LIMIT_S)) == {"steering": False}
        assert held.get(timeout=LIMIT_S) == frozenset()
        page.send('{"held": ["KeyW", "KeyL"]}')
        assert held.get(timeout=LIMIT_S) == {"KeyW", "KeyL"}
        page.send('{"held": ["F1"]}')
        assert "Invalid enum value 'F1'" in json.loads(page.recv(timeout=LIMIT_S))["error"]
        keys.tell({"steering": True})
        assert json.loads(page.recv(timeout=LIMIT_S)) == {"steering": True}
    assert held.get(timeout=LIMIT_S) == frozenset()
    with connect(url, proxy=None) as page:
        page.recv(timeout=LIMIT_S)
        for _ in range(20):
            page.send("[]")
        assert all("error" in json.loads(page.recv(timeout=LIMIT_S)) for _ in range(20))
        with pytest.raises(ConnectionClosed):
            page.recv(timeout=LIMIT_S)
    assert held.get(timeout=LIMIT_S) == frozenset()


def test_what_was_drawn_reaches_the_scene_that_is_edited(address, sessions) -> None:
    name = sessions.open("run", "sheet", "me")
    drawn: list[DrawnShape] = []
    sessions.get(name).select = drawn.append
    url = f"http://{address}/viewer/{name}/shape"
    shape = {"tool": "lasso", "way": "add", "points": [[0.1, 0.2], [0.3, 0.4], [0.5, 0.2]]}
    body = json.dumps(shape).encode()
    assert fetch(url, body, **{"X-Owner": "somebody else"})[0] == 404
    assert fetch(url, body)[0] == 204
    assert [item.points for item in drawn] == [((0.1, 0.2), (0.3, 0.4), (0.5, 0.2))]


@pytest.mark.parametrize("slash", ["", "/"])
def test_a_client_gets_the_scene_through_the_gate(address, sessions, slash) -> None:
    session = sessions.open("run", "sheet", "me")
    with ViewerClient(f"ws://{address}/viewer/{session}{slash}") as client:
        assert client.connection.subprotocol == PROTOCOL
        client.until(lambda: {"/object/surface", "/forces"} <= set(client.nodes))
        client.until(lambda: "object springs" in client.texts())
        client.until(lambda: sessions.list()[0].client_count == 1)
    until(lambda: sessions.list()[0].client_count == 0)


@pytest.mark.parametrize("offered", [None, ["chat"]])
def test_a_client_without_viser_s_protocol_is_refused(address, sessions, offered) -> None:
    session = sessions.open("run", "sheet", "me")
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{address}/viewer/{session}", subprotocols=offered, proxy=None)
    assert refused.value.response.status_code == 400


def test_a_frame_that_nobody_can_read_ends_its_connection_with_one_line(
    address, sessions, caplog
) -> None:
    session = sessions.open("run", "sheet", "me")
    frames = ["text", b"\x00\xc1" * 20, b"\x91" * 5000, msgspec.msgpack.encode({"type": "Nothing"})]
    for frame in frames:
        url = f"ws://{address}/viewer/{session}"
        with connect(url, subprotocols=[PROTOCOL], proxy=None, max_size=None) as client:
            client.send(frame)
            for _ in client:  # Until it is closed.
                pass
    told = [record for record in caplog.records if record.name == "websockets.server"]
    errors = [record for record in told if record.levelno >= logging.ERROR]
    assert len(errors) == len(frames)
    assert all(record.getMessage().startswith("a viewer's connection") for record in errors)
    assert not any(record.exc_info for record in errors)
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: client.nodes)


def test_closing_a_session_hangs_up(address, sessions) -> None:
    session = sessions.open("run", "sheet", "me")
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: client.nodes)
        sessions.close(session)
        with pytest.raises(ConnectionClosed):
            client.until(lambda: False)
    assert fetch(f"http://{address}/viewer/{session}/")[0] == 404


def test_another_browser_finds_nothing(address, sessions) -> None:
    session = sessions.open("run", "sheet", "me")
    url = f"http://{address}/viewer/{session}/"
    assert fetch(url)[0] == 200
    status, body = fetch(url, X_Owner="somebody")
    assert status == 404
    assert b"belongs to another browser" in body
    address = f"ws://{address}/viewer/{session}"
    for owner, allowed in (("somebody", False), ("me", True)):
        headers = {"X-Owner": owner}
        if allowed:
            with ViewerClient(address, additional_headers=headers) as client:
                client.until(lambda: "/object/surface" in client.nodes)
        else:
            with pytest.raises(InvalidStatus) as refused:
                ViewerClient(address, additional_headers=headers)
            assert refused.value.response.status_code == 404


@pytest.mark.parametrize(
    ("cookie", "ratio"),
    [
        ("pixel_ratio=2", 2.0),
        ("other=7; pixel_ratio=1.5625", 1.5625),
        ("pixel_ratio=50", 8.0),
        ("pixel_ratio=0", 0.25),
        ("pixel_ratio=1e9", 1.0),
        ("", 1.0),
    ],
)
def test_a_page_tells_how_sharp_its_screen_is(
    address, sessions: Sessions, cookie: str, ratio: float
) -> None:
    session = sessions.open("run", "sheet", "me")
    headers = {"Cookie": cookie} if cookie else {}
    with ViewerClient(f"ws://{address}/viewer/{session}", additional_headers=headers) as client:
        client.until(lambda: client.nodes)
        live = sessions.get(session)
        assert live is not None
        assert live.pixel_ratio == ratio


def first_positions(client: ViewerClient) -> list[tuple[float, ...]]:
    """Where the server wants the camera to be, in the order in which it told."""
    return [m["position"] for m in client.messages if m["type"] == "SetCameraPositionMessage"]


def test_a_tab_that_is_reloaded_keeps_its_session(address, sessions) -> None:
    session = sessions.open("run", "sheet", "me")
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: client.nodes)
        client.tell_camera(position=(0.5, 0.4, 0.3))
        live = sessions.get(session)
        client.until(lambda: live.state.pose is not None)
        client.until(lambda: live.state.pose.position.tolist() == [0.5, 0.4, 0.3])
    until(lambda: sessions.list()[0].client_count == 0)
    assert fetch(f"http://{address}/viewer/{session}/")[0] == 200
    assert [info.id for info in sessions.list()] == [session]
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: first_positions(client)[-1:] == [pytest.approx((0.5, 0.4, 0.3))])


def test_a_tab_may_come_back_before_its_scene_has_hung_up(
    address, sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_leaving, may_leave = threading.Event(), threading.Event()

    async def slow(connection: ClientConnection) -> None:
        is_leaving.set()
        assert await asyncio.to_thread(may_leave.wait, LIMIT_S)
        connection.transport.abort()

    monkeypatch.setattr(ClientConnection, "close", slow)
    session = sessions.open("run", "sheet", "me")
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: client.nodes)
    assert is_leaving.wait(LIMIT_S)
    status, _ = fetch(f"http://{address}/viewer/{session}/")
    may_leave.set()
    assert status == 200
    assert [info.id for info in sessions.list()] == [session]


def has_heard_all(state: SessionState) -> bool:
    """Whether all is set that `test_a_second_tab_gets_a_copy_with_the_same_state` sets.

    Each element of the panel is heard in a thread of its own.
    """
    assert state.layers is not None
    assert state.pose is not None
    return (
        (state.speed, state.theme, state.layers.dark) == (0.5, "dark", True)
        and state.part == (1, 3)
        and state.layers.nodes
        and state.pose.position.tolist() == [0.3, 0.2, 0.1]
        and (state.frame, state.is_playing) == (7, False)
    )


def test_a_second_tab_gets_a_copy_with_the_same_state(address, sessions) -> None:
    session = sessions.open("run", "sheet", "me")
    with ViewerClient(f"ws://{address}/viewer/{session}") as client:
        client.until(lambda: "object springs" in client.texts())
        client.until(lambda: client.find("stiffness"))
        slider = client.find("stiffness")
        client.set("Sequence", "drag")
        client.until(lambda: sessions.get(session)._content.sequence_name == "drag")
        client.until(lambda: client.find("stiffness") not in {slider, ""})
        # The clock stood while the other sequence was loaded; all that was said of it is heard.
        client.until(lambda: sessions.get(session)._playback.frame >= 2)
        hear_all(sessions.get(session)._server, client)
        rest_at(client, 7)
        client.set("Speed", 0.5)
        client.set("Part", [1, 3])
        client.set("Object nodes", True)
        client.set("Background", "dark")
        client.set("stiffness", -1.0)
        client.tell_camera(position=(0.3, 0.2, 0.1), look_at=(0.0, 0.1, 0.0))
        client.until(lambda: f"simulated {FRAMES}/{FRAMES}" in client.texts())
        client.until(lambda: "×0.1" in client.texts())
        client.until(lambda: has_heard_all(sessions.get(session).state))
        assert fetch(f"http://{address}/viewer/{session}/")[0] == 200  # After the redirect.
        own, copied = (sessions.get(info.id) for info in sessions.list())
        assert (own.id, copied.owner) == (session, "me")
        state = copied.state
        assert (state.sequence_name, state.frame, state.is_playing) == ("drag", 7, False)
        assert (state.speed, state.part, state.theme) == (0.5, (1, 3), "dark")
        assert state.parameters.stiffness_scale == pytest.approx(0.1)
        assert (state.layers.nodes, state.layers.dark) == (True, True)
        with ViewerClient(f"ws://{address}/viewer/{copied.id}") as second:
            second.until(lambda: f"simulated {FRAMES}/{FRAMES}" in second.texts())
            second.until(lambda: " from the fitted rollout" in second.texts())
            second.until(lambda: {"/object/nodes", "/forces"} <= set(second.nodes))
            second.until(lambda: first_positions(second)[-1:] == [pytest.approx((0.3, 0.2, 0.1))])
            wanted = {
                "Sequence": "drag",
                "Frame": 7,
                "Speed": 0.5,
                "Part": [1, 3],
                "stiffness": -1.0,
                "Object nodes": True,
                "Background": "dark",
            }
            second.until(lambda: {name: second.value(name) for name in wanted} == wanted)
            assert "/springs/virtual" not in second.nodes
            fitted = own._content.fitted.position[7]
            second.until(
                lambda: np.abs(second.array("/object/nodes", "points") - fitted).max() > 1e-4
            )
            other = second.array("/object/nodes", "points")
            client.until(
                lambda: (
                    "/object/nodes" in client.nodes
                    and np.array_equal(client.array("/object/nodes", "points"), other)
                )
            )


def test_no_client_can_open_a_public_tunnel(sessions) -> None:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    server = session._server
    assert server.get_host() == "127.0.0.1"
    handlers = server._websock_server._incoming_handlers
    assert viser._messages.ShareUrlRequest not in handlers
    assert viser._messages.GuiUpdateMessage in handlers
