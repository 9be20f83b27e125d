"""A run's motion as a recording for Rerun's viewer: meshes, springs, forces, cameras and images.

Written by Rerun's own library, package rerun-sdk: extra `rerun`.
"""

import tempfile
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.exporters.scene_data import MovingSurface, SceneData
from physhandi.data.view import View
from physhandi.errors import UsageError
from physhandi.triangles import unit_normals

_OBJECT, _CONTROL, _HAND = (60, 110, 220), (210, 60, 50), (225, 180, 155)
_SPRING, _VIRTUAL, _FORCE = (120, 130, 150, 120), (240, 200, 40), (210, 30, 30)
_NODE_RADIUS = 0.002
"""Radius of the balls that show nodes [m]."""
_LONGEST_ARROW = 0.08
"""Length of the arrow of the strongest force of all frames [m]."""
_IMAGE_PLANE = 0.1
"""How far before a camera its image is shown [m]."""
_JPEG_QUALITY = 85


def scene_to_rrd(scene: SceneData) -> bytes:
    """Describe hands, object, springs, forces and what the cameras recorded as a Rerun recording.

    Args:
        scene: The motion.

    Raises:
        UsageError: If rerun-sdk is not installed.
    """
    if find_spec("rerun") is None:
        raise UsageError(
            "Writing Rerun recordings needs rerun-sdk, which is not installed: "
            "pip install 'physhandi[rerun]'."
        )
    rerun = import_module("rerun")
    name = f"{scene.run} {scene.sequence}".strip()
    with tempfile.TemporaryDirectory(prefix="physhandi-rrd-") as folder:
        path = Path(folder) / "scene.rrd"
        stream: Any = rerun.RecordingStream("physhandi", recording_id=name or "motion")
        stream.set_log_time_enabled(False)  # When it was exported is of no interest on a timeline.
        stream.save(path)
        _Recording(rerun, stream, scene).write()
        stream.flush()
        stream.disconnect()
        return path.read_bytes()


