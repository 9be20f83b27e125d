"""A scene that nobody watches: drawn as in a live session, for pictures and recordings."""

from dataclasses import dataclass, fields, replace
from types import TracebackType
from typing import Self

import numpy as np
import viser
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.color.legend import draw_legend
from app.viewer.content.content import Content
from app.viewer.content.session_state import Pose, SessionState
from app.viewer.scene.framing import frame_content
from app.viewer.scene.scene import FRAME_BYTES, SceneDrawing
from app.viewer.scene.scene_server import start_viser
from app.viewer.ui.guard import without_markup
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.object_surface import ObjectSurface

GRID = 2.0**-14
"""Positions of recordings are rounded to a multiple of this part of the scene's size."""


class Offscreen:
    """The scene of one sequence in a viser server of its own; used by one thread."""

    def __init__(
        self,
        content: Content,
        rollout: ObjectRollout | None,
        state: SessionState,
        *,
        frame_bytes: int = FRAME_BYTES,
        is_rounded: bool = False,
    ) -> None:
        """Build the scene; nothing is drawn yet.

        Args:
            content: What can be shown.
            rollout: The object's rollout; None without an object.
            state: Layers and camera, as `complete_state` returns them.
            frame_bytes: What a frame may weigh while the clock is running.
            is_rounded: Whether positions may be rounded to `GRID`, so that they pack better.
        """
        framing = frame_content(content)
        self.recorded = 0.0
        self.content = content
        if is_rounded and (state.layers is None or state.layers.color == "plain"):
            step = GRID * 2.0 ** float(np.floor(np.log2(framing.extent)))
            self.content, rollout = _rounded(content, rollout, step)
        self._rollout = rollout
        self.server: viser.ViserServer = start_viser(without_markup(content.title))
        try:
            self._scene = SceneDrawing(
                self.server,
                self.content,
                framing,
                frame_bytes=frame_bytes,
                clock=lambda: self.recorded,
            )
            if state.layers is not None:
                for field in fields(state.layers):
                    setattr(self._scene.layers, field.name, getattr(state.layers, field.name))
            self._scene.layers.dark = state.theme == "dark"
            if state.pose is not None:
                state.pose.give_first(self.server.initial_camera)
            else:
                # The live scene leaves room for its panel; here is none.
                offset = framing.look_at - framing.center
                camera = self.server.initial_camera
                camera.position = framing.camera - offset
                camera.look_at = framing.center
        except BaseException:
            self.server.stop()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.server.stop()

    @property
    def is_dark(self) -> bool:
        """Whether the background is dark."""
        return self._scene.layers.dark

    @property
    def pose(self) -> Pose:
        """Pose of the camera."""
        return Pose.first(self.server.initial_camera)

    def draw(self, frame: int, *, is_playing: bool) -> None:
        """Bring the scene to a frame.

        Args:
            frame: The frame.
            is_playing: Whether less may be drawn, as while the clock of a session is running.
        """
        rollout = self._rollout
        at = 0 if rollout is None else min(frame, rollout.ready - 1)
        self._scene.draw(frame, rollout, at, is_playing=is_playing)

    def picture(
        self, size: tuple[int, int], pose: Pose | None = None
    ) -> UInt8[ndarray, "row column 3"]:
        """Take a picture of the frame that was drawn, with what its colors tell.

        Args:
            size: Columns and rows [px].
            pose: Where the camera stands; None for `pose`.

        Returns:
            Red, green, blue.
        """
        # Recordings, for which no picture is drawn, would wait for what draws to be loaded.
        from app.exports.scene_picture import draw_scene

        legend = self._scene.painter.legend
        image = draw_scene(self.server, pose or self.pose, *size, is_dark=self.is_dark)
        return image if legend is None else draw_legend(image, legend, is_dark=self.is_dark)


@dataclass(eq=False, kw_only=True)
class _RoundedRollout(ObjectRollout):
    """Shows rounded positions, but its forces are those of the exact ones."""

    exact: ObjectRollout

    def forces(self, frame: int) -> Float[ndarray, "node 3"]:
        return self.exact.forces(frame)

    def spring_forces(self, frame: int) -> Float[ndarray, "virtual 3"]:
        return self.exact.spring_forces(frame)


@dataclass(frozen=True, eq=False, kw_only=True)
class _RoundedSurface(ObjectSurface):
    """A surface whose vertices are rounded as well."""

    step: float

    def place(self, node: Float[ndarray, "node 3"]) -> Float[ndarray, "vertex 3"]:
        return _on_grid(super().place(node), self.step)


def _on_grid(point: ndarray, step: float) -> ndarray:
    return (np.round(np.asarray(point, np.float64) / step) * step).astype(np.float32)


def _rounded(
    content: Content, rollout: ObjectRollout | None, step: float
) -> tuple[Content, ObjectRollout | None]:
    """Round all that moves to a grid, on which half of a float's digits are zero."""
    hands = tuple(replace(hand, vertex=_on_grid(hand.vertex, step)) for hand in content.hands)
    control = None if content.control is None else _on_grid(content.control, step)
    surface = content.surface
    if surface is not None:
        own = {field.name: getattr(surface, field.name) for field in fields(surface)}
        surface = _RoundedSurface(**own, step=step)
    content = replace(content, hands=hands, control=control, surface=surface)
    if rollout is None:
        return content, None
    arguments = {
        field.name: getattr(rollout, field.name) for field in fields(rollout) if field.init
    }
    arguments |= {
        "position": _on_grid(rollout.position, step),
        "control": _on_grid(rollout.control, step),
    }
    return content, _RoundedRollout(**arguments, exact=rollout)
