from app.viewer.live.wire import PAUSE, RESUME, STEP, Holds, Message


def say(holds: Holds, *kinds: str) -> None:
    for kind in kinds:
        holds.hear(Message(kind, {"session": "a"}))


def frames_of(holds: Holds, most: int = 50) -> int:
    """Compute frames of session a as long as it may go on; the process yields 0 first."""
    count = 0
    while count < most and holds.may_go_on("a"):
        holds.count("a", count)
        count += 1
    return count - 1


def test_a_held_simulation_shows_its_start_and_then_a_frame_a_step() -> None:
    holds = Holds()
    holds.start("a", is_held=True)
    holds.count("a", 0)
    assert holds.may_go_on("a")
    holds.count("a", 1)
    assert not holds.may_go_on("a")
    say(holds, STEP, STEP)
    for frame in (2, 3):
        assert holds.may_go_on("a")
        holds.count("a", frame)
    assert not holds.may_go_on("a")


def test_going_on_ends_the_hold_and_pausing_begins_it() -> None:
    holds = Holds()
    holds.start("a", is_held=False)
    assert frames_of(holds) == 49
    say(holds, PAUSE)
    assert not holds.may_go_on("a")
    assert holds.may_go_on("b")
    say(holds, RESUME)
    assert holds.may_go_on("a")


def test_a_new_simulation_forgets_the_steps_that_were_left() -> None:
    holds = Holds()
    holds.start("a", is_held=True)
    say(holds, STEP, STEP, STEP)
    holds.start("a", is_held=True)
    assert frames_of(holds) == 1
    holds.start("a", is_held=False)
    assert frames_of(holds) == 49


def test_a_pause_takes_back_the_steps_that_were_asked_for() -> None:
    holds = Holds()
    holds.start("a", is_held=True)
    holds.count("a", 1)
    say(holds, STEP, STEP, PAUSE)
    assert not holds.may_go_on("a")


def test_a_closed_session_is_forgotten() -> None:
    holds = Holds()
    holds.start("a", is_held=True)
    holds.count("a", 1)
    holds.forget("a")
    assert holds.may_go_on("a")
