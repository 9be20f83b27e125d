"""Writing files so that nobody sees half of one."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physhandi.data.arrays import read_array, write_array
from physhandi.data.files import (
    is_abandoned,
    json_line,
    plain,
    replacing,
    sweep_temporary,
    temporary_name,
    write_atomically,
)


def pid_of_a_dead_process() -> int:
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    return child.pid


def test_a_failing_writer_leaves_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write(stream: object) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, write)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_only_files_of_dead_processes_are_swept(tmp_path: Path) -> None:
    own = tmp_path / temporary_name("x.npy")
    dead = tmp_path / own.name.replace(f"-{os.getpid()}-", f"-{pid_of_a_dead_process()}-")
    folder = tmp_path / dead.name.replace(".x.npy.", ".run.")
    film = dead.with_name(f"{dead.name}.mp4")
    foreign = tmp_path / ".x.npy.elsewhere-1-abc.tmp"
    plain_file = tmp_path / "notes.tmp"
    for path in (own, dead, film, foreign, plain_file):
        path.write_text("x")
    folder.mkdir()
    (folder / "inside.txt").write_text("x")
    assert [is_abandoned(p) for p in (own, dead, film, folder, foreign, plain_file)] == [
        False,
        True,
        True,
        True,
        False,
        False,
    ]
    assert sweep_temporary(tmp_path.iterdir()) == 3
    assert sorted(tmp_path.iterdir()) == sorted([own, foreign, plain_file])


def test_a_file_is_replaced_when_it_is_whole_and_keeps_its_suffix(tmp_path: Path) -> None:
    path = tmp_path / "a.webp"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as beside:
            beside.write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert (path.read_text(), list(tmp_path.iterdir())) == ("old", [path])
    with replacing(path) as beside:
        beside.write_text("new")
        assert (beside.parent, beside.suffix, path.read_text()) == (tmp_path, ".webp", "old")
        assert beside.name.startswith(".")
    assert (path.read_text(), list(tmp_path.iterdir())) == ("new", [path])


def test_plain_data() -> None:
    value = {1: np.float32(0.5), "a": (np.arange(2), Path("/x"), {True}), "n": None}
    assert plain(value) == {"1": 0.5, "a": [[0, 1], "/x", [True]], "n": None}
    assert json_line({"x": [float("nan"), {"y": -float("inf")}, 1.5]}) == (
        '{"x": [null, {"y": null}, 1.5]}'
    )
    with pytest.raises(TypeError, match="object cannot be stored"):
        plain({"x": object()})


def test_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    write_array(path, np.arange(12.0).reshape(3, 4).T)
    np.testing.assert_array_equal(read_array(path), np.arange(12.0).reshape(3, 4).T)
    assert read_array(path).flags.writeable
    assert not read_array(path, mmap=True).flags.writeable
    write_array(path, np.zeros((0, 3)))
    assert read_array(path, mmap=True).shape == (0, 3)
    np.savez(tmp_path / "b.npz", x=np.ones(2))
    with pytest.raises(ValueError, match="an archive, not one array"):
        read_array(tmp_path / "b.npz")
