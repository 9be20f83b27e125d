"""Recordings of a scene that play without the server that made them: ``.viser`` and HTML."""

from collections.abc import Callable
from html import escape

from app.exports.offscreen import Offscreen
from app.viewer.content.content import Content
from app.viewer.content.session_state import SessionState
from app.viewer.ui.scene_frame import with_script
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout

LONGEST_RECORDING = 3_000
"""Longer sequences are not recorded."""
BYTES_FOR_300_FRAMES = 20_000_000
"""Largest size of a recording of 300 frames [bytes]; springs and arrows are left out to keep it."""
_PACKING = 0.97
"""Share of it for frames, beside the description of the scene."""


def record_scene(
    content: Content,
    rollout: ObjectRollout | None,
    state: SessionState,
    report: Callable[[int, int], None],
    *,
    as_html: bool,
) -> bytes:
    """Record all frames of a sequence.

    Args:
        content: What can be shown.
        rollout: The object's rollout; None without an object.
        state: Layers, camera, theme and speed, as `complete_state` returns them.
        report: Told how many frames are recorded, and of how many.
        as_html: Whether to make a page that plays by itself, instead of a ``.viser`` file.

    Returns:
        The file's content.

    Raises:
        UsageError: If the sequence is too long.
    """
    count = content.frame_count
    if count > LONGEST_RECORDING:
        raise UsageError(
            f"'{content.sequence_name}' has {count} frames; at most "
            f"{LONGEST_RECORDING} are recorded."
        )
    frame_bytes = int(_PACKING * BYTES_FOR_300_FRAMES / 300)
    pause = 1.0 / (content.frame_rate * state.speed)
    with Offscreen(content, rollout, state, frame_bytes=frame_bytes, is_rounded=True) as scene:
        scene.draw(0, is_playing=True)
        serializer = scene.server.get_scene_serializer()
        for frame in range(count):
            scene.recorded = (frame + 1) / content.frame_rate
            if frame:
                scene.draw(frame, is_playing=True)
            serializer.insert_sleep(pause)
            report(frame + 1, count)
        if not as_html:
            return serializer.serialize()
        page = with_script(serializer.as_html(dark_mode=scene.is_dark))
    title = escape(f"{content.title} · PhysHanDI")
    return page.replace("<title>Viser</title>", f"<title>{title}</title>", 1).encode()
