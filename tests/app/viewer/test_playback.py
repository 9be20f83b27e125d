from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest
from support.waiting import until

from app.viewer.clock.playback import Playback


class Clock:
    """Time and condition of a playback: time goes on only while the playback waits for it.

    What a test wants done happens at its moment; whoever waits is woken a little late.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self.wishes: list[tuple[float, Callable[[], None]]] = []
        self.is_resting = False
        self._is_woken = False

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def at(self, moment: float, action: Callable[[], None]) -> None:
        self.wishes.append((moment, action))
        self.wishes.sort(key=lambda wish: wish[0])

    def monotonic(self) -> float:
        return self.now

    def notify_all(self) -> None:
        self._is_woken = True

    def wait(self, seconds: float | None = None) -> None:
        self.is_resting = seconds is None
        end = np.inf if seconds is None else self.now + seconds + 0.001
        self._is_woken = False
        while not self._is_woken and self.wishes and self.wishes[0][0] <= end:
            moment, action = self.wishes.pop(0)
            self.now = max(self.now, moment)
            action()
        if not self._is_woken:
            assert np.isfinite(end), "it rests, and nothing is left to be done"
            self.now = end


class Film:
    """A playback in made-up time, what it draws, and when."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, frame_count: int, rate: float) -> None:
        self.clock = Clock()
        self.drawn: list[tuple[int, bool]] = []
        self.moments: list[float] = []
        self.cost = 0.0
        """How long it takes to draw a frame [s]."""
        self.playback = Playback(frame_count, rate, self._draw)
        self.playback._condition = self.clock  # type: ignore[assignment]
        monkeypatch.setattr("app.viewer.clock.playback.time", self.clock)

    @property
    def frames(self) -> list[int]:
        return [frame for frame, _ in self.drawn]

    def moment_of(self, frame: int) -> float:
        return self.moments[self.frames.index(frame)]

    def run(self, end: float) -> None:
        """Let the playback do its work, in this thread, until its clock has come so far."""
        self.clock.at(end, self.playback.close)
        self.playback._run()

    def _draw(self, frame: int, is_playing: bool) -> None:
        self.drawn.append((frame, is_playing))
        self.moments.append(self.clock.now)
        self.clock.now += self.cost


@pytest.fixture
def film(monkeypatch: pytest.MonkeyPatch) -> Film:
    return Film(monkeypatch, 10, 100.0)


@pytest.fixture
def playback() -> Iterator[Playback]:
    playback = Playback(10, 100.0, lambda *_: None)
    playback.start()
    yield playback
    playback.close()


def test_it_draws_the_first_frame_and_then_rests(film: Film) -> None:
    film.run(1000.0)
    assert film.drawn == [(0, False)]
    assert film.clock.is_resting


def test_it_plays_around_and_around(film: Film) -> None:
    film.playback.play()
    film.run(1.0)
    assert any(after < before for before, after in pairwise(film.frames))
    assert film.playback.is_playing


def test_without_loop_it_stops_at_the_end_and_starts_over(film: Film) -> None:
    film.playback.set_loop(on=False)
    film.playback.play()
    film.run(1.0)
    assert (film.playback.frame, film.playback.is_playing) == (9, False)
    assert film.drawn[-1] == (9, False)
    assert film.clock.is_resting
    film.playback.play()
    assert (film.playback.frame, film.playback.is_playing) == (0, True)


def test_only_a_part_is_played_but_every_frame_can_be_gone_to(film: Film) -> None:
    film.playback.set_speed(0.2)
    film.playback.set_part(3, 6)
    film.playback.play()
    film.clock.at(1.0, lambda: film.playback.play(on=False))
    film.clock.at(1.1, lambda: film.playback.seek(9))
    film.clock.at(1.5, film.playback.play)
    film.run(2.0)
    # It begins with the part, goes around in it, and returns to it from behind it.
    assert film.frames[:9] == [3, 4, 5, 6, 3, 4, 5, 6, 3]
    after = film.frames[film.frames.index(9) + 1 :]
    assert len(after) > 5
    assert set(after) == {3, 4, 5, 6}


