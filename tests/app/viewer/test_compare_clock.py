import pytest

from app.viewer.compare.pair import CompareClock


def test_equal_recordings_show_equal_frames() -> None:
    clock = CompareClock(rates=(30.0, 30.0), counts=(20, 20))
    assert clock.tick_count == 20
    assert [clock.frames(tick) for tick in (0, 7, 19)] == [(0, 0), (7, 7), (19, 19)]
    assert clock.note == ""


@pytest.mark.parametrize("is_swapped", [False, True])
def test_of_unequal_lengths_the_common_time_plays(is_swapped: bool) -> None:
    clock = CompareClock(rates=(30.0, 30.0), counts=(61, 31) if not is_swapped else (31, 61))
    assert clock.tick_count == 31
    assert clock.frames(30) == (30, 30)
    assert "the common 1 s play" in clock.note


def test_of_unequal_rates_equal_times_are_shown() -> None:
    clock = CompareClock(rates=(15.0, 60.0), counts=(16, 31))
    assert clock.rate == 60.0
    # B lasts half a second, of which A has frames 0 to 7.5.
    assert clock.tick_count == 31
    for tick in range(clock.tick_count):
        slow, fast = clock.frames(tick)
        assert fast == tick
        assert abs(slow / 15.0 - tick / 60.0) <= 0.5 / 15.0 + 1e-9
    assert clock.frames(30) == (8, 30)
    assert clock.frames(5) == (1, 5)
    assert "15 and B 60 frames/s" in clock.note


def test_a_recording_of_one_frame_has_one_tick() -> None:
    clock = CompareClock(rates=(30.0, 24.0), counts=(1, 100))
    assert clock.tick_count == 1
    assert clock.frames(0) == (0, 0)
