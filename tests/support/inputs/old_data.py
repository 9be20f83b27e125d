"""The data folder that the program of commit 57a38d7 left; tests/compatibility/README.md."""

import json
import os
import tarfile
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from app import cli
from support.server.server_world import World, make_world

FIXTURE = Path(__file__).parents[2] / "compatibility"
MADE_AT = "/srv/physhandi/data"
"""Where the folder was when it was made; files of a run name recordings by this path."""
SAME_MOTION_M = 1e-5
"""Another processor may round otherwise; over these few frames that stays far below 10 µm."""
PROSE = frozenset({"reason", "error", "advice", "message", "about", "title", "group"})
"""Fields whose text may be worded anew."""


@dataclass(frozen=True)
class OldFolder:
    """The data folder, and what the old program said of it."""

    path: Path
    expected: Mapping[str, Any]
    links: Mapping[str, Any]

    @property
    def exports(self) -> Path:
        """Files that the old program exported of the run `quick`."""
        return self.path.parent / "exports"

    @property
    def ids(self) -> Mapping[str, str]:
        """Ids of runs by what they are."""
        return self.expected["ids"]

    def run(self, name: str) -> Path:
        """Folder of a run."""
        return self.path / "runs" / self.ids.get(name, name)

    def results(self, name: str) -> Path:
        """Folder of a run's published results."""
        return self.run(name) / "attempts" / "1" / "out"


def unpack(target: Path) -> Path:
    """Unpack the folder; it looks as if it had been copied from another machine."""
    with tarfile.open(FIXTURE / "data.tar.xz") as archive:
        archive.extractall(target, filter="data")
    return target / "data"


def settle(data: Path) -> Path:
    """Make the folder what it would be if it had been made where it is."""
    named = [*data.rglob("job.yaml"), data / "cache" / "runs.json"]
    for path in named:
        times = path.stat()
        path.write_text(path.read_text().replace(MADE_AT, str(data)))
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return data


def read_record(name: str) -> Any:
    """Read what was recorded beside the folder."""
    return json.loads((FIXTURE / f"{name}.json").read_text())


def serve(data: Path) -> World:
    """Build the application over a folder, without what came with the program."""
    return make_world(data, bundled=data / "nothing-bundled")


def command(*arguments: str | Path) -> str:
    """Give a command line to the program; it must succeed, and what it prints is returned."""
    printed, told = StringIO(), StringIO()
    with redirect_stdout(printed), redirect_stderr(told), pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    assert not end.value.code, told.getvalue()
    return printed.getvalue()


def differences(was: Any, now: Any, path: str = "") -> list[str]:
    """Name what a record has lost or changed; new fields are no loss.

    Prose may be worded anew, but must be there. Figures may differ in their last digits.
    """
    here = path.rpartition(".")[2]
    if isinstance(was, dict) and isinstance(now, dict):
        lost = [f"{path}.{key} is gone" for key in was if key not in now]
        both = [key for key in was if key in now]
        return lost + [d for key in both for d in differences(was[key], now[key], f"{path}.{key}")]
    if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        pairs = enumerate(zip(was, now, strict=True))
        return [d for i, (a, b) in pairs for d in differences(a, b, f"{path}[{i}]")]
    if here in PROSE and isinstance(was, str):
        return [] if isinstance(now, str) and bool(now) == bool(was) else [f"{path} says nothing"]
    if isinstance(was, float) and isinstance(now, int | float):
        return [] if now == pytest.approx(was, rel=1e-6, abs=1e-9) else [f"{path}: {was} → {now}"]
    return [] if was == now else [f"{path}: {was!r} → {now!r}"]
