"""Places that cannot be written to or read: occupied, forbidden, full, or of another kind."""

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile.bad_input_world import Terminal, table, tree
from support.waiting import LIMIT_S

from physhandi import pipeline
from physhandi.run import Run

ROOT = Path(__file__).parents[2]
RECONSTRUCT = ("reconstruct", "sheet", "--device", "cpu", "--out")
SIMULATE = ("simulate", "fitted", "--device", "cpu", "--out")
ROPE = ("import", "mocap", "rope.npy", "--out")
EXPORT = ("export", "fitted", "--format")


@pytest.fixture
def here(terminal: Terminal, sheet: Path, fitted: Path) -> Terminal:
    """A folder with a recording, a rope, a finished run and something else of the user's."""
    time, along = np.meshgrid(np.arange(100) / 100, np.linspace(0, 1, 13), indexing="ij")
    wave = np.stack([along, 0.1 * np.sin(3 * time), 1 + 0.05 * along * time], axis=-1)
    np.save(terminal.folder / "rope.npy", wave)
    (terminal.folder / "file").write_text("precious")
    (terminal.folder / "full").mkdir()
    (terminal.folder / "full" / "note.txt").write_text("precious")
    return terminal


OCCUPIED = {
    # order, exit code, what the message names
    "fit over a file": ((*RECONSTRUCT, "file"), 1, ("file", "exists already")),
    "fit below a file": ((*RECONSTRUCT, "file/run"), 1, ("file", "choose another")),
    "fit into a full folder": ((*RECONSTRUCT, "full"), 1, ("full", "not empty")),
    "fit into another run": ((*RECONSTRUCT, "fitted"), 2, ("fitted", "another run")),
    "simulation over its own run": ((*SIMULATE, "fitted"), 2, ("fitted", "another run")),
    "simulation below a file": ((*SIMULATE, "file/run"), 1, ("file", "choose another")),
    "rope over a file": (
        ("import", "mocap", "rope.npy", "--out", "file"),
        1,
        ("file", "choose another"),
    ),
    "stereo into a full folder": (
        ("import", "stereo", "full", "--out", "full"),
        1,
        ("full", "cam0"),
    ),
    "archive over a file": ((*EXPORT, "npz", "--out", "file"), 2, ("file", "exists already")),
    "archive over a folder": (
        (*EXPORT, "npz", "--out", "full", "--overwrite"),
        2,
        ("full", "folder", "Choose another"),
    ),
    "meshes into a full folder": (
        (*EXPORT, "ply", "--out", "full", "--overwrite"),
        2,
        ("full", "other things"),
    ),
    "meshes below a file": (
        (*EXPORT, "ply", "--out", "file/meshes"),
        1,
        ("file", "choose another"),
    ),
    "table below a file": ((*EXPORT, "csv", "--out", "file/a.csv"), 1, ("file", "choose another")),
    "data folder that is a file": (
        ("serve", "--port", "0", "--data-dir", "file"),
        2,
        ("data_dir", "file", "name a folder"),
    ),
    "data folder of another order that is a file": (
        ("evaluate", "run", "mine", "--data-dir", "file"),
        2,
        ("data_dir", "file", "name a folder"),
    ),
    "data folder below a file": (
        ("serve", "--port", "0", "--data-dir", "file/data"),
        1,
        ("file", "choose another"),
    ),
}


@table(OCCUPIED)
def test_an_occupied_place_is_left_alone(here: Terminal, case: tuple[Any, int, Any]) -> None:
    order, code, words = case
    here.refused(code, words, *order)


@contextmanager
def failing(name: str, error: int, below: Path, after: int) -> Iterator[list[str]]:
    """Let a call of the operating system fail after some good ones, below a folder."""
    original, calls = getattr(os, name), list[str]()

    def call(target: Any, *rest: Any, **options: Any) -> Any:
        opened = Path(f"/proc/self/fd/{target}")
        where = opened.readlink() if isinstance(target, int) else target
        path = os.path.abspath(os.fsdecode(where))  # noqa: PTH100 - as the call sees it
        # A folder that is there already is not made; asking for it may fail without harm.
        if Path(path).is_relative_to(below) and not (name == "mkdir" and Path(path).is_dir()):
            calls.append(path)
            if len(calls) > after:
                named = () if isinstance(target, int) else (path,)
                raise OSError(error, os.strerror(error), *named)
        return original(target, *rest, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, name, call)
        yield calls


