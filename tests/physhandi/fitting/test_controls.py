"""Choosing control points, and whether a rope's recordings tell how it is held."""

from pathlib import Path

import numpy as np
import pytest

from physhandi.data.importers.mocap import import_mocap
from physhandi.data.sequence import Sequence
from physhandi.errors import MissingInputError, SequenceError
from physhandi.fitting.config import load_profile
from physhandi.fitting.placement import bends_as_rod, control_trajectory_of, farthest_points


def test_farthest_points_spread() -> None:
    line = np.array([[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [0.5, 0, 0]], float)
    assert farthest_points(line, 3).tolist() == [0, 2, 3]
    assert sorted(farthest_points(line, 9)) == [0, 1, 2, 3]


def imported(folder: Path, **options: int) -> Sequence:
    """A straight rope of five markers that hangs still in two grippers."""
    marker = np.zeros((20, 5, 3))
    marker[:, :, 0] = 0.1 * np.arange(5)
    np.save(folder / "rope.npy", marker)
    held = {"controlled_markers": (0, 1, 4), "overwrite": True}
    (sequence,) = import_mocap(folder / "rope.npy", folder / "out", **(held | options))
    return sequence


def test_a_rope_bends_where_its_recordings_tell_how_it_is_held(tmp_path: Path) -> None:
    quick, paper = load_profile("quick"), load_profile("paper")
    fine = imported(tmp_path, nodes_per_segment=4)
    assert not bends_as_rod([fine], quick)
    sequence = imported(tmp_path)
    assert bends_as_rod([sequence], quick)
    assert not bends_as_rod([sequence], paper)
    assert control_trajectory_of(sequence, (), quick).shape == (6, 3, 3)
    control = control_trajectory_of(sequence, (), quick, is_rod=True)
    np.testing.assert_allclose(control[:, 3], np.tile([[0.0, 0.0, 0.05]], (6, 1)), atol=1e-7)

    (sequence.folder / "held_point.npy").unlink()
    old = Sequence.load(sequence.folder)
    assert not bends_as_rod([sequence, old], quick)
    with pytest.raises(MissingInputError, match=r"'rope' has no held_point\.npy"):
        control_trajectory_of(old, (), quick, is_rod=True)


def test_a_held_point_without_a_rope_is_refused(tmp_path: Path) -> None:
    sequence = imported(tmp_path)
    (sequence.folder / "control.npy").unlink()
    with pytest.raises(SequenceError, match=r"held_point.npy .* but control.npy is missing"):
        Sequence.load(sequence.folder)
