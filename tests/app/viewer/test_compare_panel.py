"""The panel of a comparison, written by the clock, by what measures and by users."""

import threading

import numpy as np
import viser
from support.waiting import LIMIT_S

from app.viewer.color.difference import FrameDifference, Way
from app.viewer.compare.curve import DifferenceCurve
from app.viewer.compare.drawing import Look
from app.viewer.compare.panel import ComparePanel
from app.viewer.ui.guard import Guard


class WatchedLock:
    """The panel's lock, which tells that a thread waits for it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.is_awaited = threading.Event()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            self.is_awaited.set()
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class MeasuredMeanwhile(DifferenceCurve):
    """A difference that gets known while the clock's thread writes that it is not."""

    def __init__(self) -> None:
        super().__init__(lambda: None)
        self.is_measured = False
        self.was_asked = threading.Event()
        self.has_gone_on = threading.Event()

    @property
    def way(self) -> Way | None:
        return "nodes"

    @property
    def strong(self) -> float:
        return 0.055

    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        return np.full(12, 0.04), np.full(12, 0.055)

    def at(self, tick: int) -> FrameDifference | None:
        if self.is_measured:
            return FrameDifference(mean=0.04, strong=0.055, largest=0.055)
        self.is_measured = True
        self.was_asked.set()
        assert self.has_gone_on.wait(LIMIT_S)
        return None


def test_what_was_measured_is_not_overwritten_by_what_was_known_before(
    server: viser.ViserServer,
) -> None:
    curve = MeasuredMeanwhile()
    curve.is_measured = True
    panel = ComparePanel(server, Guard(server), Look(tint="difference"), curve, change=lambda: None)
    panel.name({"a": "one", "b": "two"}, (), unit="m", tick_count=12)
    curve.is_measured = False
    # Whoever measured either waits until the clock has written, or writes before it.
    panel._lock = lock = WatchedLock()  # type: ignore[assignment]
    lock.is_awaited = curve.has_gone_on

    def measure() -> None:
        assert curve.was_asked.wait(LIMIT_S)
        panel.follow()
        curve.has_gone_on.set()

    measuring = threading.Thread(target=measure)
    measuring.start()
    panel.show(3, is_playing=False)
    measuring.join(LIMIT_S)
    said = panel._text.content
    assert "mean 40" in said
    assert "measuring" not in said


def test_no_difference_is_told_before_the_clock_has_told_its_tick(
    server: viser.ViserServer,
) -> None:
    curve = MeasuredMeanwhile()
    curve.is_measured = True
    panel = ComparePanel(server, Guard(server), Look(), curve, change=lambda: None)
    panel.name({"a": "one", "b": "two"}, (), unit="m", tick_count=12)
    panel.follow()
    assert "measuring" in panel._text.content
    assert "mean" not in panel._text.content
    panel.show(3, is_playing=False)
    assert "mean 40" in panel._text.content


def test_a_panel_tells_whether_its_color_scale_changed(server: viser.ViserServer) -> None:
    look = Look(tint="difference")
    curve = MeasuredMeanwhile()
    curve.is_measured = True
    panel = ComparePanel(server, Guard(server), look, curve, change=lambda: None)
    assert look.scale == 0.0
    assert panel.follow()
    assert abs(look.scale - 0.1) < 1e-12
    assert not panel.follow()


def test_the_plot_marks_the_frame_at_which_the_clock_stops(server: viser.ViserServer) -> None:
    curve = MeasuredMeanwhile()
    curve.is_measured = True
    panel = ComparePanel(server, Guard(server), Look(), curve, change=lambda: None)
    panel.name({"a": "one", "b": "two"}, (), unit="m", tick_count=12)
    for tick in (4, 5, 6, 7):
        panel.show(tick, is_playing=True)
    assert np.flatnonzero(panel._plot.data[3]).tolist() == [5]
    panel.show(7, is_playing=False)
    assert np.flatnonzero(panel._plot.data[3]).tolist() == [7]
