import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from app.viewer.playback import Playback


class Screen:
    def __init__(self) -> None:
        self.drawn: list[tuple[int, bool]] = []

    def __call__(self, frame: int, is_playing: bool) -> None:
        self.drawn.append((frame, is_playing))

    def wait_for(self, frame: int) -> None:
        end = time.monotonic() + 5
        while time.monotonic() < end:
            if any(drawn == frame for drawn, _ in self.drawn):
                return
            time.sleep(0.005)
        raise AssertionError(f"frame {frame} was not drawn: {self.drawn}")

    def wait_beyond(self, frame: int, seconds: float = 5.0) -> float:
        """Wait for a later frame; returns how long that took."""
        start = time.monotonic()
        while all(drawn <= frame for drawn, _ in self.drawn):
            assert time.monotonic() < start + seconds, self.drawn
            time.sleep(0.002)
        return time.monotonic() - start


@pytest.fixture
def screen() -> Screen:
    return Screen()


@pytest.fixture
def playback(screen: Screen) -> Iterator[Playback]:
    playback = Playback(10, 100.0, screen)
    playback.start()
    yield playback
    playback.close()


def test_it_draws_the_first_frame_and_then_rests(playback: Playback, screen: Screen) -> None:
    screen.wait_for(0)
    time.sleep(0.1)
    assert screen.drawn == [(0, False)]


def test_it_plays_around_and_around(playback: Playback, screen: Screen) -> None:
    playback.play()
    end = time.monotonic() + 5
    while time.monotonic() < end:
        frames = [frame for frame, _ in screen.drawn]
        if any(after < before for before, after in pairwise(frames)):
            break
        time.sleep(0.02)
    else:
        raise AssertionError(f"it never started over: {frames}")
    assert playback.is_playing


def test_without_loop_it_stops_at_the_end_and_starts_over(
    playback: Playback, screen: Screen
) -> None:
    playback.set_loop(on=False)
    playback.play()
    screen.wait_for(9)
    time.sleep(0.1)
    assert (playback.frame, playback.is_playing) == (9, False)
    assert screen.drawn[-1] == (9, False)
    playback.play()
    assert playback.frame < 9


def test_the_running_clock_waits_for_frames_that_are_being_computed(
    playback: Playback, screen: Screen
) -> None:
    playback.limit(4)
    playback.play()
    screen.wait_for(3)
    time.sleep(0.15)
    assert max(frame for frame, _ in screen.drawn) == 3
    playback.limit(10)
    screen.wait_beyond(3)


def test_a_frame_that_was_waited_for_is_drawn_at_once() -> None:
    screen = Screen()
    playback = Playback(10, 2.0, screen)  # A frame lasts half a second.
    playback.limit(2)
    playback.start()
    playback.play()
    screen.wait_for(1)
    time.sleep(0.7)
    assert screen.drawn[-1][0] == 1
    playback.limit(3)
    assert screen.wait_beyond(1) < 0.25
    playback.close()


def test_frames_that_become_ready_later_are_not_drawn_before(screen: Screen) -> None:
    playback = Playback(1000, 4.0, screen)
    playback.start()
    playback.play()
    for ready in range(2, 400):
        playback.limit(ready)
        time.sleep(0.001)
    playback.close()
    assert 1 <= len(screen.drawn) < 10


def test_no_frame_is_left_out_while_drawing_takes_time() -> None:
    screen = Screen()

    def draw(frame: int, is_playing: bool) -> None:
        screen(frame, is_playing)
        time.sleep(0.012)

    playback = Playback(1000, 25.0, draw)
    playback.start()
    playback.play()
    time.sleep(2.0)
    playback.close()
    frames = [frame for frame, is_playing in screen.drawn if is_playing]
    assert frames[-1] == pytest.approx(50, abs=6)
    steps = [after - before for before, after in pairwise(frames)]
    # A busy machine may be late by a whole frame now and then; a clock that waits for 40 ms after
    # each drawing leaves out a dozen.
    assert sum(step > 1 for step in steps) <= 5
    assert steps.count(1) > 35


def test_steps_wrap_and_stop_the_clock(playback: Playback, screen: Screen) -> None:
    playback.play()
    playback.step(-1)
    playback.seek(0)
    playback.step(-1)
    assert (playback.frame, playback.is_playing) == (9, False)
    playback.seek(99)
    assert playback.frame == 9


def test_speed_scales_time() -> None:
    drawn: list[tuple[int, float]] = []

    def draw(frame: int, is_playing: bool) -> None:
        if is_playing:
            drawn.append((frame, time.monotonic()))

    playback = Playback(1000, 10.0, draw)
    playback.set_speed(2.0)
    playback.start()
    playback.play()
    end = time.monotonic() + 20
    while (not drawn or drawn[-1][0] < 20) and time.monotonic() < end:
        time.sleep(0.02)
    playback.close()
    # Drawing may begin late on a busy machine; between two drawings the clock has gone as time has.
    (first, begin), (last, finish) = drawn[0], drawn[-1]
    assert last - first == pytest.approx(20.0 * (finish - begin), abs=3)
    assert last >= 20


def test_an_error_while_drawing_does_not_stop_the_clock(caplog) -> None:
    frames = []

    def draw(frame: int, is_playing: bool) -> None:
        frames.append(frame)
        if frame == 1:
            raise ValueError("no such picture")

    playback = Playback(3, 30.0, draw)
    playback.start()
    playback.seek(1)
    time.sleep(0.2)
    playback.seek(2)
    time.sleep(0.2)
    playback.close()
    assert frames[-1] == 2
    assert "no such picture" in caplog.text
