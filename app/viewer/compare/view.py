"""One comparison in a viser server: its drawing, panel, difference and cameras."""

from collections.abc import Callable, Iterable
from typing import Any

import viser

from app.viewer.compare.camera import ComparisonCameras, Eye
from app.viewer.compare.curve import DifferenceCurve, Pairing
from app.viewer.compare.drawing import CompareDrawing, Look
from app.viewer.compare.panel import ComparePanel
from app.viewer.compare.sides import Sides
from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose
from app.viewer.scene.framing import Framing
from app.viewer.ui.guard import Guard
from physhandi.object_rollout import ObjectRollout


class CompareView:
    """Shows two rollouts in one scene, so that clock and camera are one by construction."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        *,
        content: Content,
        framing: Framing,
        rollouts: Iterable[ObjectRollout],
        cameras: ComparisonCameras,
        look: Look,
        redraw: Callable[[], None],
    ) -> None:
        """Add the panel where the caller stands.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            content: Gives the ground, and what has to fit if there are no rollouts.
            framing: Sizes.
            rollouts: Complete rollouts, which have to fit.
            cameras: Where the clients' cameras stood before.
            look: How it begins.
            redraw: Draws the current frame again.
        """
        self.look = look
        self.drawing = CompareDrawing(server, content, framing, rollouts, look)
        self._server = server
        self._cameras = cameras
        self._redraw = redraw
        self._framed_as = (look.mode, look.is_figure)
        self._panel: ComparePanel | None = None
        self.curve = DifferenceCurve(self._measured)
        self.panel = self._panel = ComparePanel(
            server, guard, look, self.curve, change=self._change
        )

    def draw(self, tick: int, sides: Sides, layers: Layers, *, is_playing: bool) -> None:
        """Bring both sides to a moment; runs in the thread that draws."""
        self.drawing.draw(sides, layers, self.curve.way, is_playing=is_playing)
        self.panel.show(tick, is_playing=is_playing)

    def follow(self, pairing: Pairing | None) -> None:
        """Measure the difference of these rollouts from now on."""
        self.curve.follow(pairing)

    def enter(self) -> None:
        """Show both sides to all clients."""
        if self.look.mode == "side":
            for client in self._server.get_clients().values():
                self._aim(client, Pose.of(client.camera))

    def leave(self) -> None:
        """Let all cameras stand again where they stood before."""
        self._cameras.restore(self._server)

    def close(self) -> None:
        """Stop measuring, and rollout scene and panel away."""
        self.curve.close()
        self.drawing.clear()
        self.panel.remove()

    def welcome(self, client: viser.ClientHandle) -> None:
        """Show both sides to a client that has just come."""
        if self.look.mode == "side":
            self._aim(client, Pose.first(self._server.initial_camera))

    def turn(self, client: viser.ClientHandle) -> None:
        """Let the sides follow a client's camera."""
        if self.look.mode == "side" and self._cameras.has_lost(client):
            self._aim(client, self._cameras.before(client))
            return
        self.drawing.turn(Eye.of(client.camera.wxyz))
        if self.look.mode == "wipe":
            self._redraw()

    def reset_view(self, client: viser.ClientHandle) -> bool:
        """Show both sides whole to a client that looked elsewhere; False if one has its own way."""
        if self.look.mode == "side":
            self._aim(client, Pose.of(client.camera))
        return self.look.mode == "side"

    def picture(self) -> Callable[[viser.ClientHandle], dict[str, Any]] | None:
        """Find camera and size of a picture of both sides; None if the client's own will do."""
        return self._picture if self.look.mode == "side" else None

    def _picture(self, client: viser.ClientHandle) -> dict[str, Any]:
        return self._cameras.picture(client, self.drawing.box(Eye.of(client.camera.wxyz)))

    def _aim(self, client: viser.ClientHandle, pose: Pose) -> None:
        eye = Eye.at(pose)
        self._cameras.aim(client, pose, self.drawing.box(eye))
        self.drawing.turn(eye)

    def _change(self) -> None:
        """Move the cameras if the sides or what is around them have moved, and draw again."""
        framed_as = (self.look.mode, self.look.is_figure)
        if framed_as != self._framed_as:
            self._framed_as = framed_as
            (self.enter if self.look.mode == "side" else self.leave)()
        self._redraw()

    def _measured(self) -> None:
        """Take in what was measured; runs in the thread of the curve."""
        if self._panel is not None and self._panel.follow() and self.look.tint == "difference":
            self._redraw()
