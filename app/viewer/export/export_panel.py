"""Downloads: picture, geometry, rollout, parameters and everything of what is on the screen."""

from collections.abc import Callable
from typing import Any

import cv2
import viser

from app.viewer.content.content import Content
from app.viewer.content.session_state import Pose
from app.viewer.export.bundle import Screenshot, bundle
from app.viewer.export.snapshot import (
    Snapshot,
    snapshot_csv,
    snapshot_gltf,
    snapshot_npz,
    snapshot_ply,
    snapshot_plys,
    snapshot_yaml,
)
from app.viewer.ui.guard import Guard, notify
from physhandi.data.sequence_meta import safe_name
from physhandi.errors import UsageError

LARGEST_SIDE = 4_096
"""Longest side of a picture [px]."""
_SMALLEST_SIDE = 16
_FRAME = ("PNG", "PLY", "ZIP")
_MOTION = ("GLB", "PLYs", "NPZ")
_TABLES = ("CSV", "YAML")
_LONGEST_STEM = 60
_OF_COMPARISON = ("PNG", "NPZ", "CSV", "ZIP")
"""Files that show both sides of a comparison."""
_RENDER_SECONDS = 60.0
_RENDER_SECONDS_PER_PIXEL = 5e-6
_WINDOW, _OWN = "as this window", "own size"
_SIZES: dict[str, tuple[int, int] | None] = {
    _WINDOW: None,
    "1920 x 1080": (1920, 1080),
    "3840 x 2160": (3840, 2160),
    "2048 x 2048": (2048, 2048),
    "4096 x 4096": (4096, 4096),
    _OWN: None,
}


class ExportPanel:
    """Buttons that send files to the client who clicked."""

    def __init__(
        self, server: viser.ViserServer, guard: Guard, snapshot: Callable[[], Snapshot]
    ) -> None:
        """Add the panel where the caller stands.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            snapshot: Tells what is on the screen now.
        """
        self._snapshot = snapshot
        self._groups: dict[str, viser.GuiButtonGroupHandle] = {}
        gui = server.gui
        for label, options, hint in (
            (
                "Frame",
                _FRAME,
                "Picture of this view; points; a ZIP with all data of this view",
            ),
            ("Motion", _MOTION, "All simulated frames as glTF, PLY files or arrays"),
            ("Tables", _TABLES, "Means and forces of each frame; parameters"),
        ):
            buttons = gui.add_button_group(label, options, hint=hint)
            buttons.on_click(guard(self._press))
            self._groups[label] = buttons
        self._size = gui.add_dropdown("Picture", tuple(_SIZES), hint="Size of PNG and ZIP")
        side = (_SMALLEST_SIDE, LARGEST_SIDE, 1)
        self._width = gui.add_number("Width", 1600, min=side[0], max=side[1], step=side[2])
        self._height = gui.add_number("Height", 1200, min=side[0], max=side[1], step=side[2])
        self._size.on_update(guard.by_user(lambda _: self._show_sides()))
        self._show_sides()

    def offer(self, content: Content) -> None:
        """Show the files that a content can be saved as: motion and tables need a result."""
        has_object = content.fitted is not None
        self._groups["Motion"].visible = has_object or bool(content.hands)
        self._groups["Tables"].visible = has_object

    def _show_sides(self) -> None:
        self._width.visible = self._height.visible = self._size.value == _OWN

    def _picture_size(self) -> tuple[int, int] | None:
        if self._size.value == _OWN:
            return int(self._width.value), int(self._height.value)
        return _SIZES[self._size.value]

    def _press(self, event: Any) -> None:
        self.save(event.target.value, event.client)

    def save(self, kind: str, client: viser.ClientHandle) -> None:
        """Send a file to a client, as the button of that name does."""
        snapshot = self._snapshot()
        stem = safe_name(snapshot.content.title, _LONGEST_STEM, joins_unsafe=True) or "physhandi"
        suffix = {"PLYs": "ply.zip"}.get(kind, kind.lower())
        is_of_frame = kind in _FRAME
        if kind in {"PNG", "ZIP"}:
            size = self._picture_size()
            content = write_png(client, snapshot.picture, size)
            if kind == "ZIP":
                picture = Screenshot.of(content, Pose.of(client.camera))
                content = bundle(snapshot, picture)
        else:
            content = _MAKERS[kind](snapshot)
        if snapshot.compared is not None and kind in _OF_COMPARISON:
            stem, is_of_frame = f"{stem}_figure", kind != "NPZ"
        name = f"{stem}_{snapshot.frame:05d}" if is_of_frame else stem
        client.send_file_download(f"{name}.{suffix}", content, save_immediately=True)
        notify(client, "Saved", f"{name}.{suffix}, {len(content) / 1e3:.0f} kB", color="blue")


_MAKERS: dict[str, Callable[[Snapshot], bytes]] = {
    "PLY": snapshot_ply,
    "PLYs": snapshot_plys,
    "GLB": snapshot_gltf,
    "NPZ": snapshot_npz,
    "CSV": snapshot_csv,
    "YAML": snapshot_yaml,
}


def write_png(
    client: viser.ClientHandle,
    picture: Callable[[viser.ClientHandle], dict[str, Any]] | None = None,
    size: tuple[int, int] | None = None,
) -> bytes:
    """Render what a client sees, in its browser.

    Args:
        client: Who looks.
        picture: Finds another camera and size than the client's.
        size: Width and height [px]; None for those of the client's window. A picture with a camera
            of its own keeps its shape and gets the width.

    Raises:
        UsageError: If the size is out of bounds, or the browser does not answer in time.
    """
    camera = client.camera
    scale = min(1.0, LARGEST_SIDE / max(camera.image_height, camera.image_width, 1))
    width, height = size or (
        max(int(camera.image_width * scale), 1),
        max(int(camera.image_height * scale), 1),
    )
    if size is not None and not _SMALLEST_SIDE <= min(size) <= max(size) <= LARGEST_SIDE:
        raise UsageError(
            f"A picture of {width} x {height} pixels is not possible; "
            f"both sides must be from {_SMALLEST_SIDE} to {LARGEST_SIDE}."
        )
    view: dict[str, Any] = {"width": width, "height": height}
    if picture is not None:
        view = picture(client)
        if size is not None:
            ratio = min(width / view["width"], LARGEST_SIDE / view["height"])
            view |= {name: max(round(view[name] * ratio), 1) for name in ("width", "height")}
    seconds = _RENDER_SECONDS + _RENDER_SECONDS_PER_PIXEL * view["width"] * view["height"]
    image = client.get_render(**view, transport_format="png", timeout=seconds)
    order = cv2.COLOR_RGBA2BGRA if image.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    is_written, content = cv2.imencode(".png", cv2.cvtColor(image, order))
    if not is_written:
        raise RuntimeError("the picture could not be encoded")
    return content.tobytes()
