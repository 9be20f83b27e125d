"""A finished run to export, and a cache of files that works in this process."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.server.server_world import World

from app.exports.cache import FileCache, FileJob
from app.exports.making import make
from app.exports.request import FileRequest
from physhandi.run import Run


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[FileRequest]:
    """Has files made in this process; the orders that were carried out."""
    orders: list[FileRequest] = []

    def run(_: FileCache, order: FileRequest, work: FileJob) -> None:
        again = FileRequest(**json.loads(order.to_text()))
        orders.append(again)
        make(again, work.path)

    monkeypatch.setattr(FileCache, "_run", run)
    return orders


@pytest.fixture
def run(world: World) -> Run:
    return world.catalog.run("fitted")


@pytest.fixture
def file_cache(tmp_path: Path) -> Iterator[FileCache]:
    file_cache = FileCache(tmp_path / "cache")
    yield file_cache
    file_cache.close()
