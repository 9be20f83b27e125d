"""What users, clock and simulation do at the same moment ends right, whichever comes last."""

import asyncio
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, PARAMETERS, hear_all, rest_at
from support.waiting import LIMIT_S as PATIENCE
from support.waiting import WatchedLock, until

from app.viewer.compare.camera import Eye
from app.viewer.content.content import Content
from app.viewer.content.session_state import Pose
from app.viewer.live.client import LiveRequest, SimulationClient
from app.viewer.live.wire import Message
from app.viewer.physics.history import TriedSetting
from app.viewer.session import Session
from app.viewer.sessions import Sessions


@contextmanager
def watched(sessions: Sessions) -> Iterator[tuple[Session, ViewerClient]]:
    session = sessions.get(sessions.open("run", "sheet", "me"))
    assert isinstance(session, Session)
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.until(lambda: client.find("Pause") and client.find("Keep as A"))
        yield session, client


def beside(act: Callable[[], Any]) -> threading.Thread:
    thread = threading.Thread(target=act)
    thread.start()
    return thread


def until_it_waits(thread: threading.Thread, lock: WatchedLock) -> None:
    """Wait until a thread waits for a lock, or has ended without it."""
    until(lambda: thread.ident in lock.waiting or not thread.is_alive())


def write_all(session: Session) -> None:
    """Wait until viser's event loop has written what was handed to it."""
    loop = session._server.get_event_loop()
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop).result(PATIENCE)


class Interrupted(deque):
    """Those who wait for an event; another thread acts just before the next one joins them."""

    def __init__(self, waiting: deque, act: Callable[[], Any]) -> None:
        super().__init__(waiting)
        self._act: Callable[[], Any] | None = act

    def append(self, waiter: Any) -> None:
        act, self._act = self._act, None
        if act is not None:
            beside(act).join()
        super().append(waiter)


@pytest.mark.parametrize("whose", ["all", "one"])
def test_what_a_thread_sends_while_viser_goes_to_wait_arrives(server_client, whose: str) -> None:
    server, client = server_client
    target = server if whose == "all" else next(iter(server.get_clients().values()))
    sender = server._websock_server if target is server else target._websock_connection
    event = sender.get_message_buffer().message_event
    came = threading.Event()

    def send_between() -> None:
        target.gui.add_markdown("sent between looking and waiting")
        came.set()

    def interrupt() -> None:
        event._waiters = Interrupted(event._waiters, send_between)

    server.get_event_loop().call_soon_threadsafe(interrupt)
    target.gui.add_markdown("sent before")
    texts = "sent before", "sent between looking and waiting"
    client.until(lambda: all(text in client.texts() for text in texts))
    assert came.is_set()


