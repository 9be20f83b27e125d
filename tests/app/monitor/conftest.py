"""A server whose queue works, with one sequence and a finished fit beside it."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.server.queue_world import QueueWorld, queue_world


@pytest.fixture
def world(
    data_dir: Path, fitted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[QueueWorld]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "bundled").mkdir()
    shutil.copytree(fitted_folder, data_dir / "runs" / "fitted")
    with queue_world(data_dir, tmp_path / "bundled") as world:
        yield world
