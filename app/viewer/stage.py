"""What a session's client sees: the scene or, instead of it, the figure or two rollouts."""

from dataclasses import replace

from app.viewer.content import Content
from app.viewer.figure_mode import FigureMode
from app.viewer.pin_mode import PinMode
from app.viewer.scene import Scene
from app.viewer.snapshot import Snapshot
from app.viewer.take import Take


class Stage:
    """Draws the scene, the figure or two rollouts, and hides the others; used by the clock."""

    def __init__(self, scene: Scene, figure: FigureMode, pin: PinMode) -> None:
        self.scene = scene
        self._figure = figure
        self._pin = pin
        self._shown: Scene | FigureMode | PinMode = scene

    def draw(self, frame: int, take: Take | None, take_frame: int, *, is_playing: bool) -> None:
        """Bring what is seen to a frame.

        Args:
            frame: Frame of hands, observation and cameras.
            take: The object's rollout; None without an object.
            take_frame: Frame of the rollout, which may lag behind while it is being computed.
            is_playing: Whether the clock is running.
        """
        mode = self._mode(take)
        now = self.scene if mode is None else mode
        if now is not self._shown:
            self._shown.hide()
            self._shown = now
        if mode is None or take is None:
            self.scene.draw(frame, take, take_frame, is_playing=is_playing)
        else:
            mode.draw(take, take_frame, frame, self.scene.layers, is_playing=is_playing)

    def snapshot(
        self, content: Content, frame: int, take: Take | None, take_frame: int
    ) -> Snapshot:
        """Collect what is seen, for the export panel."""
        snapshot = Snapshot(content=content, frame=frame, take=take, take_frame=take_frame)
        mode = self._mode(take)
        if mode is None or take is None:
            return snapshot
        sides = mode.sides(take, take_frame, frame)
        return replace(snapshot, sides=sides, picture=mode.framed_picture)

    def _mode(self, take: Take | None) -> FigureMode | PinMode | None:
        """Tell what is shown instead of the scene."""
        if take is None:
            return None
        return next((mode for mode in (self._pin, self._figure) if mode.is_on), None)

    def clear(self) -> None:
        """Remove everything, to make room for another content."""
        self._pin.stop()
        self._figure.close()
        self.scene.clear()