def test_a_scrub_that_met_a_frame_on_its_way_is_told_where_it_stands(sessions: Sessions) -> None:
    with watched(sessions) as (session, client):
        playback, slider = session._playback, session._timeline._frame
        playback.set_speed(1e-4)  # Or the clock could come to the frame that is chosen.
        # A slider that lags behind may stand at the frame that is chosen, which is no change of it.
        until(lambda: slider.value == playback.frame)
        hear_all(session._server, client)
        frame = (playback.frame + FRAMES // 2) % FRAMES
        client.set("Frame", frame)
        client.until(lambda: client.find("Play"))
        # The browser was moved to the frame of the clock after it had sent its own.
        client.until(lambda: client.value("Frame") == frame)
        assert playback.frame == frame


def test_the_sequence_that_was_chosen_last_is_shown_though_it_was_read_first(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, client):
        load, begun, may_end, shown = session._load, *(threading.Event() for _ in range(3))

        def slow(name: str | None) -> Content:
            if name == "drag":
                begun.set()
                assert may_end.wait(PATIENCE)
            return load(name)

        replace = session._playback.replace
        monkeypatch.setattr(session, "_load", slow)
        monkeypatch.setattr(session._playback, "replace", lambda *a: (replace(*a), shown.set()))
        client.set("Sequence", "drag")
        assert begun.wait(PATIENCE)
        client.set("Sequence", "lift")
        assert shown.wait(PATIENCE)
        late = next(t for t in threading.enumerate() if _runs(t, "slow"))
        may_end.set()
        client.until(lambda: not _runs(late, "slow"))
        client.until(lambda: not _runs(late, "_switch"))
        assert session._content.sequence_name == "lift"


def _runs(thread: threading.Thread, function: str) -> bool:
    """Whether a thread is inside a function."""
    frame = sys._current_frames().get(thread.ident or 0)
    while frame is not None and frame.f_code.co_name != function:
        frame = frame.f_back
    return frame is not None


def test_frames_that_came_while_the_clock_stood_do_not_throw_it_back(sessions: Sessions) -> None:
    with watched(sessions) as (session, client):
        simulated, playback = session._object, session._playback
        assert simulated is not None
        simulated._rollouts._is_busy = True
        simulated._follow_frame(2, is_held=False)
        rest_at(client, 12)
        client.until(lambda: playback.frame == 12 and not playback.is_playing)
        simulated._follow_frame(15, is_held=False)
        playback.play()
        client.until(lambda: playback.frame == 14)


def test_a_frame_that_is_heard_after_the_way_back_does_not_hold_the_clock(
    sessions: Sessions,
) -> None:
    with watched(sessions) as (session, client):
        simulated, playback = session._object, session._playback
        assert simulated is not None
        playback.seek(0)
        assert playback.is_playing
        assert not simulated._rollouts.is_busy
        simulated._follow_frame(3, is_held=False)
        client.until(lambda: playback.frame > 6)


def test_the_errors_are_those_of_the_rollout_that_was_read_last(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, _):
        simulated = session._object
        assert simulated is not None
        old, new = object(), object()
        followed: list[object] = []
        has_begun, is_past = threading.Event(), threading.Event()
        lock, newer = WatchedLock(), threading.get_ident()

        def follow(rollout: object, *, at_once: bool) -> None:
            if rollout is old:
                has_begun.set()
                until(lambda: is_past.is_set() or newer in lock.waiting)
            followed.append(rollout)

        monkeypatch.setattr(simulated, "_lock", lock)
        monkeypatch.setattr(simulated._errors, "follow", follow)
        monkeypatch.setattr(simulated, "_show_readout", lambda **_: simulated._rollouts.readout)
        rollouts = type(simulated._rollouts)
        monkeypatch.setattr(
            rollouts, "newest", property(lambda _: new if has_begun.is_set() else old)
        )
        late = beside(lambda: simulated._follow("frame", 1))
        assert has_begun.wait(PATIENCE)
        simulated._follow("finished", FRAMES)
        is_past.set()
        late.join(PATIENCE)
        assert followed == [old, new]


def test_typed_ends_of_the_colors_are_not_replaced_before_they_are_heard(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, client):
        rest_at(client, 7)
        colors = session._colors
        colors.choose("speed")
        client.until(lambda: colors._range.handle.value != (0.0, 1.0))
        painter = colors._painter
        assert painter is not None
        with session._lock:  # A frame that is being drawn would write the ends of before.
            assert painter.legend is not None
            # As viser keeps what a user has typed, before it is told to anybody.
            colors._range.handle._impl.value = (0.25, 0.75)
            grown = SimpleNamespace(
                legend=replace(
                    painter.legend, scale=replace(painter.legend.scale, limits=(0.0, 40.0))
                ),
                offered=painter.offered,
                quantity=painter.quantity,
            )
            monkeypatch.setattr(colors, "_painter", grown)
            colors.show(is_playing=False, is_hidden=False)
            write_all(session)
            assert colors._range.handle.value == (0.25, 0.75)
            colors._type()
            factor = painter.quantity("speed").factor
            assert colors._layers.color_range == pytest.approx((0.25 / factor, 0.75 / factor))
            # What was heard follows the sequence again when it is let go.
            colors._layers.color_range = None
            colors.show(is_playing=False, is_hidden=False)
            write_all(session)
            assert colors._range.handle.value == pytest.approx((0.0, 40.0 * factor))


class SlowRollouts:
    """Takes its time with the first request, and notes what was asked for last."""

    def __init__(self, session: Session) -> None:
        assert session._object is not None
        self._rollouts = session._object._rollouts
        self.fitted = self._rollouts.fitted
        self.asked: list[Any] = []
        self.has_begun, self.may_end = threading.Event(), threading.Event()

    def request(self, parameters: Any, *, automatic_substeps: bool, edits: Any) -> None:
        assert not automatic_substeps
        assert edits == ()
        if not self.has_begun.is_set():
            self.has_begun.set()
            assert self.may_end.wait(PATIENCE)
        self.asked.append(parameters)


def test_what_is_moved_last_is_asked_for_last(sessions: Sessions) -> None:
    with watched(sessions) as (session, _):
        assert session._object is not None
        panel, rollouts = session._object.panel, SlowRollouts(session)
        panel._rollouts, panel._lock = rollouts, WatchedLock()
        controls = {knob.field: (knob, control) for knob, control in panel._sliders._controls}
        knob, control = controls["drag"]
        control.handle._impl.value = 7.0
        first = beside(lambda: panel._move(knob, control, 1))
        assert rollouts.has_begun.wait(PATIENCE)
        control.handle._impl.value = 9.0
        # Whichever comes first: what shows the parameters in force leaves what a user moved.

        def substeps() -> TriedSetting:
            return panel.history.set("substeps_per_frame", 77)

        others = [
            beside(lambda: panel._change(substeps)),
            beside(lambda: panel._move(knob, control, 1)),
        ]
        for thread in others:
            until_it_waits(thread, panel._lock)
        rollouts.may_end.set()
        for thread in (first, *others):
            thread.join(PATIENCE)
        now = panel.history.current
        assert (now.drag, now.substeps_per_frame) == (9.0, 77)
        assert rollouts.asked[-1] == now
        write_all(session)
        assert control.handle.value == 9.0


def test_a_number_that_is_typed_while_the_last_one_is_asked_for_is_simulated(
    sessions: Sessions,
) -> None:
    with watched(sessions) as (session, _):
        assert session._object is not None
        panel, rollouts = session._object.panel, SlowRollouts(session)
        panel._rollouts = rollouts
        choice = panel._substeps
        choice._followed.handle._impl.value = "by hand"
        choice._take_choice()
        write_all(session)
        choice._number.handle._impl.value = 4
        first = beside(lambda: choice._take_number(1))
        assert rollouts.has_begun.wait(PATIENCE)
        # As viser keeps what a user has typed, before it is told to anybody.
        choice._number.handle._impl.value = 9
        rollouts.may_end.set()
        first.join(PATIENCE)
        write_all(session)
        choice._take_number(1)
        write_all(session)
        assert choice._number.handle.value == 9
        assert [asked.substeps_per_frame for asked in rollouts.asked] == [4, 9]


def test_a_camera_is_not_aimed_at_a_figure_that_is_being_left(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, _):
        comparison = session._comparison
        comparison.toggle_figure()
        assert comparison._view is not None
        (viewer,) = session._server.get_clients().values()
        # By thread, since the browser's own answers to being aimed may aim as well.
        aimed: list[threading.Thread] = []
        monkeypatch.setattr(
            comparison._view, "_aim", lambda *_: aimed.append(threading.current_thread())
        )
        monkeypatch.setattr(comparison._cameras, "has_lost", lambda _: True)
        monkeypatch.setattr(comparison, "_lock", WatchedLock())
        comparison.turn(viewer)
        assert threading.current_thread() in aimed
        with comparison._lock:
            late = beside(lambda: comparison.turn(viewer))
            until_it_waits(late, comparison._lock)
            comparison._leave()
        late.join(PATIENCE)
        assert late not in aimed


def test_a_camera_that_leaves_is_kept_before_its_scene_closes_or_not_at_all(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, _):
        (viewer,) = session._server.get_clients().values()
        kept: list[object] = []
        monkeypatch.setattr(Pose, "give_first", lambda _, camera: kept.append(camera))
        monkeypatch.setattr(session, "_closing", WatchedLock())
        session._part(viewer)
        assert kept == [session._server.initial_camera]
        with session._closing:
            closing = beside(session.close)
            until_it_waits(closing, session._closing)
            assert not session._is_closed
        closing.join(PATIENCE)
        session._part(viewer)
        assert session._is_closed
        assert len(kept) == 1


def test_a_camera_that_is_heard_late_brings_no_comparison_back(sessions: Sessions) -> None:
    with watched(sessions) as (session, client):
        rest_at(client, 7)
        session._comparison.keep(is_fit=True)
        client.until(lambda: "/compare/a" in client.nodes)
        view = session._comparison._view
        assert view is not None
        assert "/compare/a" in view.drawing._nodes
        session._comparison.stop()
        view.drawing.turn(Eye(right=np.array([0.0, 1.0, 0.0]), up=np.array([0.0, 0.0, 1.0])))
        assert "/compare/a" not in view.drawing._nodes


def test_a_parameter_to_be_put_back_is_not_forgotten_before_it_is_heard(
    sessions: Sessions,
) -> None:
    with watched(sessions) as (session, client):
        assert session._object is not None
        panel = session._object.panel
        client.set("drag [1/s]", 9.0)
        # The last that is written of a change: what offers it has been handed in by then.
        client.until(lambda: "drag" in panel._changes.content)
        write_all(session)
        # As viser keeps what a user has chosen, before it is told to anybody.
        panel._put_back.handle._impl.value = "drag [1/s]"
        panel._show_changes()
        panel._put_one_back()
        assert panel.history.current.drag == PARAMETERS.drag
        client.until(lambda: client.value("Put back") == panel._put_back.handle.options[0])


def test_what_is_sent_again_to_a_new_process_comes_before_what_is_newer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, lock = SimulationClient("cpu"), WatchedLock()
    monkeypatch.setattr(live, "start", lambda: None)
    monkeypatch.setattr(live, "_lock", lock)
    monkeypatch.setattr(live, "_wake", SimpleNamespace(notify_all=lambda: None))
    request = LiveRequest(run=tmp_path, sequence="lift", parameters=PARAMETERS)
    live.hold("a", on=True)
    live.request("a", request)
    arrived: list[Message] = []
    threads: list[threading.Thread] = []

    def write(message: Message) -> None:
        if live._connection is None:
            return
        if not threads:
            for act in (
                lambda: live.hold("a", on=False),
                lambda: live.request("a", replace(request, sequence="drag")),
            ):
                threads.append(beside(act))
                until_it_waits(threads[-1], lock)  # It would overtake the message if it could.
        arrived.append(message)

    monkeypatch.setattr(live, "_write", write)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        live._connect(ours)
        for thread in threads:
            thread.join(PATIENCE)
    kinds = [message.kind for message in arrived]
    assert kinds[0] == "simulate"
    assert sorted(kinds[1:]) == ["resume", "simulate"]
    requests = [message for message in arrived if message.kind == "simulate"]
    assert [message["sequence"] for message in requests] == ["lift", "drag"]
    assert requests[0]["is_held"]
    assert live._unfinished["a"].message["sequence"] == "drag"
    assert not live._unfinished["a"].message["is_held"]
