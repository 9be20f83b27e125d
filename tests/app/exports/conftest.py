"""A finished run to export, and a cache of files."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.server.server_world import World

from app.exports.cache import FileCache
from physhandi.run import Run


@pytest.fixture
def run(world: World) -> Run:
    return world.catalog.run("fitted")


@pytest.fixture
def file_cache(tmp_path: Path) -> Iterator[FileCache]:
    file_cache = FileCache(tmp_path / "cache")
    yield file_cache
    file_cache.close()
