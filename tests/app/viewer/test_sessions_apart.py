"""Sessions of one run that move side by side and must not notice each other."""

import asyncio
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import (
    FRAMES,
    PARAMETERS,
    FakeSettings,
    controls,
    hear_all,
    rest_at,
    sheet,
    show_parts,
)
from support.waiting import WatchedLock, until

from app.viewer import session
from app.viewer.live.client import STARTING
from app.viewer.session import ViewSwitch
from app.viewer.sessions import Session, Sessions
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

TABS = 10


@pytest.fixture
def many(catalog) -> Iterator[Sessions]:
    sessions = Sessions(FakeSettings(live_sessions=TABS), catalog)
    yield sessions
    sessions.shutdown()


def open_tab(sessions: Sessions) -> tuple[str, ViewerClient]:
    session_id = sessions.open("run", "sheet", "me")
    session = sessions.get(session_id)
    assert session is not None
    return session_id, ViewerClient(f"ws://127.0.0.1:{session.port}")


def stop_at(client: ViewerClient, frame: int) -> None:
    client.until(lambda: "object springs" in client.texts())
    show_parts(client)
    rest_at(client, frame)


def hear_out(session: Session, client: ViewerClient) -> None:
    """Take in all that a session says of a frame that it is drawing or has drawn."""
    with session._lock:  # Until a frame that is being drawn is drawn to its end.
        loop = session._server.get_event_loop()
    # The slider follows the clock in viser's own thread.
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop).result()
    hear_all(session._server, client)


def positions(client: ViewerClient) -> np.ndarray:
    return client.array("/object/nodes", "points")


def simulated(scale: float) -> np.ndarray:
    """The rollout of another stiffness, simulated here."""
    control = controls((0.0, 0.0, 1.0))
    parameters = PARAMETERS.replace(stiffness_scale=scale)
    return (
        Simulator(build_model(sheet(), control[0], parameters), parameters)
        .rollout(control)
        .position
    )


def test_two_tabs_stream_what_their_own_sliders_ask_for(many) -> None:
    (first_id, first), (second_id, second) = open_tab(many), open_tab(many)
    with first, second:
        stop_at(first, FRAMES - 1)
        stop_at(second, FRAMES - 1)
        fitted = simulated(1.0)[-1]
        second.until(lambda: np.allclose(positions(second), fitted, atol=1e-6))
        second.until(lambda: STARTING not in second.texts())
        own, other = many.get(second_id), many.get(first_id)
        hear_out(own, second)
        heard = len(second.messages)

        first.set("stiffness", -1.0)
        soft = simulated(0.1)[-1]
        assert np.abs(soft - fitted).max() > 1e-3
        first.until(lambda: np.allclose(positions(first), soft, atol=1e-6))
        first.set("Virtual springs", False)
        first.set("Speed", 2.0)
        first.tell_camera(position=(0.1, 0.2, 0.3))
        first.until(lambda: first.visible.get("/springs/virtual") is False)
        first.until(lambda: other.state.speed == 2.0)
        first.set("Play", True)
        first.until(lambda: any(p.get("label") == "Pause" for p in first.gui.values()))

        hear_out(own, second)
        assert len(second.messages[heard:]) == 1  # That of being asked to say all.
        assert own.state.parameters == PARAMETERS != other.state.parameters
        assert (own.state.is_playing, own.state.frame) == (False, FRAMES - 1)
        assert (own.state.speed, other.state.speed) == (1.0, 2.0)
        assert own.state.layers.virtual_springs
        assert own.state.pose.position == pytest.approx([1, 1, 1])

        # It is not merely frozen: it simulates what its own slider asks for.
        second.set("stiffness", 0.5)
        stiff = simulated(3.162)[-1]  # 10^0.5, as a factor of four digits.
        second.until(lambda: np.allclose(positions(second), stiff, atol=1e-6))
        assert np.abs(stiff - soft).max() > 1e-3
        assert other.state.parameters.stiffness_scale == pytest.approx(0.1)


@pytest.mark.slow
def test_ten_tabs_simulate_at_once(many) -> None:
    with ExitStack() as stack:
        clients = [stack.enter_context(open_tab(many)[1]) for _ in range(TABS)]
        for client in clients:
            stop_at(client, FRAMES - 1)
        exponents = [round(-1.0 + 0.1 * tab, 6) for tab in range(TABS)]
        for client, exponent in zip(clients, exponents, strict=True):
            client.set("stiffness", exponent)
        seen = []
        for client, exponent in zip(clients, exponents, strict=True):
            expected = simulated(float(f"{10.0**exponent:.4g}"))[-1]
            client.until(lambda c=client, e=expected: np.allclose(positions(c), e, atol=1e-6), 120)
            seen.append(expected)
        apart = [np.abs(a - b).max() for i, a in enumerate(seen) for b in seen[:i]]
        assert min(apart) > 1e-5


def test_what_was_closed_says_why_to_its_owner(catalog) -> None:
    settings = FakeSettings(live_sessions=2)
    sessions = Sessions(settings, catalog)
    try:
        session_id = sessions.open("run", "sheet", "me")
        sessions.get(session_id)._seen -= 1.0
        settings.live_idle_s = 0.2  # Not earlier: the sessions look after themselves, too.
        assert sessions.reap() == 1 or sessions.get(session_id) is None
        closed = sessions.closed_session(session_id, "me")
        assert (closed.kind, closed.target) == ("run", "sheet")
        assert closed.reason == "Nobody looked at it for 0.2 seconds."
        assert sessions.closed_session(session_id, "somebody") is None
        assert sessions.find(session_id, "me") is None
    finally:
        sessions.shutdown()


def test_one_s_own_forgotten_tab_makes_room(catalog) -> None:
    sessions = Sessions(FakeSettings(live_sessions=2), catalog)
    try:
        mine, theirs = sessions.open("run", "sheet", "me"), sessions.open("run", "sheet", "you")
        sessions.get(mine)._seen -= 60.0
        sessions.get(theirs)._seen -= 90.0
        new = sessions.open("run", "sheet", "me")
        assert {info.id for info in sessions.list()} == {theirs, new}
        assert sessions.closed_session(mine, "me").reason.startswith("It made room")
    finally:
        sessions.shutdown()


def test_one_session_draws_at_a_time(many, monkeypatch) -> None:
    turn, is_watched = WatchedLock(), threading.Event()
    lock, drawing, most = threading.Lock(), 0, 0
    drawn: Counter[int] = Counter()
    real = ViewSwitch.draw

    def draw(self: ViewSwitch, *given: object, **options: object) -> None:
        nonlocal drawing, most
        with lock:
            drawing += 1
            most = max(most, drawing)
        if is_watched.is_set():  # All scenes play now: another one wants to draw as well.
            until(lambda: turn.waiting or not is_watched.is_set())
            drawn[id(self)] += 1
        real(self, *given, **options)
        with lock:
            drawing -= 1

    monkeypatch.setattr(ViewSwitch, "draw", draw)
    monkeypatch.setattr(session, "TURN", turn)
    tabs = [open_tab(many) for _ in range(4)]
    with ExitStack() as stack:
        for _, client in tabs:
            stack.enter_context(client)
            client.until(lambda client=client: client.find("Pause"))
        is_watched.set()
        until(lambda: len(drawn) == len(tabs) and min(drawn.values()) > 3, lambda: drawn)
        is_watched.clear()
    assert most == 1
