"""A run's motion as a USD stage, for Blender, Houdini, Omniverse and Isaac Sim.

The object's surface and nodes have time samples of their points, a hand is skinned (UsdSkel).
Written by Pixar's own library, package usd-core: extra `usd`.
"""

import tempfile
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from physhandi.data.exporters.scene_data import MovingSurface, SceneData
from physhandi.errors import UsageError
from physhandi.triangles import unit_normals

_OBJECT, _HAND = (0.24, 0.43, 0.86), (0.88, 0.71, 0.61)
_NODE_WIDTH = 0.004
"""Width of the balls that show nodes [m]."""


def scene_to_usd(scene: SceneData) -> bytes:
    """Describe hands, object nodes and the object's surface of all frames as binary USD.

    Args:
        scene: The motion.

    Raises:
        UsageError: If usd-core is not installed.
    """
    if find_spec("pxr") is None:
        raise UsageError(
            "Writing USD needs usd-core, which is not installed: pip install 'physhandi[usd]'."
        )
    usd = _pxr("Usd")
    with tempfile.TemporaryDirectory(prefix="physhandi-usd-") as folder:
        path = Path(folder) / "scene.usdc"
        stage: Any = usd.Stage.CreateNew(str(path))
        _Stage(stage, scene).write()
        stage.GetRootLayer().Save()
        del stage
        return path.read_bytes()


