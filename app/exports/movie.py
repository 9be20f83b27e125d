"""Films of a scene, drawn frame by frame: MP4 and GIF."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from jaxtyping import UInt8
from numpy import ndarray

from app.exports.offscreen import Offscreen
from app.viewer.content.camera_path import CameraMotion
from app.viewer.content.content import Content
from app.viewer.content.session_state import SessionState
from physhandi.data.files import replacing
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout

FILMED_PIXELS_PER_SECOND = 2_500_000
"""Pixels a second that a busy core draws; an idle one draws 4 million (bundled run, 1280 x 720)."""
_GIF_STEP_MS = 10
"""Pictures of a GIF are shown for a multiple of this time [ms]."""
_GIF_COLORS = 256
_GIF_SHORTEST_MS = 20
"""Browsers show pictures of a GIF that are due sooner much later."""


def film_scene(
    content: Content,
    rollout: ObjectRollout | None,
    state: SessionState,
    report: Callable[[int, int], None],
    out: Path,
    *,
    as_gif: bool,
    size: tuple[int, int],
    motion: CameraMotion | None = None,
    time_limit_s: float = math.inf,
) -> None:
    """Film the frames of a sequence that are played, in one step or not at all.

    MP4 is encoded as VP9, which needs no licence; browsers and players of today show it. It has an
    even number of columns and rows, so of an odd size the last is left out.

    Args:
        content: What can be shown.
        rollout: The object's rollout; None without an object.
        state: Layers, camera, theme, speed and part, as `complete_state` returns them.
        report: Told how many frames are filmed, and of how many.
        out: File to write.
        as_gif: Whether to write a GIF instead of an MP4.
        size: Columns and rows [px].
        motion: How the camera moves; None for one that stands still.
        time_limit_s: Time that there is [s].

    Raises:
        UsageError: If the film would take longer than there is time, or cannot be encoded.
    """
    if motion is not None:
        motion.check(content.frame_count, content.sequence_name)
    frames = played_frames(content, state)
    check_time(content, frames, size, time_limit_s)
    pictures = _pictures(content, rollout, state, report, frames=frames, size=size, motion=motion)
    film_of(pictures, out, rate=content.frame_rate * state.speed, size=size, as_gif=as_gif)


def played_frames(content: Content, state: SessionState) -> range:
    """List the frames of a sequence that are played."""
    first, last = state.part or (0, content.frame_count - 1)
    return range(first, last + 1)


def check_time(content: Content, frames: range, size: tuple[int, int], time_limit_s: float) -> None:
    """Refuse a film that would take longer than there is time.

    Args:
        content: What is filmed.
        frames: Which frames.
        size: Columns and rows [px].
        time_limit_s: Time that there is [s].

    Raises:
        UsageError: If it would; says how large or long it may be.
    """
    most_pixels = time_limit_s * FILMED_PIXELS_PER_SECOND / len(frames)
    if size[0] * size[1] > most_pixels:
        raise UsageError(
            f"width, height: {len(frames)} frames of '{content.sequence_name}' with {size[0]} x "
            f"{size[1]} pixels cannot be drawn in {time_limit_s:g} s, the most that this server "
            f"takes for a file. Choose at most {int(most_pixels):,} pixels or a shorter part "
            "(part=FIRST,LAST), or film it with 'physhandi export', which takes its time."
        )


def film_of(
    pictures: Iterator[UInt8[ndarray, "row column 3"]],
    out: Path,
    *,
    rate: float,
    size: tuple[int, int],
    as_gif: bool,
) -> None:
    """Write pictures as a film, in one step or not at all.

    Args:
        pictures: Of equal size.
        out: File to write.
        rate: Pictures per second [Hz].
        size: Their columns and rows [px].
        as_gif: Whether to write a GIF instead of an MP4.

    Raises:
        UsageError: If it cannot be encoded.
    """
    with replacing(out) as temporary:
        if as_gif:
            _write_gif(temporary, pictures, rate)
        else:
            _write_mp4(temporary, pictures, rate, size)


def _pictures(
    content: Content,
    rollout: ObjectRollout | None,
    state: SessionState,
    report: Callable[[int, int], None],
    *,
    frames: range,
    size: tuple[int, int],
    motion: CameraMotion | None,
) -> Iterator[UInt8[ndarray, "row column 3"]]:
    """Draw frame after frame (red, green, blue)."""
    count = len(frames)
    with Offscreen(content, rollout, state) as scene:
        for done, frame in enumerate(frames):
            scene.recorded = frame / content.frame_rate
            scene.draw(frame, is_playing=False)
            pose = scene.pose if motion is None else motion.pose(frame, scene.pose, frames)
            yield np.ascontiguousarray(scene.picture(size, pose))
            report(done + 1, count)


def _write_mp4(path: Path, pictures: Iterator[ndarray], rate: float, size: tuple[int, int]) -> None:
    codec = cv2.VideoWriter.fourcc(*"vp09")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, rate, size)
    try:
        if not writer.isOpened():
            raise UsageError(
                "This build of OpenCV has no encoder of VP9: install opencv-python-headless from "
                "PyPI, or choose gif."
            )
        for picture in pictures:
            writer.write(np.ascontiguousarray(picture[..., ::-1]))
    finally:
        writer.release()


def _write_gif(path: Path, pictures: Iterator[ndarray], rate: float) -> None:
    # OpenCV's GIFs have one table of colors for all pictures, and patterns in plain areas.
    first, *others = (
        PIL.Image.fromarray(picture).quantize(
            _GIF_COLORS, PIL.Image.Quantize.MEDIANCUT, dither=PIL.Image.Dither.NONE
        )
        for picture in pictures
    )
    durations = gif_durations(1 + len(others), rate)
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def gif_durations(count: int, rate: float) -> list[int]:
    """Give how long each picture is shown, so that none is late by more than half a step [ms].

    Args:
        count: Number of pictures.
        rate: Pictures per second [Hz].
    """
    due = np.arange(count + 1) * max(1e3 / rate, _GIF_SHORTEST_MS) / _GIF_STEP_MS
    return [int(step) * _GIF_STEP_MS for step in np.diff(np.floor(due + 0.5))]
