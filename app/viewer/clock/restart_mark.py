"""Mark on the timeline at which prediction starts from the observed state."""

import viser

from app.viewer.content.content import Content
from physhandi.object_rollout import ObjectRollout

_FITTED, _PREDICTED = "rgba(120,130,145,0.35)", "rgb(230,140,30)"


class RestartMark:
    """A band below the frame slider: fitted frames, a tick at the restart, predicted frames.

    It takes no room where nothing restarts.
    """

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        """Add the band.

        Args:
            server: Where to.
            order: Place in the panel, just behind the slider's.
        """
        self._frame: int | None = None
        self._html = server.gui.add_html("", order=order, visible=False)

    def replace(self, content: Content) -> None:
        """Mark the restart of another content, or nothing."""
        self._frame = frame = restart_frame(content)
        if frame is not None:
            self._html.content = mark_html(frame, content.frame_count)
        self._html.visible = frame is not None

    def follow(self, rollout: ObjectRollout | None) -> None:
        """Mark nothing while a rollout is shown that does not restart, as an edited one."""
        is_there = self._frame is not None and (rollout is None or rollout.restart is not None)
        if self._html.visible != is_there:
            self._html.visible = is_there


def restart_frame(content: Content) -> int | None:
    """Give the last frame before a restart; None if no frame follows one."""
    fitted = content.fitted
    restart = None if fitted is None else fitted.restart
    if restart is None or restart.frame >= content.frame_count - 1:
        return None
    return restart.frame


def restart_told(frame: int) -> str:
    """Say in words where prediction starts."""
    return f"prediction starts from the observed state at frame {frame}"


def mark_html(frame: int, frame_count: int) -> str:
    """Draw the band.

    Args:
        frame: The last frame before the restart.
        frame_count: Frames of the slider.
    """
    at = 100.0 * frame / max(frame_count - 1, 1)
    bar = (
        "<div style='position:relative;height:4px;border-radius:2px;"
        f"background:linear-gradient(to right,{_FITTED} {at:.1f}%,{_PREDICTED} {at:.1f}%)'>"
        f"<div style='position:absolute;left:calc({at:.1f}% - 1px);top:-4px;width:2px;height:12px;"
        f"background:{_PREDICTED}'></div></div>"
    )
    track = "margin:0.1em 6.6em 0.5em 11.7em"
    style = "font-size:0.7em;line-height:1.4;opacity:0.85;padding-bottom:0.4em"
    label = f"<div style='text-align:right;padding-right:1.2em'>{restart_told(frame)}</div>"
    return f"<div style='{style}'><div style='{track}'>{bar}</div>{label}</div>"
