"""Films as one of the recording's cameras would have taken them, beside what it recorded."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from app.exports.movie import check_time, film_of, played_frames
from app.exports.request import Beside
from app.exports.scene_picture import BACKGROUND, INK, SHADING, SKY
from app.viewer.color.colormaps import UNKNOWN, paint_values
from app.viewer.content.content import Content
from app.viewer.content.layers import SKIN, Layers
from app.viewer.content.session_state import SessionState
from physhandi.appearance.picture import Appearance
from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.errors import UsageError
from physhandi.object_rollout import ObjectRollout
from physhandi.rendering.renderer import render
from physhandi.rendering.shapes import Surface

LARGEST_DIFFERENCE = 0.25
"""Difference of colors, from 0 to 1, at which the scale of a difference ends."""
_DIFFERENCE = f"difference (yellow: {LARGEST_DIFFERENCE:.0%})"
_ROWS = 480
"""Pictures with fewer rows are enlarged to about so many."""
_GREY = np.array([UNKNOWN], np.float64)
_GAP = 2
"""Columns between pictures that are beside each other [px]."""
_TITLE = 1 / 18
"""Height of titles, as a part of the picture's."""


def film_recorded_view(
    content: Content,
    rollout: ObjectRollout | None,
    state: SessionState,
    report: Callable[[int, int], None],
    out: Path,
    *,
    as_gif: bool,
    view: str,
    beside: Beside,
    time_limit_s: float,
) -> None:
    """Film object and hands from where a camera recorded them, in one step or not at all.

    The object is drawn as splats, or as its surface where none were fitted. Pictures have the
    camera's size, small ones a multiple of it.

    Args:
        content: What can be shown.
        rollout: The object's rollout; None without an object.
        state: Layers, theme, speed and part, as `complete_state` returns them.
        report: Told how many frames are filmed, and of how many.
        out: File to write.
        as_gif: Whether to write a GIF instead of an MP4.
        view: The camera; empty for the one that is looked from, else the first with pictures.
        beside: What is beside the picture: nothing, the recording, or that and the difference.
        time_limit_s: Time that there is [s].

    Raises:
        UsageError: If there is no such camera, nothing to draw, or no time.
    """
    layers = state.layers or Layers()
    recorded = _find_view(content, view or layers.looks_from).straightened()
    frames = played_frames(content, state)
    panels = {"none": 1, "recording": 2, "difference": 3}[beside]
    camera = _enlarged(recorded.camera)
    size = panels * camera.width + (panels - 1) * _GAP, camera.height
    check_time(content, frames, size, time_limit_s)
    is_dark = state.theme == "dark"
    artist = _Artist(content, rollout, camera, layers, is_dark=is_dark)
    pictures = _pictures(recorded, artist, frames, beside, report)
    film_of(pictures, out, rate=content.frame_rate * state.speed, size=size, as_gif=as_gif)


def _pictures(
    recorded: View,
    artist: "_Artist",
    frames: range,
    beside: Beside,
    report: Callable[[int, int], None],
) -> Iterator[UInt8[ndarray, "row column 3"]]:
    for done, frame in enumerate(frames):
        drawn, is_drawn = artist.draw(frame)
        panels = [("", drawn)]
        if beside != "none":
            shape = drawn.shape[1::-1]
            seen = cv2.resize(recorded.color(frame), shape, interpolation=cv2.INTER_CUBIC)
            panels = [("recorded", seen), ("simulated", drawn)]
            if beside == "difference":
                is_there = is_drawn
                if recorded.has_mask:
                    mask = cv2.resize(
                        recorded.mask(frame), shape, interpolation=cv2.INTER_NEAREST_EXACT
                    )
                    is_there = is_drawn | (mask > 0)
                ground = BACKGROUND[artist.is_dark]
                panels.append((_DIFFERENCE, paint_difference(seen, drawn, is_there, ground)))
        yield np.ascontiguousarray(_side_by_side(panels, is_dark=artist.is_dark))
        report(done + 1, len(frames))