def test_a_part_without_loop_ends_at_its_last_frame_and_starts_over(film: Film) -> None:
    film.playback.set_loop(on=False)
    film.playback.set_part(3, 6)
    film.playback.play()
    film.run(1.0)
    assert (film.playback.frame, film.playback.is_playing) == (6, False)
    film.playback.play()
    assert film.playback.frame == 3
    film.playback.set_part(0, 99)
    assert film.playback.part is None
    film.playback.set_part(4, 2)
    assert film.playback.part == (2, 2)
    film.playback.replace(20, 30.0)
    assert film.playback.part is None


def test_a_part_whose_last_frames_are_being_computed_waits_for_them(film: Film) -> None:
    film.playback.set_speed(0.2)
    film.playback.limit(4)
    film.playback.set_part(1, 5)
    film.playback.play()
    film.clock.at(1.0, lambda: film.playback.limit(6))
    film.run(2.0)
    assert film.moment_of(4) >= 1.0
    assert set(film.frames) == {1, 2, 3, 4, 5}


def test_the_running_clock_waits_for_frames_that_are_being_computed(film: Film) -> None:
    film.playback.limit(4)
    film.playback.play()
    film.clock.at(1.0, lambda: film.playback.limit(10))
    film.run(2.0)
    assert film.moment_of(3) < 0.1
    assert max(f for f, at in zip(film.frames, film.moments, strict=True) if at < 1.0) == 3
    assert film.moment_of(4) >= 1.0


def test_a_held_clock_stands_until_it_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film(monkeypatch, 1000, 10.0)
    film.playback.hold()
    film.playback.seek(2)
    film.playback.play()
    film.clock.at(50.0, film.playback.release)
    film.run(50.15)
    assert film.drawn == [(2, True), (2, True), (3, True)]
    assert film.moments == pytest.approx([0.0, 50.0, 50.1], abs=0.002)


def test_a_frame_that_was_waited_for_is_drawn_at_once(film: Film) -> None:
    film.playback.limit(2)
    film.playback.play()
    # From here on a frame lasts 20 seconds.
    film.clock.at(0.5, lambda: film.playback.set_speed(5e-4))
    film.clock.at(1.5, lambda: film.playback.limit(3))
    film.run(2.0)
    assert film.frames[-1] == 2
    assert film.moment_of(2) == pytest.approx(1.5, abs=0.1)


def test_frames_that_become_ready_later_are_not_drawn_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    film = Film(monkeypatch, 1000, 4.0)
    film.playback.play()
    for ready in range(2, 400):
        film.clock.at(ready * 1e-3, lambda ready=ready: film.playback.limit(ready))
    film.run(1.0)
    # Each frame once.
    assert film.frames == [0, 1, 2, 3]


def test_no_frame_is_left_out_while_drawing_takes_time(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film(monkeypatch, 1000, 25.0)
    film.cost = 0.012
    film.playback.play()
    film.run(2.03)
    # A clock that waits for 40 ms after each drawing leaves out a dozen.
    assert film.frames == list(range(51))
    assert film.moment_of(50) == pytest.approx(2.0, abs=0.05)


def test_steps_wrap_and_stop_the_clock(playback: Playback) -> None:
    playback.play()
    playback.step(-1)
    playback.seek(0)
    playback.step(-1)
    assert (playback.frame, playback.is_playing) == (9, False)
    playback.seek(99)
    assert playback.frame == 9


def test_speed_scales_time(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film(monkeypatch, 1000, 10.0)
    film.playback.set_speed(2.0)
    film.playback.play()
    film.run(1.02)
    assert film.frames == list(range(21))
    assert film.moments == pytest.approx(np.arange(21) / 20.0, abs=0.002)


def test_an_error_while_drawing_does_not_stop_the_clock(caplog) -> None:
    frames = []

    def draw(frame: int, is_playing: bool) -> None:
        frames.append(frame)
        if frame == 1:
            raise ValueError("no such picture")

    playback = Playback(3, 30.0, draw)
    playback.start()
    playback.seek(1)
    until(lambda: 1 in frames)
    playback.seek(2)
    until(lambda: 2 in frames)
    playback.close()
    assert frames[-1] == 2
    assert "no such picture" in caplog.text
