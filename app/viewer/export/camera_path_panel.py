"""Key frames of a film's camera: set, visited, moved and deleted, and shown as a line in space."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
import viser.transforms

from app.viewer.content.camera_path import CameraPath
from app.viewer.content.session_state import KeyFrame, Pose
from app.viewer.ui.guard import Guard, notify

_NONE = "none yet"
_ADD, _SAVE = "Add key frame", "Save"
_GO, _MOVE, _DELETE = "Go to", "Move here", "Delete"
_LINE, _CHOSEN, _KEY = (240, 140, 30), (240, 140, 30), (150, 120, 90)
_POINTS_PER_GAP = 24
_ASPECT = 16 / 9


class CameraPathPanel:
    """Controls of a camera path, which films of this scene follow."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        frame: Callable[[], int],
        seek: Callable[[int], None],
    ) -> None:
        """Add the controls where the caller stands.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            frame: Tells the frame on the screen.
            seek: Goes to a frame, and stops there.
        """
        self._server = server
        self._frame, self._seek = frame, seek
        self._lock = threading.RLock()
        self._keys: dict[int, KeyFrame] = {}
        self._path: CameraPath | None = None
        self._nodes: list[Any] = []
        self._frustum = 0.05
        gui = server.gui
        path = gui.add_button_group(
            "Camera path",
            (_ADD, _SAVE),
            hint="What films follow. Add: the camera as it stands, in this frame. Save: as JSON",
        )
        path.on_click(guard(self._press))
        self._choice: viser.GuiDropdownHandle[Any] = gui.add_dropdown(
            "Key frame", (_NONE,), hint="Of the camera path that films follow"
        )
        self._choice.on_update(guard.by_user(lambda _: self._show()))
        self._deeds = gui.add_button_group(
            "This one", (_GO, _MOVE, _DELETE), hint="What to do with the key frame that is chosen"
        )
        self._deeds.on_click(guard(self._act))
        self._follows = gui.add_checkbox(
            "Play along the path", False, hint="The camera follows the path while frames play"
        )
        self._follows.on_update(guard.by_user(lambda _: self._show()))
        self._show()

    @property
    def path(self) -> CameraPath | None:
        """The path; None without key frames."""
        return self._path

    def replace(self, frustum: float) -> None:
        """Begin without key frames, as for another sequence.

        Args:
            frustum: Scale of the frustums that show key frames.
        """
        with self._lock:
            self._keys.clear()
            self._frustum = frustum
            self._follows.value = False
            self._show()

    def take(self, keys: tuple[KeyFrame, ...]) -> None:
        """Go on with key frames of another scene."""
        with self._lock:
            self._keys = {key.frame: key for key in keys}
            self._show()

    def follow(self, frame: int) -> None:
        """Put all cameras where the path is in a frame, if that was asked for."""
        path = self._path
        if path is None or not self._follows.value:
            return
        pose = path.at(frame)
        for client in self._server.get_clients().values():
            pose.give(client)

    def _press(self, event: Any) -> None:
        if event.target.value == _ADD:
            self._add(event)
        else:
            self._save(event)

    def _add(self, event: Any) -> None:
        with self._lock:
            frame = self._frame()
            self._keys[frame] = KeyFrame(frame=frame, pose=Pose.of(event.client.camera))
            self._show(frame)

    def _act(self, event: Any) -> None:
        with self._lock:
            chosen = self._chosen()
            if chosen is None:
                notify(event.client, "No key frame", "Add one first.", color="blue")
                return
            deed = event.target.value
            if deed == _GO:
                self._seek(chosen)
                self._keys[chosen].pose.give(event.client)
            else:
                del self._keys[chosen]
                if deed == _MOVE:
                    self._add(event)
                else:
                    self._show()

    def _save(self, event: Any) -> None:
        if self._path is None:
            notify(event.client, "No key frame", "Add one first.", color="blue")
            return
        content = self._path.to_text().encode()
        event.client.send_file_download("camera_path.json", content, save_immediately=True)

    def _chosen(self) -> int | None:
        """Frame of the key frame that is chosen."""
        label = self._choice.value
        return None if label == _NONE else int(label.removeprefix("frame "))

    def _show(self, chosen: int | None = None) -> None:
        """Bring list and scene up to date, and choose a key frame, if one is named."""
        with self._lock, self._server.atomic():
            frames = sorted(self._keys)
            self._path = CameraPath(tuple(self._keys.values())) if frames else None
            labels = tuple(f"frame {frame}" for frame in frames) or (_NONE,)
            was = self._choice.value
            if tuple(self._choice.options) != labels:
                self._choice.options = labels
            wanted = f"frame {chosen}"
            self._choice.value = wanted if wanted in labels else was if was in labels else labels[0]
            self._deeds.visible = self._follows.visible = bool(frames)
            for node in self._nodes:
                node.remove()
            self._nodes.clear()
            # Whoever flies along would only see the line that they fly on.
            if self._path is not None and not self._follows.value:
                self._draw(self._path)

    def _draw(self, path: CameraPath) -> None:
        scene, chosen = self._server.scene, self._chosen()
        for key in path.keys:
            camera = key.pose.camera(160, 90)
            self._nodes.append(
                scene.add_camera_frustum(
                    f"/camera_path/{key.frame}",
                    fov=key.pose.fov,
                    aspect=_ASPECT,
                    thickness=1.5,
                    thickness_units="screen",
                    scale=self._frustum * (0.5 if key.frame == chosen else 0.35),
                    color=_CHOSEN if key.frame == chosen else _KEY,
                    wxyz=viser.transforms.SO3.from_matrix(camera.T_world_camera[:3, :3]).wxyz,
                    position=camera.T_world_camera[:3, 3],
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        if len(path.keys) > 1:
            first, last = path.keys[0].frame, path.keys[-1].frame
            times = np.linspace(first, last, _POINTS_PER_GAP * (len(path.keys) - 1) + 1)
            place = np.array([path.at(float(time)).position for time in times], np.float32)
            segments = np.stack([place[:-1], place[1:]], axis=1)
            line = scene.add_line_segments(
                "/camera_path/way",
                segments,
                np.array(_LINE, np.uint8),
                thickness=2.0,
                thickness_units="screen",
            )
            self._nodes.append(line)
