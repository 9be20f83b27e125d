import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest

from app.viewer.playback import Playback

PATIENCE = 60.0
"""How long to wait for what should happen soon [s]."""


class Time:
    """A clock that goes on only while somebody waits, who is woken a little late."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds + 0.001


class Screen:
    def __init__(self) -> None:
        self.drawn: list[tuple[int, bool]] = []

    def __call__(self, frame: int, is_playing: bool) -> None:
        self.drawn.append((frame, is_playing))

    def wait_for(self, frame: int) -> None:
        self.until(lambda: any(drawn == frame for drawn, _ in self.drawn))

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"it did not come true: {self.drawn}"
            time.sleep(0.005)

    def wait_beyond(self, frame: int) -> float:
        """Wait for a later frame; returns how long that took."""
        start = time.monotonic()
        while all(drawn <= frame for drawn, _ in self.drawn):
            assert time.monotonic() < start + PATIENCE, self.drawn
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
    screen.until(lambda: any(after < before for (before, _), (after, _) in pairwise(screen.drawn)))
    assert playback.is_playing


def test_without_loop_it_stops_at_the_end_and_starts_over(
    playback: Playback, screen: Screen
) -> None:
    playback.set_loop(on=False)
    playback.play()
    screen.until(lambda: (9, False) in screen.drawn)
    time.sleep(0.1)
    assert (playback.frame, playback.is_playing) == (9, False)
    assert screen.drawn[-1] == (9, False)
    playback.set_speed(1e-4)  # So slow that it is still at the beginning when it is asked.
    playback.play()
    assert (playback.frame, playback.is_playing) == (0, True)


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
    playback = Playback(10, 100.0, screen)
    playback.limit(2)
    playback.start()
    playback.play()
    screen.until(playback._is_starved)
    playback.set_speed(5e-4)  # From here on a frame lasts 20 seconds.
    time.sleep(0.7)
    assert screen.drawn[-1][0] == 1
    playback.limit(3)
    assert screen.wait_beyond(1) < 10.0
    playback.close()


def test_frames_that_become_ready_later_are_not_drawn_before(screen: Screen) -> None:
    playback = Playback(1000, 4.0, screen)
    playback.start()
    playback.play()
    for ready in range(2, 400):
        playback.limit(ready)
        time.sleep(0.001)
    playback.close()
    # Once as it starts, perhaps once more as it begins to play, and then each frame once.
    assert 1 <= len(screen.drawn) <= len({frame for frame, _ in screen.drawn}) + 2


def play_in(time_: Time, playback: Playback, monkeypatch: pytest.MonkeyPatch) -> None:
    """Play until it is closed, in a time that goes on only while the clock waits or draws."""
    monkeypatch.setattr("app.viewer.playback.time", time_)
    monkeypatch.setattr(playback._condition, "wait", time_.wait)
    playback.play()
    playback.start()
    playback._thread.join(timeout=PATIENCE)
    assert not playback._thread.is_alive()


def test_no_frame_is_left_out_while_drawing_takes_time(monkeypatch: pytest.MonkeyPatch) -> None:
    time_, frames = Time(), list[int]()

    def draw(frame: int, _: bool) -> None:
        frames.append(frame)
        time_.now += 0.012
        if frame >= 50:
            playback.close()

    playback = Playback(1000, 25.0, draw)
    play_in(time_, playback, monkeypatch)
    # A clock that waits for 40 ms after each drawing leaves out a dozen.
    assert frames == list(range(51))
    assert time_.now == pytest.approx(2.0, abs=0.05)


def test_steps_wrap_and_stop_the_clock(playback: Playback, screen: Screen) -> None:
    playback.play()
    playback.step(-1)
    playback.seek(0)
    playback.step(-1)
    assert (playback.frame, playback.is_playing) == (9, False)
    playback.seek(99)
    assert playback.frame == 9


def test_speed_scales_time(monkeypatch: pytest.MonkeyPatch) -> None:
    time_, drawn = Time(), list[tuple[int, float]]()

    def draw(frame: int, _: bool) -> None:
        drawn.append((frame, time_.now))
        if frame >= 20:
            playback.close()

    playback = Playback(1000, 10.0, draw)
    playback.set_speed(2.0)
    play_in(time_, playback, monkeypatch)
    assert [frame for frame, _ in drawn] == list(range(21))
    assert [at for _, at in drawn] == pytest.approx(np.arange(21) / 20.0, abs=0.002)


def test_an_error_while_drawing_does_not_stop_the_clock(caplog) -> None:
    frames = []

    def draw(frame: int, is_playing: bool) -> None:
        frames.append(frame)
        if frame == 1:
            raise ValueError("no such picture")

    playback = Playback(3, 30.0, draw)
    playback.start()
    playback.seek(1)
    Screen().until(lambda: 1 in frames)
    playback.seek(2)
    Screen().until(lambda: 2 in frames)
    playback.close()
    assert frames[-1] == 2
    assert "no such picture" in caplog.text
