"""Blender itself imports our glTF, where its module is installed (`pip install bpy`, 375 MB)."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from app.cli import main
from app.settings import BUNDLED
from physhandi.run import Run

FRAMES = (0, 20, 59)
IMPORT = """
import sys
import bpy
import numpy as np

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
found = {}
for frame in map(int, sys.argv[3:]):
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    for name in ("object", "right_hand"):
        drawn = bpy.data.objects[name].evaluated_get(graph)
        found[f"{name}_{frame}"] = np.array(
            [drawn.matrix_world @ vertex.co for vertex in drawn.to_mesh().vertices]
        )
        drawn.to_mesh_clear()
np.savez(sys.argv[2], **found)
"""


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy")
def test_blender_shows_object_and_hand_where_they_are(tmp_path: Path, monkeypatch) -> None:
    scene, found = tmp_path / "scene.glb", tmp_path / "found.npz"
    run = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    export = ["export", str(run.folder), "--format", "gltf", "--out", str(scene)]
    monkeypatch.setattr(sys, "argv", ["physhandi", *export])
    with pytest.raises(SystemExit, match="0"):
        main()
    arguments = [str(scene), str(found), *map(str, FRAMES)]
    subprocess.run([sys.executable, "-c", IMPORT, *arguments], check=True, capture_output=True)
    rollout = run.array("sequences/towel_fold/rollout.npy")
    hand = run.array("sequences/towel_fold/hand_right_vertex.npy")
    assert np.abs(rollout[59] - rollout[0]).max() > 0.05
    with np.load(found) as seen:
        for frame in FRAMES:
            nodes = seen[f"object_{frame}"][: rollout.shape[1]]
            np.testing.assert_allclose(nodes, rollout[frame], atol=1e-6)
            np.testing.assert_allclose(seen[f"right_hand_{frame}"], hand[frame], atol=1e-6)
