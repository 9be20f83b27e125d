"""The USD export, read back by Pixar's library, which also moves the skin."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.moving_scene import FRAMES, NODES, RATE, pyramid, write_run

from physhandi.data.exporters import export_run
from physhandi.errors import UsageError

pytest.importorskip("pxr")


def opened(path: Path) -> Any:
    from pxr import Usd

    return Usd.Stage.Open(str(path))


def points(stage: Any, path: str, frame: int) -> np.ndarray:
    from pxr import UsdGeom

    return np.array(UsdGeom.PointBased(stage.GetPrimAtPath(path)).GetPointsAttr().Get(frame))


def test_surface_and_nodes_move_as_in_the_run(tmp_path: Path) -> None:
    from pxr import UsdGeom

    run, surface = write_run(tmp_path / "fit"), pyramid()
    stage = opened(export_run(run, "usd", tmp_path / "fit.usd", surface=lambda: surface))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    assert stage.GetTimeCodesPerSecond() == RATE
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, FRAMES - 1)
    rollout = run.array("sequences/lift/rollout.npy")
    assert rollout.shape[1] == NODES
    for frame in range(FRAMES):
        np.testing.assert_array_equal(points(stage, "/World/object_nodes", frame), rollout[frame])
        np.testing.assert_array_equal(
            points(stage, "/World/object_surface", frame), surface.vertex[frame]
        )
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/object_surface"))
    index = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(index, surface.face)
    color = np.array(mesh.GetDisplayColorPrimvar().Get())
    np.testing.assert_allclose(255 * color, surface.color, atol=1e-4)
    assert np.array(mesh.GetExtentAttr().Get(2))[1].tolist() == [1.0, 1.0, 3.0]
    normal = np.array(mesh.GetNormalsAttr().Get(1))
    np.testing.assert_allclose(normal[0], -np.array([2, 2, 1]) / 3, atol=1e-6)
    np.testing.assert_array_equal(normal[4], [0, 0, 1])


def test_skinned_hands_move_as_in_the_run(tmp_path: Path) -> None:
    from pxr import Usd, UsdSkel

    run = write_run(tmp_path / "fit")
    stage = opened(export_run(run, "usd", tmp_path / "fit.usd"))
    assert UsdSkel.BakeSkinning(stage.Traverse())
    for side in ("right", "left"):
        expected = run.array(f"sequences/lift/hand_{side}_vertex.npy")
        assert np.abs(expected[1] - expected[0]).max() > 0.1
        for frame in range(FRAMES):
            found = points(stage, f"/World/{side}_hand/surface", frame)
            np.testing.assert_allclose(found, expected[frame], atol=2e-5)
    assert isinstance(stage, Usd.Stage)


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physhandi.data.exporters.usd.find_spec", lambda _: None)
    with pytest.raises(UsageError, match=r"pip install 'physhandi\[usd\]'"):
        export_run(write_run(tmp_path / "fit"), "usd", tmp_path / "fit.usd")
    assert not (tmp_path / "fit.usd").exists()