class _Stage:
    """Writes a scene into a stage of USD."""

    def __init__(self, stage: Any, scene: SceneData) -> None:
        self._stage, self._scene, self._geom = stage, scene, _pxr("UsdGeom")

    def write(self) -> None:
        """Write everything below ``/World``."""
        stage, scene = self._stage, self._scene
        self._geom.SetStageUpAxis(stage, self._geom.Tokens.z)
        self._geom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(scene.frame_rate)
        stage.SetFramesPerSecond(scene.frame_rate)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(scene.frame_count - 1)
        root = self._geom.Xform.Define(stage, "/World").GetPrim()
        stage.SetDefaultPrim(root)
        about = {"sequence": scene.sequence, "run": scene.run, "length_unit": scene.length_unit}
        root.SetCustomDataByKey("physhandi", about)
        for side, hand in scene.hands.items():
            if side in scene.skins:
                self._add_skinned_hand(side, scene.skins[side])
            else:
                self._add_surface(f"{side}_hand", hand, _HAND)
        surface = scene.object_surface()
        if scene.rollout.shape[1]:
            self._add_nodes(is_hidden=surface is not None)
        if surface is not None:
            self._add_surface("object_surface", surface, _OBJECT)

    def _add_nodes(self, *, is_hidden: bool) -> None:
        points = self._geom.Points.Define(self._stage, "/World/object_nodes")
        self._animate_points(points, self._scene.rollout)
        points.CreateWidthsAttr(_vt("Float", np.full(1, _NODE_WIDTH, np.float32)))
        points.SetWidthsInterpolation(self._geom.Tokens.constant)
        points.CreateDisplayColorAttr([_OBJECT])
        # Where there is a surface, balls would stick out of it.
        if is_hidden:
            points.CreatePurposeAttr(self._geom.Tokens.guide)

    def _add_surface(self, name: str, surface: MovingSurface, plain: tuple[float, ...]) -> None:
        if surface.face is None:
            return
        vertex = surface.vertex[: self._scene.frame_count]
        mesh = self._mesh(f"/World/{name}", surface.face, plain, surface.color)
        self._animate_points(mesh, vertex)
        normals = mesh.CreateNormalsAttr()
        mesh.SetNormalsInterpolation(self._geom.Tokens.vertex)
        for frame, point in enumerate(vertex):
            normals.Set(_vectors(unit_normals(point, surface.face)), frame)

    def _mesh(
        self, path: str, face: ndarray, plain: tuple[float, ...], color: ndarray | None
    ) -> Any:
        mesh = self._geom.Mesh.Define(self._stage, path)
        mesh.CreateSubdivisionSchemeAttr(self._geom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateFaceVertexCountsAttr(_vt("Int", np.full(len(face), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(_vt("Int", face.astype(np.int32).reshape(-1)))
        if color is None:
            mesh.CreateDisplayColorAttr([plain])
        else:
            mesh.CreateDisplayColorAttr(_vectors(color / 255))
            mesh.GetDisplayColorPrimvar().SetInterpolation(self._geom.Tokens.vertex)
        return mesh

    def _animate_points(self, shape: Any, position: ndarray) -> None:
        points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
        for frame, point in enumerate(position):
            points.Set(_vectors(point), frame)
            extent.Set(_vectors(np.stack([point.min(axis=0), point.max(axis=0)])), frame)

    def _add_skinned_hand(self, side: str, skin: Mapping[str, ndarray]) -> None:
        linear, skinning = _pxr("Gf"), _pxr("UsdSkel")
        path = f"/World/{side}_hand"
        root = skinning.Root.Define(self._stage, path)
        names: list[str] = []
        texts = bytes(skin["name"]).decode().split("\n")
        for text, parent in zip(texts, skin["parent"].tolist(), strict=True):
            names.append(text if parent < 0 else f"{names[parent]}/{text}")
        skeleton = skinning.Skeleton.Define(self._stage, f"{path}/skeleton")
        skeleton.CreateJointsAttr(names)
        bind = np.linalg.inv(skin["T_bone_hand"].astype(np.float64))
        # USD's matrices act on rows.
        skeleton.CreateBindTransformsAttr([linear.Matrix4d(matrix.T.tolist()) for matrix in bind])
        local = [
            matrix if parent < 0 else np.linalg.inv(bind[parent]) @ matrix
            for matrix, parent in zip(bind, skin["parent"].tolist(), strict=True)
        ]
        skeleton.CreateRestTransformsAttr([linear.Matrix4d(matrix.T.tolist()) for matrix in local])
        motion = skinning.Animation.Define(self._stage, f"{path}/motion")
        motion.CreateJointsAttr(names)
        ones = _vt("Vec3h", np.ones((len(names), 3), np.float16))
        motion.CreateScalesAttr(ones)
        translations, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
        for frame in range(self._scene.frame_count):
            translations.Set(_vectors(skin["translation"][frame]), frame)
            turn = [linear.Quatf(w, x, y, z) for x, y, z, w in skin["rotation"][frame].tolist()]
            rotations.Set(turn, frame)
        mesh = self._mesh(f"{path}/surface", skin["faces"], _HAND, None)
        mesh.CreatePointsAttr(_vectors(skin["vertex"]))
        for prim in (skeleton.GetPrim(), mesh.GetPrim()):
            skinning.BindingAPI.Apply(prim)
        skinning.BindingAPI(skeleton).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
        binding = skinning.BindingAPI(mesh)
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        binding.CreateGeomBindTransformAttr(linear.Matrix4d(1.0))
        width = skin["vertex_bone"].shape[1]
        index = binding.CreateJointIndicesPrimvar(False, width)
        index.Set(_vt("Int", skin["vertex_bone"].astype(np.int32).reshape(-1)))
        weight = binding.CreateJointWeightsPrimvar(False, width)
        weight.Set(_vt("Float", skin["vertex_weight"].astype(np.float32).reshape(-1)))
        self._bound(root)

    def _bound(self, root: Any) -> None:
        """Say how large a skinned hand is in each frame, which no reader can see by its points."""
        side = root.GetPath().name.removesuffix("_hand")
        extent = root.CreateExtentAttr()
        for frame, point in enumerate(self._scene.hands[side].vertex[: self._scene.frame_count]):
            extent.Set(_vectors(np.stack([point.min(axis=0), point.max(axis=0)])), frame)


def _pxr(module: str) -> Any:
    """Import a module of USD, which has no types."""
    return import_module(f"pxr.{module}")


def _vt(kind: str, array: ndarray) -> Any:
    return getattr(_pxr("Vt"), f"{kind}ArrayFromBuffer")(np.ascontiguousarray(array))


def _vectors(array: ndarray) -> Any:
    return _vt("Vec3f", array.astype(np.float32))
