"""Published runs in stores that fsspec reaches: whole or not seen at all, and checked when read."""

from collections.abc import Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest

from physhandi.data.attempt import Attempt
from physhandi.data.run import RunFolder
from physhandi.errors import PhysHandiError, RunError, UsageError
from physhandi.run_store import RunStore


@pytest.fixture(params=["memory", "file"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RunStore]:
    made = RunStore("memory://runs" if request.param == "memory" else f"file://{tmp_path}/store")
    yield made
    if request.param == "memory":
        fsspec.filesystem("memory").rm("/", recursive=True)


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(
        tmp_path / "mine", name="Mine", kind="reconstruction", sequences=["/data/sheet"], config={}
    )


def fill(attempt: Attempt) -> None:
    attempt.save_array("sequences/sheet/rollout.npy", np.arange(12.0).reshape(2, 2, 3))
    attempt.save_json("metrics.json", {"sheet": {"error": 3}})
    attempt.finish_stage("only", {"before": 2.0, "after": 1.0})


def place_of(store: RunStore, name: str) -> str:
    return f"{store._place('mine')}/attempts/1/{name}"


def test_what_is_published_comes_back_whole(
    store: RunStore, run: RunFolder, tmp_path: Path
) -> None:
    beats: list[int] = []
    assert store.runs() == []
    with run.begin_attempt() as attempt:
        fill(attempt)
        store.put_files(run.folder, 1, attempt._hash_outputs(), lambda: beats.append(1))
        assert store.runs() == []
        with pytest.raises(RunError, match=r"'mine' could not be read .*none that is published"):
            store.fetch("mine", tmp_path / "back")
        attempt.publish(store)
    run.verify()
    assert store.runs() == ["mine"]
    back = store.fetch("mine", tmp_path / "back" / "mine")
    back.verify()
    assert (back.state, back.attempt, back.name, back.stages()[0]["name"]) == (
        *("succeeded", 1),
        *("Mine", "only"),
    )
    assert back.array("sequences/sheet/rollout.npy")[1, 1, 2] == 11.0
    assert back.json("metrics.json") == {"sheet": {"error": 3}}
    with pytest.raises(RunError, match="exists already"):
        store.fetch("mine", back.folder)
    assert [path.name for path in back.folder.parent.iterdir()] == ["mine"]


@pytest.mark.parametrize("broken", ["put_file", "pipe_file"])
def test_a_store_that_fails_keeps_the_run_from_being_published_until_it_works(
    store: RunStore,
    run: RunFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    broken: str,
) -> None:
    def fail(*_: object) -> None:
        raise ConnectionError("the line is dead")

    with monkeypatch.context() as dead:
        dead.setattr(store._files, broken, fail)
        with run.begin_attempt() as attempt:
            fill(attempt)
            with pytest.raises(RunError, match="the line is dead") as error:
                attempt.publish(store)
            attempt.fail(error.value)
    assert (run.state, run.is_published, store.runs()) == ("failed", False, [])
    assert store.url in str(run.error)
    with run.begin_attempt() as attempt:
        assert attempt.stage_done("only")
        attempt.publish(store)
    assert store.fetch("mine", tmp_path / "back").attempt == run.attempt == 2


def test_who_was_replaced_publishes_nothing_in_a_store_either(
    store: RunStore, run: RunFolder, tmp_path: Path
) -> None:
    first = run.begin_attempt()
    fill(first)
    with run.begin_attempt(take_over=True) as second:
        with pytest.raises(RunError, match="taken over"):
            first.publish(store)
        assert store.runs() == []
        second.publish(store)
    assert store.fetch("mine", tmp_path / "back").attempt == 2


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("out/metrics.json", b'{"sheet": {"error": 4}}', "metrics.json"),
        ("out/metrics.json", None, "metrics.json"),
        ("MANIFEST.json", b"{", "could not be read"),
        ("MANIFEST.json", b'{"files": {"../../x": {"size": 1, "sha256": ""}}}', "not a file name"),
        ("MANIFEST.json", b'{"files": {"/etc/passwd": {"size": 1, "sha256": ""}}}', "not a file"),
        ("MANIFEST.json", b'{"files": []}', "'files' is wrong"),
        ("../../current", b"nine", "could not be read"),
    ],
)
def test_what_was_changed_in_the_store_is_not_taken(
    store: RunStore, run: RunFolder, tmp_path: Path, name: str, content: bytes | None, told: str
) -> None:
    with run.begin_attempt() as attempt:
        fill(attempt)
        attempt.publish(store)
    place = f"{store._place('mine')}/current" if "current" in name else place_of(store, name)
    if content is None:
        store._files.rm(place)
    else:
        store._files.pipe_file(place, content)
    with pytest.raises(RunError, match=told):
        store.fetch("mine", tmp_path / "back" / "mine")
    assert list((tmp_path / "back").iterdir()) == []


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("nonsense://x", "nonsense"),
        ("ftp://user:secret@host/x", "must hold no password"),
    ],
)
def test_an_address_that_cannot_be_used_is_refused(url: str, told: str) -> None:
    with pytest.raises(UsageError, match=told) as error:
        RunStore(url)
    assert "secret" not in str(error.value)


@pytest.mark.parametrize("run_id", ["", "..", "a/b"])
def test_only_ids_of_runs_are_asked_for(store: RunStore, tmp_path: Path, run_id: str) -> None:
    with pytest.raises(PhysHandiError, match="no id of a run"):
        store.fetch(run_id, tmp_path / "back")
