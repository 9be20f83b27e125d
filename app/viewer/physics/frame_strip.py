"""The strip below the frame slider: which frames are simulated anew, and where it ended."""

import math
import time
from typing import Any

import viser

from app.viewer.live.rollouts import Readout

_REFRESH = 0.1
_NEW, _BAD, _OLD = "#228be6", "#e03131", "rgba(128,128,128,0.3)"


class FrameStrip:
    """Shows which frames of the timeline are new while the sliders' rollout is simulated.

    It is as wide as the track of the slider above it and takes no room as long as the fitted
    rollout is shown.
    """

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        """Add the strip.

        Args:
            server: Where to.
            order: Place in the panel, just behind the slider's.
        """
        self._drawn = -math.inf
        self._html: Any = server.gui.add_html("", order=order, visible=False)

    def show(self, readout: Readout, *, at_once: bool) -> None:
        """Draw what a readout says, not more often than people see.

        Args:
            readout: What to draw.
            at_once: Whether to draw it even if the last one is fresh.
        """
        is_visible, now = not readout.is_fitted, time.monotonic()
        if not at_once and now - self._drawn < _REFRESH:
            return
        self._drawn = now
        if is_visible:
            self._html.content = strip_html(readout)
        if self._html.visible != is_visible:
            self._html.visible = is_visible

    def hide(self) -> None:
        """Take no room until there is something to show again."""
        self._html.visible = False


def strip_html(readout: Readout) -> str:
    """Draw the strip of one readout."""
    ready, count = readout.simulated_count, max(readout.frame_count, 1)
    # A slider's handle is in the middle of its frame, so the last new frame ends at its handle.
    part = 0.0 if ready == 0 else 100.0 * max(ready - 1, 0) / max(count - 1, 1)
    part = 100.0 if ready >= count else part
    rest = _BAD if readout.error else _OLD
    bar = (
        "<div style='height:4px;border-radius:2px;"
        f"background:linear-gradient(to right,{_NEW} {part:.1f}%,{rest} {part:.1f}%)'></div>"
    )
    track = "margin:-0.3em 6.6em 0.2em 11.7em"
    style = "font-size:0.7em;line-height:1.4;opacity:0.85"
    caption = f"<div style='text-align:right;padding-right:1.2em'>{_caption(readout)}</div>"
    return f"<div style='{style}'><div style='{track}'>{bar}</div>{caption}</div>"


def _caption(readout: Readout) -> str:
    ready, last = readout.simulated_count, readout.frame_count - 1
    if ready == 0:
        return "it stopped before its first frame" if readout.error else "no frame is new yet"
    new = f"frames 0 to {ready - 1} of {last} are new" if ready > 1 else f"frame 0 of {last} is new"
    if readout.error:
        return f"{new}, then it stopped"
    return new if readout.is_busy else "every frame is new"
