"""What the live simulation process does next, without simulating anything."""

import math
import socket
import threading
import time
from types import SimpleNamespace

from app.viewer.live.wire import DRIVE, PAUSE, RESUME, STEER, STEP, Message, send
from app.viewer.live.worker import Mailbox, PacedFrames, SimulationWorker


def simulate(number: int) -> Message:
    return Message("simulate", {"session": "a", "request": number, "is_held": False})


def of_session(kind: str, session: str = "a") -> Message:
    return Message(kind, {"session": session})


def contents(*messages: Message) -> list[Message] | None:
    mailbox = Mailbox()
    for message in messages:
        mailbox.put(message)
    return mailbox.take(wait=False)


def test_a_request_replaces_all_that_its_session_asked_for_before() -> None:
    other = of_session("prepare", "b")
    messages = (simulate(1), of_session(STEP), other, simulate(2), of_session(PAUSE))
    assert contents(*messages) == [simulate(2), of_session(PAUSE), other]
    assert contents(simulate(1), of_session("cancel")) == [of_session("cancel")]
    assert contents() == []


def test_of_what_steers_hands_only_the_newest_waits() -> None:
    def drive(number: int) -> Message:
        return Message(DRIVE, {"session": "a", "orders": [number]})

    steer, step = of_session(STEER), of_session(STEP)
    told = (drive(0), steer, *(drive(number) for number in range(1, 500)), step, drive(500))
    assert contents(*told) == [steer, step, drive(500)]
    assert contents(drive(1), of_session("close")) == [of_session("close")]


def test_a_mailbox_waits_no_longer_than_until_the_next_frame_is_due() -> None:
    mailbox = Mailbox()
    assert mailbox.take(wait=True, until=time.monotonic() + 1e-3) == []
    mailbox.put(simulate(1))
    assert mailbox.take(wait=True, until=0.0) == [simulate(1)]


def test_a_closed_mailbox_is_empty_for_good() -> None:
    mailbox = Mailbox()
    mailbox.put(simulate(1))
    mailbox.close()
    assert mailbox.take(wait=True) is None


def test_a_newer_request_replaces_the_active_one() -> None:
    with socket.socket() as connection:
        worker = SimulationWorker(connection, "cpu")
        worker._handle(of_session(STEP))  # Too late: nothing is simulated.
        worker._handle(simulate(1))
        first = worker._active["a"]
        worker._handle(of_session(PAUSE))
        assert worker._active["a"] is first
        worker._handle(simulate(2))
        assert worker._active["a"] is not first
        worker._handle(of_session("close"))
        assert worker._active == {}


def frames(*, is_held: bool) -> PacedFrames:
    """Frames of a simulation, which gives 0 before it computes the first."""
    return PacedFrames(iter(range(50)), is_held=is_held)


def advance(paced: PacedFrames) -> int:
    """Compute frames as long as that is allowed; returns how many."""
    count = 0
    while paced.may_advance and paced.advance():
        count += 1
    return max(count - 1, 0)


def test_a_held_simulation_shows_its_start_and_then_a_frame_a_step() -> None:
    paced = frames(is_held=True)
    assert advance(paced) == 1
    paced.set_pace(STEP)
    paced.set_pace(STEP)
    for _ in range(2):
        assert paced.may_advance
        paced.advance()
    assert not paced.may_advance


def test_going_on_ends_the_hold_and_pausing_begins_it() -> None:
    paced = frames(is_held=False)
    for _ in range(4):
        paced.advance()
    paced.set_pace(PAUSE)
    assert not paced.may_advance
    paced.set_pace(RESUME)
    assert advance(paced) > 40
    assert not paced.advance()


def test_a_pause_takes_back_the_steps_that_were_asked_for() -> None:
    paced = frames(is_held=True)
    assert advance(paced) == 1
    for pace in (STEP, STEP, PAUSE):
        paced.set_pace(pace)
    assert not paced.may_advance


def test_a_paced_simulation_waits_for_its_time_and_makes_up_for_nothing(monkeypatch) -> None:
    now = 100.0
    monkeypatch.setattr("app.viewer.live.worker.time", SimpleNamespace(monotonic=lambda: now))
    paced = PacedFrames(iter(range(50)), period=0.5)
    assert paced.due == -math.inf
    paced.advance()
    assert paced.due == 100.0
    paced.advance()
    assert paced.due == 100.5
    now = 100.6  # A little late: the next one comes the earlier.
    paced.advance()
    assert paced.due == 101.0
    now = 110.0  # Much too late.
    paced.advance()
    assert paced.due == 110.0
    paced.set_pace(PAUSE)
    assert paced.due == math.inf
    assert frames(is_held=False).due == -math.inf


def test_a_parent_that_closes_without_listening_ends_the_worker_without_a_word(caplog) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        send(ours, simulate(1))
        ours.close()
        SimulationWorker(theirs, "cpu").run()
        # Or it would read a socket that is closed, and perhaps somebody else's by then.
        assert "live-requests" not in {thread.name for thread in threading.enumerate()}
    assert [record for record in caplog.records if record.name == SimulationWorker.__module__] == []
