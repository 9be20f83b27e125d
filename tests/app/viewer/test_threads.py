"""What users, clock and simulation do at the same moment ends right, whichever comes last."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from viewer_client import ViewerClient
from viewer_world import FRAMES, PARAMETERS, rest_at

from app.viewer.compare.figure_camera import Eye
from app.viewer.content.content import Content
from app.viewer.live.client import LiveRequest, SimulationClient
from app.viewer.live.wire import Message
from app.viewer.physics.history import History
from app.viewer.physics.panel import SliderSet
from app.viewer.physics.parameters import Knob, knobs
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from app.viewer.ui.guard import Guard

PATIENCE = 30.0
SHORT = 0.3
"""For how long one thread waits for another one that may have to wait for it."""


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


def test_a_scrub_that_met_a_frame_on_its_way_is_told_where_it_stands(sessions: Sessions) -> None:
    with watched(sessions) as (session, client):
        session._playback.set_speed(0.1)
        frame = (client.value("Frame") + FRAMES // 2) % FRAMES
        client.set("Frame", frame)
        client.until(lambda: client.find("Play"))
        # The browser was moved to the frame of the clock after it had sent its own.
        client.until(lambda: client.value("Frame") == frame)
        assert session._playback.frame == frame


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
        simulated._resimulation._is_busy = True
        simulated._follow(2, is_held=False)
        rest_at(client, 12)
        client.until(lambda: playback.frame == 12 and not playback.is_playing)
        simulated._follow(15, is_held=False)
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
        assert not simulated._resimulation.is_busy
        simulated._follow(3, is_held=False)
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

        def follow(take: object, *, at_once: bool) -> None:
            if take is old:
                has_begun.set()
                is_past.wait(SHORT)
            followed.append(take)

        monkeypatch.setattr(simulated._errors, "follow", follow)
        monkeypatch.setattr(simulated, "_show_readout", lambda **_: simulated._resimulation.readout)
        resimulation = type(simulated._resimulation)
        monkeypatch.setattr(
            resimulation, "newest", property(lambda _: new if has_begun.is_set() else old)
        )
        late = beside(lambda: simulated._hear("frame", 1))
        assert has_begun.wait(PATIENCE)
        simulated._hear("finished", FRAMES)
        is_past.set()
        late.join(PATIENCE)
        assert followed == [old, new]


def test_typed_ends_of_the_colors_are_not_replaced_before_they_are_heard(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, client):
        rest_at(client, 7)
        colors = session._inspection.colors
        colors.choose("speed")
        client.until(lambda: colors._range.handle.value != (0.0, 1.0))
        painter = colors._painter
        assert painter is not None
        assert painter.legend is not None
        # As viser keeps what a user has typed, before it is told to anybody.
        colors._range.handle._impl.value = (0.25, 0.75)
        grown = SimpleNamespace(
            legend=replace(painter.legend, limits=(0.0, 40.0)), quantity=painter.quantity
        )
        monkeypatch.setattr(colors, "_painter", grown)
        colors.show(is_playing=False, is_hidden=False)
        assert colors._range.handle.value == (0.25, 0.75)
        colors._type()
        factor = painter.quantity("speed").factor
        assert colors._layers.color_range == pytest.approx((0.25 / factor, 0.75 / factor))
        # What was heard follows the sequence again when it is let go.
        colors._layers.color_range = None
        colors.show(is_playing=False, is_hidden=False)
        assert colors._range.handle.value == pytest.approx((0.0, 40.0 * factor))


def test_the_last_value_of_a_slider_is_in_force(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = History(PARAMETERS)
    sliders = SliderSet(server.gui, Guard(server), history, lambda: None)
    knob = next(k for k in knobs(PARAMETERS, length_unit="m") if k.field == "drag")
    assert isinstance(knob, Knob)
    sliders.add(knob)
    ((_, control),) = sliders._controls
    from_slider, has_read, is_set = Knob.from_slider, threading.Event(), threading.Event()

    def slow(knob: Knob, value: float) -> float | int:
        if value == 7.0:
            has_read.set()
            is_set.wait(SHORT)
        return from_slider(knob, value)

    monkeypatch.setattr(Knob, "from_slider", slow)
    control._impl.value = 7.0
    first = beside(lambda: sliders._move(knob, control))
    assert has_read.wait(PATIENCE)
    control._impl.value = 9.0
    sliders._move(knob, control)
    is_set.set()
    first.join(PATIENCE)
    assert history.current.drag == 9.0


def test_a_camera_is_not_aimed_at_a_figure_that_is_being_left(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(sessions) as (session, _):
        mode = session._figure
        mode.toggle()
        assert mode.is_on
        (viewer,) = session._server.get_clients().values()
        aimed: list[object] = []
        monkeypatch.setattr(mode, "_aim", lambda client, _: aimed.append(client))
        monkeypatch.setattr(mode.cameras, "has_lost", lambda _: True)
        mode.turn(viewer)
        assert aimed == [viewer]
        with mode._lock:
            late = beside(lambda: mode.turn(viewer))
            late.join(SHORT)
            mode._leave()
        late.join(PATIENCE)
        assert aimed == [viewer]


def test_a_camera_that_is_heard_late_brings_no_comparison_back(sessions: Sessions) -> None:
    with watched(sessions) as (session, client):
        rest_at(client, 7)
        session._pin.pin(is_fit=True)
        client.until(lambda: "/compare/a" in client.nodes)
        view = session._pin._view
        assert view is not None
        assert "/compare/a" in view.drawing._nodes
        session._pin.stop()
        view.drawing.turn(Eye(right=np.array([0.0, 1.0, 0.0]), up=np.array([0.0, 0.0, 1.0])))
        assert "/compare/a" not in view.drawing._nodes


def test_a_slider_and_the_number_of_substeps_do_not_take_each_other_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    history = History(PARAMETERS)
    has_read, is_set = threading.Event(), threading.Event()

    def slow(parameters: Any, **values: Any) -> Any:
        if "substeps_per_frame" in values:
            has_read.set()
            is_set.wait(SHORT)
        return replace(parameters, **values)

    monkeypatch.setattr("app.viewer.physics.history.replace", slow)
    late = beside(lambda: history.set_substeps(77))
    assert has_read.wait(PATIENCE)
    history.set("drag", 9.0)
    is_set.set()
    late.join(PATIENCE)
    assert (history.current.drag, history.current.substeps_per_frame) == (9.0, 77)


def test_a_parameter_to_be_put_back_is_not_forgotten_before_it_is_heard(
    sessions: Sessions,
) -> None:
    with watched(sessions) as (session, client):
        panel = session._object.panel if session._object is not None else None
        assert panel is not None
        client.set("drag [1/s]", 9.0)
        client.until(lambda: "drag [1/s]" in panel._changed)
        # As viser keeps what a user has chosen, before it is told to anybody.
        panel._put_back.handle._impl.value = "drag [1/s]"
        panel._show_changes()
        panel._put_one_back()
        assert panel.history.current.drag == PARAMETERS.drag
        client.until(lambda: client.value("Put back") == panel._put_back.handle.options[0])


def test_a_simulation_that_is_let_go_while_it_is_sent_again_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = SimulationClient("cpu")
    monkeypatch.setattr(live, "start", lambda: None)
    live.hold("a", on=True)
    live.request("a", LiveRequest(run=tmp_path, sequence="lift", parameters=PARAMETERS))
    arrived: list[Message] = []

    threads: list[threading.Thread] = []

    def write(message: Message) -> None:
        if message.kind == "simulate" and not threads:
            threads.append(beside(lambda: live.hold("a", on=False)))
            threads[0].join(SHORT)  # It would overtake the message if it could.
        arrived.append(message)

    monkeypatch.setattr(live, "_write", write)
    live._resend()
    threads[0].join(PATIENCE)
    assert [message.kind for message in arrived] == ["simulate", "resume"]
    assert arrived[0]["is_held"]
    live._resend()
    assert [message.kind for message in arrived[2:]] == ["simulate"]
    assert not arrived[2]["is_held"]
