"""Blender itself imports our glTF and USD.

Where its module is installed: `pip install bpy`, 375 MB.
"""

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.cli import main
from app.settings import BUNDLED
from physhandi.run import Run

FRAMES = (0, 20, 59)
SUFFIX = {"gltf": ".glb", "usd": ".usdc"}
IMPORT = """
import sys
import bpy
import numpy as np

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
path = sys.argv[1]
if path.endswith(".glb"):
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.wm.usd_import(filepath=path)
found = {}
for frame in map(int, sys.argv[4:]):
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    for name in sys.argv[3].split(","):
        drawn = bpy.data.objects[name].evaluated_get(graph)
        found[f"{name}_{frame}"] = np.array(
            [drawn.matrix_world @ vertex.co for vertex in drawn.to_mesh().vertices]
        )
        drawn.to_mesh_clear()
np.savez(sys.argv[2], **found)
"""


needs_blender = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy")


@pytest.fixture(scope="module")
def run() -> Run:
    return Run.open(BUNDLED / "runs" / "towel_fold_quick")


@pytest.fixture
def export(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    def write(kind: str) -> Path:
        scene = tmp_path / f"scene{SUFFIX[kind]}"
        command = ["export", str(run.folder), "--format", kind, "--out", str(scene)]
        monkeypatch.setattr(sys, "argv", ["physhandi", *command])
        with pytest.raises(SystemExit, match="0"):
            main()
        return scene

    return write


def seen_by_blender(scene: Path, *names: str) -> dict[str, np.ndarray]:
    found = scene.with_suffix(".npz")
    arguments = [str(scene), str(found), ",".join(names), *map(str, FRAMES)]
    subprocess.run([sys.executable, "-c", IMPORT, *arguments], check=True, capture_output=True)
    with np.load(found) as seen:
        return dict(seen)


@needs_blender
def test_blender_shows_nodes_and_hand_of_gltf_where_they_are(
    run: Run, export: Callable[[str], Path]
) -> None:
    seen = seen_by_blender(export("gltf"), "object", "right_hand")
    rollout = run.array("sequences/towel_fold/rollout.npy")
    hand = run.array("sequences/towel_fold/hand_right_vertex.npy")
    assert np.abs(rollout[59] - rollout[0]).max() > 0.05
    for frame in FRAMES:
        nodes = seen[f"object_{frame}"][: rollout.shape[1]]
        np.testing.assert_allclose(nodes, rollout[frame], atol=1e-6)
        np.testing.assert_allclose(seen[f"right_hand_{frame}"], hand[frame], atol=1e-6)


@needs_blender
def test_blender_shows_surface_and_hand_of_usd_where_they_are(
    run: Run, export: Callable[[str], Path]
) -> None:
    usd: Any = pytest.importorskip("pxr.Usd")
    geom: Any = pytest.importorskip("pxr.UsdGeom")
    scene = export("usd")
    seen = seen_by_blender(scene, "object_surface", "surface")
    hand = run.array("sequences/towel_fold/hand_right_vertex.npy")
    stage = usd.Stage.Open(str(scene))
    mesh = geom.Mesh(stage.GetPrimAtPath("/World/object_surface"))
    surface = {frame: np.array(mesh.GetPointsAttr().Get(frame)) for frame in FRAMES}
    assert np.abs(surface[59] - surface[0]).max() > 0.05
    for frame in FRAMES:
        np.testing.assert_allclose(seen[f"object_surface_{frame}"], surface[frame], atol=1e-6)
        # Weights of a skinned mesh have single precision, and so do its bones' motions.
        np.testing.assert_allclose(seen[f"surface_{frame}"], hand[frame], atol=2e-5)
