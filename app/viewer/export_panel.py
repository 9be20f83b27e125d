"""Downloads: picture, geometry, rollout and parameters of what is on the screen."""

import csv
import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import viser
import yaml

from app.viewer.content import Content
from app.viewer.figure import Side
from app.viewer.figure_export import write_figure_csv, write_figure_npz
from app.viewer.guard import Guard, notify
from app.viewer.layers import GREEN, RED, SKIN
from app.viewer.take import Take
from physhandi.data.exporters.mesh import frame_to_ply, ply_bytes
from physhandi.data.exporters.scene_data import HandSurface, SceneData
from physhandi.errors import MissingInputError

_GEOMETRY = ("PNG", "PLY")
_NUMBERS = ("NPZ", "CSV", "YAML")
_OF_FIGURE = ("PNG", "NPZ", "CSV")
_RENDER_SECONDS = 20.0
_MAX_SIDE = 2_160


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """What is on the screen now, for the export panel."""

    content: Content
    """What is shown."""
    frame: int
    """The frame."""
    take: Take | None
    """The object's rollout."""
    take_frame: int
    """Frame of the rollout."""
    sides: Mapping[str, Side] | None = None
    """Both halves of the figure, if the figure is shown."""
    picture: Callable[[viser.ClientHandle], dict[str, Any]] | None = None
    """Finds the camera of the figure's picture, if the figure is shown."""


class ExportPanel:
    """Buttons that send files to the client who clicked."""

    def __init__(self, server: viser.ViserServer, guard: Guard, snapshot: Any) -> None:
        """Add the panel.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            snapshot: Function without arguments that returns the `Snapshot` of now.
        """
        self._snapshot = snapshot
        with server.gui.add_folder("Export", expand_by_default=False):
            for label, options, hint in (
                ("Frame", _GEOMETRY, "Picture of this view, or points of this frame"),
                ("Rollout", _NUMBERS, "All simulated frames, node means a frame, parameters"),
            ):
                buttons = server.gui.add_button_group(label, options, hint=hint)
                buttons.on_click(guard(self._press))

    def _press(self, event: Any) -> None:
        snapshot: Snapshot = self._snapshot()
        kind, client = event.target.value, event.client
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", snapshot.content.title)[:60] or "physhandi"
        make = {"PLY": write_ply, "NPZ": write_npz, "CSV": write_csv, "YAML": write_yaml}
        sides = snapshot.sides
        is_of_frame = kind in _GEOMETRY
        if kind == "PNG":
            content = write_png(client, snapshot.picture)
        elif sides is not None and kind in {"NPZ", "CSV"}:
            content = write_figure_npz(sides) if kind == "NPZ" else write_figure_csv(sides)
            is_of_frame = kind == "CSV"
        else:
            content = make[kind](snapshot)
        stem = stem if sides is None or kind not in _OF_FIGURE else f"{stem}_figure"
        name = f"{stem}_{snapshot.frame:05d}" if is_of_frame else stem
        client.send_file_download(f"{name}.{kind.lower()}", content, save_immediately=True)
        notify(client, "Saved", f"{name}.{kind.lower()}, {len(content) / 1e3:.0f} kB", color="blue")


def write_png(
    client: viser.ClientHandle,
    picture: Callable[[viser.ClientHandle], dict[str, Any]] | None = None,
) -> bytes:
    """Render what a client sees.

    Args:
        client: Who looks.
        picture: Finds another camera and size than the client's.
    """
    camera = client.camera
    scale = min(1.0, _MAX_SIDE / max(camera.image_height, camera.image_width, 1))
    view: dict[str, Any] = {
        "height": max(int(camera.image_height * scale), 1),
        "width": max(int(camera.image_width * scale), 1),
    }
    view = view if picture is None else picture(client)
    image = client.get_render(**view, transport_format="png", timeout=_RENDER_SECONDS)
    order = cv2.COLOR_RGBA2BGRA if image.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    is_written, content = cv2.imencode(".png", cv2.cvtColor(image, order))
    if not is_written:
        raise RuntimeError("the picture could not be encoded")
    return content.tobytes()


def write_ply(snapshot: Snapshot) -> bytes:
    """Write the frame: the object with its controls and hands, or else what is there of them."""
    content, take = snapshot.content, snapshot.take
    if take is not None:
        return frame_to_ply(_scene(content, take), snapshot.take_frame)
    frame = snapshot.frame
    parts: list[tuple[Any, tuple[int, int, int]]]
    parts = [(hand.vertex[frame], SKIN[hand.side]) for hand in content.hands]
    if not parts and content.control is not None:
        parts.append((content.control[frame], RED))
    if content.observed is not None:
        parts.append((content.observed.points(frame), GREEN))
    if not parts:
        raise MissingInputError("This frame shows no geometry to save.")
    color = [np.tile(np.array(color, np.uint8), (len(point), 1)) for point, color in parts]
    return ply_bytes(
        np.concatenate([np.asarray(point, np.float32) for point, _ in parts]),
        np.concatenate(color),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 2), np.int32),
    )


def _scene(content: Content, take: Take) -> SceneData:
    return SceneData(
        sequence=content.sequence_name,
        frame_rate=content.frame_rate,
        length_unit=content.length_unit,
        rollout=take.position,
        control=take.control,
        spring_nodes=take.model.spring_nodes,
        object_spring_count=take.model.object_spring_count,
        hands={h.side: HandSurface(vertex=h.vertex, face=h.face) for h in content.hands},
    )


def write_npz(snapshot: Snapshot) -> bytes:
    """Write all frames: rollout, springs and controls, as they are on the screen."""
    take, content = snapshot.take, snapshot.content
    arrays: dict[str, Any] = {}
    if take is not None:
        arrays = {
            "position": take.position[: take.ready],
            "control": take.control[: take.ready],
            "spring_nodes": take.model.spring_nodes,
            "rest_length": take.model.rest_length,
            "stiffness": take.model.stiffness,
            "object_spring_count": np.int64(take.model.object_spring_count),
        }
    elif content.control is not None:
        arrays["control"] = content.control
    for hand in content.hands:
        arrays[f"hand_{hand.side}_vertex"] = hand.vertex
    if not arrays:
        raise MissingInputError("There is no rollout to save; this is a recording only.")
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def write_csv(snapshot: Snapshot) -> bytes:
    """Write a table with one row a frame: mean position and force, largest speed."""
    take = _take(snapshot)
    stream = io.StringIO()
    table = csv.writer(stream)
    table.writerow(
        ["frame", "time_s", "mean_x", "mean_y", "mean_z", "force_x", "force_y", "force_z"]
    )
    for frame in range(take.ready):
        mean = np.asarray(take.position[frame]).mean(axis=0)
        force = take.forces(frame).sum(axis=0)
        seconds = frame / take.parameters.frame_rate
        table.writerow([frame, f"{seconds:.6g}", *(f"{v:.6g}" for v in (*mean, *force))])
    return stream.getvalue().encode()


def write_yaml(snapshot: Snapshot) -> bytes:
    """Write the parameters of the rollout that is on the screen."""
    return yaml.safe_dump(_take(snapshot).parameters.to_dict(), sort_keys=False).encode()


def _take(snapshot: Snapshot) -> Take:
    if snapshot.take is None:
        raise MissingInputError("There is no simulated object here to save.")
    return snapshot.take