class _Artist:
    """Draws object and hands as one camera sees them."""

    def __init__(
        self,
        content: Content,
        rollout: ObjectRollout | None,
        camera: PinholeCamera,
        layers: Layers,
        *,
        is_dark: bool,
    ) -> None:
        self.is_dark = is_dark
        self._content, self._rollout = content, rollout
        self._camera, self._layers = camera, layers
        ground = np.array(BACKGROUND[is_dark], np.float32) / np.float32(255.0)
        self._ground = np.broadcast_to(ground, (camera.height, camera.width, 3))
        count = 0 if rollout is None else rollout.model.node_count
        splats, surface = content.splats, content.surface
        has_splats = splats is not None and len(splats.rest_node) == count
        self._appearance = Appearance.of(splats) if splats is not None and has_splats else None
        self._surface = surface if surface is not None and surface.node_count == count else None
        if rollout is not None and self._appearance is None and self._surface is None:
            raise UsageError(
                f"view: the object in '{content.sequence_name}' has neither splats nor a surface "
                "that a film from a recorded camera could show. Film the scene instead."
            )

    def draw(
        self, frame: int
    ) -> tuple[UInt8[ndarray, "row column 3"], Bool[ndarray, "row column"]]:
        """Draw a frame; also tells which pixels object and hands cover."""
        shapes = list(self._hands(frame)) if self._layers.hands else []
        node = None
        if self._rollout is not None:
            node = np.asarray(
                self._rollout.position[min(frame, self._rollout.ready - 1)], np.float32
            )
        if node is not None and self._appearance is not None:
            picture = self._appearance.render_frame(
                self._camera, node, shapes, background=self._ground, light=SKY
            )
            covered = (picture.image.alpha > 0.5) | picture.is_hand
            return np.rint(255.0 * picture.image.color).astype(np.uint8), covered
        if node is not None and self._surface is not None:
            color = _GREY if self._surface.color is None else self._surface.color
            shapes.append(
                Surface(
                    vertex=self._surface.place(node).astype(np.float64),
                    faces=self._surface.face.astype(np.int64),
                    color=np.asarray(color, np.float64),
                    shading=SHADING,
                )
            )
        image = render(self._camera, shapes, light=SKY)
        cover = image[..., 3:] / np.float32(255.0)
        color = cover * image[..., :3] + (1.0 - cover) * (255.0 * self._ground)
        return np.rint(color).astype(np.uint8), cover[..., 0] > 0.5

    def _hands(self, frame: int) -> Iterator[Surface]:
        for hand in self._content.hands:
            if hand.face is not None:
                yield Surface(
                    vertex=np.asarray(hand.vertex[min(frame, len(hand.vertex) - 1)], np.float64),
                    faces=hand.face.astype(np.int64),
                    color=np.array([SKIN[hand.side]], np.float64),
                    shading=SHADING,
                )


def paint_difference(
    seen: UInt8[ndarray, "row column 3"],
    drawn: UInt8[ndarray, "row column 3"],
    is_there: Bool[ndarray, "row column"],
    ground: tuple[int, int, int],
) -> UInt8[ndarray, "row column 3"]:
    """Paint how much two pictures differ where something is, by the mean of the three channels.

    Args:
        seen: What was recorded.
        drawn: What was drawn.
        is_there: Pixels that count.
        ground: Color of all others.

    Returns:
        A picture in the colors of the sequential scale, which ends at `LARGEST_DIFFERENCE`.
    """
    offset = np.abs(seen.astype(np.float64) - drawn).mean(axis=-1) / 255.0
    painted = paint_values(offset, (0.0, LARGEST_DIFFERENCE))
    painted[~is_there] = ground
    return painted


def _find_view(content: Content, name: str | None) -> View:
    filmed = {view.name: view for view in content.views if view.has_color}
    if not filmed:
        raise UsageError(
            f"view: the recording of '{content.sequence_name}' is not there or has no pictures."
        )
    if name and name not in filmed:
        raise UsageError(
            f"view: '{content.sequence_name}' has no camera {name[:80]!r} with pictures. "
            f"It has: {', '.join(filmed)}."
        )
    return filmed[name] if name else next(iter(filmed.values()))


def _enlarged(camera: PinholeCamera) -> PinholeCamera:
    """Give a camera that sees the same in a picture which is large enough to be looked at."""
    times = max(round(_ROWS / camera.height), 1)
    K = camera.K.copy()
    # Middles of pixels have whole coordinates.
    K[:2, 2] += 0.5
    K[:2] *= times
    K[:2, 2] -= 0.5
    return replace(camera, K=K, width=times * camera.width, height=times * camera.height)


def _side_by_side(
    panels: list[tuple[str, UInt8[ndarray, "row column 3"]]], *, is_dark: bool
) -> UInt8[ndarray, "row column 3"]:
    """Put pictures beside each other, each with its title in the upper left corner."""
    shown: list[ndarray] = []
    for title, image in panels:
        panel = image.copy()
        if title:
            _write(panel, title, is_dark=is_dark)
        gap = np.full((len(panel), _GAP, 3), INK[is_dark], np.uint8)
        shown += [gap, panel] if shown else [panel]
    return np.concatenate(shown, axis=1)


def _write(image: UInt8[ndarray, "row column 3"], title: str, *, is_dark: bool) -> None:
    """Write a title on a plate of its own, which any picture can be behind."""
    high = max(int(_TITLE * len(image)), 9)
    font, size = cv2.FontFace("sans"), int(0.72 * high)
    wide = int(cv2.getTextSize((0, 0), title, (0, 0), font, size)[2])
    image[: high + 2, : wide + high] = BACKGROUND[is_dark]
    cv2.putText(image, title, (high // 2, int(0.82 * high)), INK[is_dark], font, size)