WRITES = {
    "fit": (*RECONSTRUCT, "out"),
    "simulation": (*SIMULATE, "out"),
    "import": (*ROPE, "out"),
    "archive": (*EXPORT, "npz", "--out", "out.npz"),
    "table": (*EXPORT, "csv", "--out", "out.csv"),
    "tables": (*EXPORT, "csv", "--out", "out"),
    "meshes": (*EXPORT, "ply", "--out", "out"),
    "summary": (*EXPORT, "yaml", "--out", "out.yaml"),
}
FAILURES = {
    "the disk is full": ("fsync", errno.ENOSPC, ("No space left on device", "Free some space")),
    "the quota is used up": ("replace", errno.EDQUOT, ("quota",)),
    "the place is forbidden": ("mkdir", errno.EACCES, ("Permission denied", "permissions")),
    "the disk is read-only": ("mkdir", errno.EROFS, ("Read-only file system", "written to")),
}


_MANY = {"fsync": (0, 3, 8), "replace": (0, 3, 8), "mkdir": (0, 3, 8)}
_ONE = {"fsync": (0,), "replace": (0,)}
GOOD: dict[str, dict[str, tuple[int, ...]]] = {
    "fit": _MANY,
    "simulation": _MANY,
    "import": {"fsync": (0, 3, 8), "replace": (0, 3), "mkdir": (0,)},
    "archive": _ONE,
    "table": _ONE,
    "tables": {"fsync": (0, 3), "replace": (0, 3), "mkdir": (0,)},
    "meshes": {"fsync": (0, 3, 8), "replace": (0, 3, 8), "mkdir": (0,)},
    "summary": _ONE,
}
"""After how many good calls one fails, as far as an order makes so many."""


@pytest.mark.parametrize(
    ("failure", "after", "order"),
    [
        (failure, after, order)
        for failure, (name, error, _) in FAILURES.items()
        for order in WRITES
        for after in GOOD[order].get(name, ())
        # Of the two errors of one call, the other is tried at each.
        if error != errno.EROFS or not after
    ],
)
def test_what_cannot_be_written_leaves_nothing(
    here: Terminal, failure: str, after: int, order: str
) -> None:
    name, error, words = FAILURES[failure]
    before = tree(here.folder)
    with failing(name, error, here.folder, after) as calls:
        code, _, told = here(*WRITES[order])
    assert len(calls) > after
    line = told.splitlines()[-1]
    assert code == 1
    assert line.startswith("physhandi: ")
    assert "Traceback" not in told
    assert all(word in line for word in words), line
    assert "out" in line, line
    assert ".tmp" not in line, line
    after_all = tree(here.folder)
    assert before.items() <= after_all.items()
    left = set(after_all) - set(before)
    assert not [rel for rel in left if rel.endswith(".tmp")]
    run = here.folder / "out"
    if (run / "run.yaml").is_file():
        assert Run.open(run).state in {"failed", "queued"}
        assert not Run.open(run).is_published
    else:
        assert left <= {"out"}, left
        assert not (here.folder / "out").is_file()


def test_a_taken_port_is_named(here: Terminal) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        words = (f"Port {port} of 127.0.0.1", "Address already in use", "--port")
        here.refused(1, words, "serve", "--port", port, "--device", "cpu", "--data-dir", "new")


def test_an_interrupted_fit_with_a_torn_list_of_stages_begins_anew(
    here: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "fit_steady_springs", interrupt)
        assert here(*RECONSTRUCT, "out")[0] == 130
    stages = here.folder / "out/attempts/1/stages.json"
    stages.write_text(stages.read_text()[:40])
    code, _, told = here(*RECONSTRUCT, "out")
    assert code == 0
    assert "zeroth_order" in told
    assert Run.open(here.folder / "out").state == "succeeded"


def in_a_process(folder: Path, *order: str, setup: str = "") -> tuple[int, str]:
    """Give an order as a shell does; returns exit code and standard error."""
    code = f"{setup}\nfrom app.cli import main; main()"
    # Counting lines would need a file, too, which some of these processes cannot write.
    inherited = {name: os.environ[name] for name in os.environ.keys() - {"COVERAGE_PROCESS_CONFIG"}}
    done = subprocess.run(
        [sys.executable, "-c", code, *order],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        env=inherited | {"PYTHONPATH": str(ROOT)},
    )
    return done.returncode, done.stderr


FULL = (
    "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)); "
    "sys.dont_write_bytecode = True"
)
"""No file of the process may grow beyond 4 kB: the kernel refuses the write itself.

Python does not notice when that cuts the bytecode of a module off, and nobody could import it.
"""


@table(
    {
        "recording that is not there": (("reconstruct", "nowhere", "--out", "out"), "", 2),
        "files that cannot grow": ((*EXPORT, "npz", "--out", "out.npz"), FULL, 1),
    }
)
def test_a_process_ends_as_it_should(here: Terminal, case: tuple[Any, str, int]) -> None:
    order, setup, code = case
    before = tree(here.folder)
    found, told = in_a_process(here.folder, *order, setup=setup)
    assert found == code, told
    assert "Traceback" not in told
    assert tree(here.folder) == before
