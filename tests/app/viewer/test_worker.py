"""What the live simulation process does next, without simulating anything."""

import socket

from app.viewer.live.wire import PAUSE, RESUME, STEP, Message, send
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


def test_a_parent_that_closes_without_listening_ends_the_worker_without_a_word(caplog) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        send(ours, simulate(1))
        ours.close()
        SimulationWorker(theirs, "cpu").run()
    assert caplog.records == []