class _Recording:
    """Writes a scene into a stream of Rerun."""

    def __init__(self, rerun: Any, stream: Any, scene: SceneData) -> None:
        self._rerun, self._stream, self._scene = rerun, stream, scene
        count = scene.rollout.shape[1]
        factor = 1.0 if scene.mass is None or not count else scene.mass.force_factor(count)
        self._forces: list[Float[ndarray, "node 3"]] = []
        if scene.forces is not None:
            self._forces = [factor * scene.forces(frame) for frame in range(scene.frame_count)]
        strongest = max(
            (float(np.linalg.norm(f, axis=1).max(initial=0.0)) for f in self._forces), default=0.0
        )
        self._metres_per_newton = _LONGEST_ARROW / strongest if strongest > 0.0 else 0.0

    def write(self) -> None:
        """Write what stays, and then frame after frame."""
        rerun, scene = self._rerun, self._scene
        self._keep("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._keep("/about", rerun.TextDocument(self._about(), media_type="text/markdown"))
        surfaces = {f"/hands/{side}": (hand, _HAND) for side, hand in scene.hands.items()}
        surface = scene.object_surface()
        if surface is not None:
            surfaces["/object/surface"] = (surface, _OBJECT)
        for path, (moving, plain) in surfaces.items():
            self._keep_triangles(path, moving, plain)
        for view in scene.views:
            self._keep_camera(view)
        for frame in range(scene.frame_count):
            self._stream.set_time("frame", sequence=frame)
            self._stream.set_time("time", duration=frame / scene.frame_rate)
            for path, (moving, _) in surfaces.items():
                self._move(path, moving, frame)
            self._log_object(frame)
            for view in scene.views:
                if view.has_color:
                    self._log_image(view, frame)

    def _about(self) -> str:
        mass, scene = self._scene.mass, self._scene
        weight = (
            "newtons are those of nodes of 1 kg each, since nobody knows what the object weighs"
            if mass is None
            else f"newtons are those of an object of {mass.text} ({mass.source})"
        )
        run = f" of run {scene.run}" if scene.run else ""
        arrow = f"{1e3 * self._metres_per_newton:.6g} mm"
        return (
            f"Sequence {scene.sequence}{run}: lengths in {scene.length_unit}, z up, {weight}. "
            f"An arrow of 1 N is {arrow} long."
        )

    def _keep(self, path: str, *what: Any) -> None:
        self._stream.log(path, *what, static=True)

    def _log(self, path: str, *what: Any) -> None:
        self._stream.log(path, *what)

    def _keep_triangles(self, path: str, moving: MovingSurface, plain: tuple[int, ...]) -> None:
        mesh = self._rerun.Mesh3D
        if moving.face is None:
            self._keep(path, self._rerun.Points3D.from_fields(colors=[plain], radii=_NODE_RADIUS))
        elif moving.color is None:
            fields = {"triangle_indices": moving.face, "albedo_factor": plain}
            self._keep(path, mesh.from_fields(**fields))
        else:
            fields = {"triangle_indices": moving.face, "vertex_colors": moving.color}
            self._keep(path, mesh.from_fields(**fields))

    def _move(self, path: str, moving: MovingSurface, frame: int) -> None:
        vertex = moving.vertex[frame]
        if moving.face is None:
            self._log(path, self._rerun.Points3D.from_fields(positions=vertex))
            return
        normal = unit_normals(vertex, moving.face)
        mesh = self._rerun.Mesh3D
        self._log(path, mesh.from_fields(vertex_positions=vertex, vertex_normals=normal))

    def _log_object(self, frame: int) -> None:
        rerun, scene = self._rerun, self._scene
        node, control = np.asarray(scene.rollout[frame]), np.asarray(scene.control[frame])
        if len(node):
            points = rerun.Points3D(node, colors=[_OBJECT], radii=_NODE_RADIUS)
            self._log("/object/nodes", points)
            ends = scene.spring_nodes[: scene.object_spring_count]
            self._log("/object/springs", rerun.LineStrips3D(node[ends], colors=[_SPRING]))
        if len(control):
            both = np.concatenate([node, control])
            virtual = both[scene.virtual_springs_in(frame)]
            held = rerun.Points3D(control, colors=[_CONTROL], radii=0.5 * _NODE_RADIUS)
            self._log("/control/nodes", held)
            self._log("/control/virtual_springs", rerun.LineStrips3D(virtual, colors=[_VIRTUAL]))
        if self._forces:
            force = self._forces[frame]
            pulled = np.flatnonzero(np.linalg.norm(force, axis=1) > 0.0)
            vectors = self._metres_per_newton * force[pulled]
            arrows = rerun.Arrows3D(vectors=vectors, origins=node[pulled], colors=[_FORCE])
            self._log("/forces", arrows)
            total = float(np.linalg.norm(force.sum(axis=0)))
            self._log("/plots/force_N", rerun.Scalars(total))

    def _keep_camera(self, view: View) -> None:
        rerun, camera = self._rerun, view.camera
        matrix = camera.T_world_camera
        path = f"/cameras/{view.name}"
        self._keep(path, rerun.Transform3D(translation=matrix[:3, 3], mat3x3=matrix[:3, :3]))
        lens = rerun.Pinhole(
            image_from_camera=camera.K,
            width=camera.width,
            height=camera.height,
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=_IMAGE_PLANE,
        )
        self._keep(path, lens)

    def _log_image(self, view: View, frame: int) -> None:
        """Write an image as Rerun's pinhole cameras see: without the lens's distortion."""
        camera, image = view.camera, view.color(frame)
        if np.any(camera.distortion):
            image = cv2.undistort(image, camera.K, camera.distortion)
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        _, content = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
        jpeg = self._rerun.EncodedImage(contents=content.tobytes(), media_type="image/jpeg")
        self._log(f"/cameras/{view.name}/image", jpeg)
