"""The cache of files: processes, cache, limits and errors."""

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from support.server.server_world import World
from support.viewer.viser_file import Recording
from support.waiting import LIMIT_S

from app.exports import cache as cache_module
from app.exports.cache import FileCache, FileJob, TooManyFilesError
from app.exports.files import request_of
from app.exports.request import FileRequest
from physhandi.errors import RunError, UsageError
from physhandi.run import Run


@pytest.fixture
def order(world: World) -> FileRequest:
    return request_of(world.catalog, world.catalog.run("fitted"), "png", {"f": "2"})


def pretend(
    monkeypatch: pytest.MonkeyPatch, work: Callable[[FileRequest, FileJob], None] | None = None
) -> list[FileRequest]:
    """Write 100 bytes instead of starting a process."""
    orders: list[FileRequest] = []

    def run(_: FileCache, order: FileRequest, made: FileJob) -> None:
        orders.append(order)
        if work is not None:
            work(order, made)
        made.path.write_bytes(b"x" * 100)

    monkeypatch.setattr(FileCache, "_run", run)
    return orders


def test_a_process_makes_the_file_and_tells_how_far_it_is(
    file_cache: FileCache, order: FileRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go, run = threading.Event(), FileCache._run

    def run_when_told(file_cache: FileCache, order: FileRequest, work: FileJob) -> None:
        assert go.wait(LIMIT_S)
        run(file_cache, order, work)

    monkeypatch.setattr(FileCache, "_run", run_when_told)
    recording = file_cache.begin(replace(order, format="viser"))
    hasty = FileCache(tmp_path / "hasty", seconds=60.0)
    wrong = hasty.begin(replace(order, format="mp4", width=4096, height=4096))
    assert recording.state == "making"
    go.set()
    shown = Recording.read(recording.future.result().read_bytes()).at(9)
    assert any(name.startswith("/object/") for name in shown)
    assert (recording.state, recording.done, recording.of) == ("ready", 10, 10)
    with pytest.raises(UsageError, match=r"10 frames of 'sheet' .* cannot be drawn in 60 s"):
        wrong.future.result()
    hasty.close()
    left = []
    for process in psutil.Process().children():
        with suppress(psutil.Error):  # Of other tests, and ending at this moment.
            left += [process] if "app.exports.making" in process.cmdline() else []
    assert left == []


def test_the_same_order_is_made_once_and_again_when_the_run_changed(
    file_cache: FileCache, order: FileRequest, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = pretend(monkeypatch)
    first = file_cache.make(order)
    assert file_cache.make(replace(order)) == first
    assert len(made) == 1
    other = file_cache.make(replace(order, query={"f": "3"}))
    assert other != first
    first.unlink()
    assert file_cache.make(order).is_file()
    assert len(made) == 3
    current = run.folder / "current"
    current.write_text(current.read_text() + "\n")
    assert file_cache.make(order) != first
    again = FileCache(first.parent)
    assert again.make(order) == file_cache.make(order)
    assert len(made) == 4
    again.close()


def test_the_cache_forgets_what_was_not_used_for_longest(
    tmp_path: Path, order: FileRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch)
    file_cache = FileCache(tmp_path / "cache", most_bytes=350)
    paths = [file_cache.make(replace(order, query={"f": str(frame)})) for frame in range(3)]
    for moment, path in enumerate(paths):
        os.utime(path, (moment, moment))
    FileCache(tmp_path / "cache").make(replace(order, query={"f": "0"}))  # Used again.
    paths.append(file_cache.make(replace(order, query={"f": "3"})))
    assert [path.exists() for path in paths] == [True, False, True, True]
    file_cache.close()


def test_there_is_an_end_to_files_that_wait(
    tmp_path: Path, order: FileRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    made = pretend(monkeypatch, lambda _order, _work: go.wait(LIMIT_S) and None)
    monkeypatch.setattr(cache_module, "MOST_WAITING", 3)
    file_cache = FileCache(tmp_path / "cache", at_once=1)
    works = [file_cache.begin(replace(order, query={"f": str(frame)})) for frame in range(3)]
    assert file_cache.begin(replace(order, query={"f": "0"})) is works[0]
    with pytest.raises(TooManyFilesError, match="3 files are being made already"):
        file_cache.begin(replace(order, query={"f": "9"}))
    assert len(made) <= 1
    go.set()
    assert [work.future.result(LIMIT_S).name for work in works] == [
        work.path.name for work in works
    ]
    file_cache.begin(replace(order, query={"f": "9"})).future.result(LIMIT_S)
    file_cache.close()


def test_a_process_that_takes_too_long_is_ended(tmp_path: Path, order: FileRequest) -> None:
    file_cache = FileCache(tmp_path / "cache", seconds=0.001)
    with pytest.raises(RunError, match=r"took longer than 0.001 s"):
        file_cache.make(order)
    assert list((tmp_path / "cache").iterdir()) == []
    file_cache.close()


def test_a_failure_is_told_and_the_next_order_tries_again(
    file_cache: FileCache, order: FileRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    troubles = [RunError("a file is damaged")]

    def fail(_order: FileRequest, _work: FileJob) -> None:
        if troubles:
            raise troubles.pop()

    pretend(monkeypatch, fail)
    work = file_cache.begin(order)
    with pytest.raises(RunError, match="a file is damaged"):
        work.future.result(LIMIT_S)
    assert work.state == "failed"
    assert file_cache.make(order).read_bytes() == b"x" * 100


def test_what_is_made_once_leaves_nothing_behind(
    file_cache: FileCache, order: FileRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = pretend(monkeypatch)
    with file_cache.once(order, lambda folder: (folder / "rollout.npz").touch()) as path:
        assert path.is_file()
        assert (Path(made[0].rollout) / "rollout.npz").is_file()
        folder = path.parent
    assert not folder.exists()
    with (
        pytest.raises(UsageError, match="width"),
        file_cache.once(replace(order, width=9_999), lambda _folder: None),
    ):
        pass
    assert list(folder.parent.iterdir()) == []
