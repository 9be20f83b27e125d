"""The error of every frame: the fit against the tracks, and the re-simulation against the fit."""

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.content import Content
from app.viewer.ui.guard import without_markup
from app.viewer.ui.plot import FramePlot, PlotCurve
from physhandi.data.files import named_fields
from physhandi.data.layout import SequenceFiles
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run

_REFRESH = 0.25
_STYLE = "font-size:0.8em;line-height:1.5;padding:0 0.6em"
_FIT, _AGAIN = "rgb(46,160,67)", "rgb(47,111,222)"


def load_track_error(
    run: Run, sequence_name: str, frame_count: int
) -> Float[ndarray, " frame"] | None:
    """Read how far the fitted object is from its tracks in every frame [m].

    Args:
        run: The run; an older one may not have measured it.
        sequence_name: One of its sequences.
        frame_count: Frames that are wanted; NaN where nothing was measured.

    Returns:
        The errors, or None if the run has none.
    """
    name = SequenceFiles(sequence_name).frame_errors
    if not run.has(name):
        return None
    content = named_fields(run.json(name)) or {}
    rollout = named_fields(content.get("rollout")) or {}
    are_lists = isinstance(content.get("frames"), list)
    if not are_lists or not isinstance(rollout.get("track_error"), list):
        return None
    frames: Any = content["frames"]
    values: Any = rollout["track_error"]
    error = np.full(frame_count, np.nan)
    pairs: list[tuple[Any, Any]] = list(zip(frames, values, strict=False))
    for frame, value in pairs:
        if isinstance(frame, int) and 0 <= frame < frame_count and isinstance(value, int | float):
            error[frame] = value
    return error if np.isfinite(error).any() else None


class ErrorPanel:
    """A small plot over all frames, and the current frame's errors in words.

    The clock's thread tells the frame, the live simulation's thread tells the rollout.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        content: Content,
        fitted: ObjectRollout,
        track_error: Float[ndarray, " frame"] | None,
        warnings: Sequence[str] = (),
    ) -> None:
        """Add the panel.

        Args:
            server: Where to.
            content: What is shown.
            fitted: The fitted rollout.
            track_error: Its error against the tracks [m]; None if it was not measured.
            warnings: Codes of what there is to doubt about the fit.
        """
        self._lock = threading.Lock()
        self._fitted = fitted
        self._per_unit = 1e3 if content.is_metric else 1.0
        self._unit = "mm" if content.is_metric else content.length_unit
        count = fitted.frame_count
        self._source = "the tracks" if content.tracks is None else content.tracks.name
        self._track = np.full(count, np.nan) if track_error is None else track_error[:count]
        self._again = np.zeros(count)
        self._rollout: ObjectRollout = fitted
        self._measured = 0
        self._frame = 0
        self._refreshed = 0.0
        self._is_late = False
        self._folder = server.gui.add_folder("Error per frame")
        with self._folder:
            if warnings:
                texts = ", ".join(
                    without_markup(code.replace("_", " ")) for code in dict.fromkeys(warnings)
                )
                server.gui.add_html(
                    f'<div style="{_STYLE}"><b>Warnings</b> of the fit: {texts} '
                    "(see its page)</div>"
                )
            self._text = server.gui.add_html("")
            fit = [PlotCurve(label="fit", color=_FIT)] if np.isfinite(self._track).any() else []
            self._plot = FramePlot(
                server.gui,
                [*fit, PlotCurve(label="re-simulated", color=_AGAIN)],
                frame_count=count,
                unit=self._unit,
                height=85,
            )
        self._write(at_once=True)

    def remove(self) -> None:
        """Take the panel away."""
        self._folder.remove()

    def show(self, frame: int, *, is_playing: bool) -> None:
        """Show the errors of the frame on the screen."""
        with self._lock:
            # A clock that stops may leave behind what was not worth writing while it ran.
            if frame != self._frame or (self._is_late and not is_playing):
                self._frame = frame
                self._write(at_once=not is_playing)

    def follow(self, rollout: ObjectRollout, *, at_once: bool) -> None:
        """Measure the frames of a rollout that have become ready.

        Args:
            rollout: The newest rollout.
            at_once: Whether to show it even if the plot is fresh.
        """
        with self._lock:
            if rollout is not self._rollout:
                self._rollout, self._measured = rollout, 0
                self._again = np.zeros(len(self._track))
            is_fit = rollout is self._fitted
            for frame in range(self._measured, 0 if is_fit else rollout.ready):
                self._again[frame] = rollout.frame_distance(self._fitted, frame)
                self._measured = frame + 1
            self._write(at_once=at_once)

    @property
    def errors(self) -> tuple[float, float]:
        """Errors of the current frame [m]: fit against tracks, re-simulation against fit."""
        frame = min(self._frame, len(self._track) - 1)
        is_there = self._rollout is self._fitted or frame < self._measured
        return float(self._track[frame]), float(self._again[frame]) if is_there else float("nan")

    def _write(self, *, at_once: bool) -> None:
        now = time.monotonic()
        self._is_late = not at_once and now - self._refreshed < _REFRESH
        if self._is_late:
            return
        self._refreshed = now
        track, again = self.errors
        fit = self._words(_FIT, "fit", track, f"from {self._source}")
        new = ""
        if self._rollout is not self._fitted:
            new = self._words(_AGAIN, "re-simulated", again, "from the fit")
        text = "<br/>".join(line for line in (fit, new) if line) or "Move a slider to compare."
        self._text.content = f'<div style="{_STYLE}">{text}</div>'
        self._plot.show(self._curves(), self._frame)

    def _words(self, color: str, what: str, error: float, other: str) -> str:
        if not np.isfinite(error):
            return ""
        dot = f'<span style="color:{color}">●</span>'
        return f"{dot} {what} {error * self._per_unit:.3g} {without_markup(self._unit)} {other}"

    def _curves(self) -> list[Float[ndarray, " frame"]]:
        """Collect the curves, as far as the rollout is simulated."""
        again = self._again.copy()
        if self._rollout is not self._fitted:
            again[self._measured :] = np.nan
        tracks = [self._track] if np.isfinite(self._track).any() else []
        return [curve * self._per_unit for curve in (*tracks, again)]
