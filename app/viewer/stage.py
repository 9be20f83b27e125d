"""What a session's client sees: the scene or, instead of it, the figure."""

from app.viewer.content import Content
from app.viewer.figure_mode import FigureMode
from app.viewer.scene import Scene
from app.viewer.snapshot import Snapshot
from app.viewer.take import Take


class Stage:
    """Draws the scene or the figure, and hides the other one; used by the clock's thread."""

    def __init__(self, scene: Scene, figure: FigureMode) -> None:
        self.scene = scene
        self._figure = figure
        self._is_figure_shown = False

    def draw(self, frame: int, take: Take | None, take_frame: int, *, is_playing: bool) -> None:
        """Bring what is seen to a frame.

        Args:
            frame: Frame of hands, observation and cameras.
            take: The object's rollout; None without an object.
            take_frame: Frame of the rollout, which may lag behind while it is being computed.
            is_playing: Whether the clock is running.
        """
        is_figure = self._figure.is_on and take is not None
        if is_figure != self._is_figure_shown:
            (self.scene if is_figure else self._figure).hide()
            self._is_figure_shown = is_figure
        if is_figure and take is not None:
            layers = self.scene.layers
            self._figure.draw(take, take_frame, frame, layers, is_playing=is_playing)
        else:
            self.scene.draw(frame, take, take_frame, is_playing=is_playing)

    def snapshot(
        self, content: Content, frame: int, take: Take | None, take_frame: int
    ) -> Snapshot:
        """Collect what is seen, for the export panel."""
        is_figure = self._figure.is_on and take is not None
        return Snapshot(
            content=content,
            frame=frame,
            take=take,
            take_frame=take_frame,
            sides=self._figure.sides(take, take_frame, frame) if is_figure and take else None,
            picture=self._figure.picture if is_figure else None,
        )

    def clear(self) -> None:
        """Remove everything, to make room for another content."""
        self._figure.close()
        self.scene.clear()
