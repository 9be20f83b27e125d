"""States of unfinished stages: which one is gone on from, and which are refused and why."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from physhandi.data import checkpoint
from physhandi.data.checkpoint import FileCheckpointer

ORIGIN = {"settings": "a", "inputs": "b"}
LIKE = {"mean": np.zeros(4, np.float32), "curve": np.zeros((0, 2))}
NAME = "search.towel"


def state_of(number: int) -> dict[str, np.ndarray]:
    return {"mean": np.full(4, number, np.float32), "curve": np.zeros((number, 2))}


def keep(folder: Path, *numbers: int) -> None:
    checkpointer = FileCheckpointer(folder, ORIGIN)
    for number in numbers:
        checkpointer.write(NAME, number, state_of(number))


def found_in(folder: Path, origin: dict[str, str] = ORIGIN) -> int | None:
    """Iteration of the state that is found; its content must be that of this iteration."""
    state = FileCheckpointer(folder, origin).load(NAME, LIKE, growing=("curve",))
    if state is None:
        return None
    assert set(state.tensors["mean"].tolist()) == {state.iteration}
    assert len(state.tensors["curve"]) == state.iteration
    return state.iteration


def newest(folder: Path) -> Path:
    """By its size: files that are written in quick succession may have the same time."""
    return max(folder.iterdir(), key=lambda path: path.stat().st_size)


def test_of_two_files_the_newest_whole_one_is_read(tmp_path: Path) -> None:
    assert found_in(tmp_path / "none") is None
    keep(tmp_path, 1, 2, 3, 4)
    assert len(list(tmp_path.iterdir())) == 2
    assert found_in(tmp_path) == 4
    content = bytearray(newest(tmp_path).read_bytes())
    content[-1] ^= 1
    newest(tmp_path).write_bytes(content)
    assert found_in(tmp_path) == 3
    keep(tmp_path, 9)  # Replaces the older one, whatever the other one is.
    newest(tmp_path).write_bytes(b"torn")
    assert found_in(tmp_path) == 4 or found_in(tmp_path) is None
    keep(tmp_path, 10)
    assert found_in(tmp_path) == 10


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "damaged, or not in format"),
    "no header": (lambda path: path.write_bytes(b"\xff" * 200), "damaged, or not in format"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-3]), "damaged, or not in format"),
    "another format": (
        lambda path: save_file(state_of(3), path, metadata={"number": "7"}),
        "damaged, or not in format",
    ),
    "another iteration": (
        lambda path: path.write_bytes(
            path.read_bytes().replace(b'"iteration":"3"', b'"iteration":"8"')
        ),
        "checksum",
    ),
    "no iteration": (
        lambda path: path.write_bytes(
            path.read_bytes().replace(b'"iteration":"3"', b'"iteration":"x"')
        ),
        "invalid literal",
    ),
    "another name": (
        lambda path: path.write_bytes(path.read_bytes().replace(b"towel", b"other")),
        "belongs to search.other",
    ),
    "origin of nothing": (
        lambda path: path.write_bytes(path.read_bytes().replace(b'\\"inputs\\"', b"[[[[[[[[[[")),
        "Expecting",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_state_is_not_used_and_the_log_says_why(
    damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keep(tmp_path, 3)
    make, reason = DAMAGES[damage]
    make(newest(tmp_path))
    assert found_in(tmp_path) is None
    assert reason in caplog.text
    assert str(tmp_path) in caplog.text


@pytest.mark.parametrize("part", ORIGIN)
def test_a_state_of_other_settings_or_inputs_is_not_used(
    part: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keep(tmp_path, 3)
    assert found_in(tmp_path, ORIGIN | {part: "other"}) is None
    assert f"it was made with other {part}." in caplog.text
    assert found_in(tmp_path) == 3


OTHERS = {
    "kind": (LIKE | {"mean": np.zeros(4)}, "array 'mean' is float32"),
    "shape": (LIKE | {"mean": np.zeros(5, np.float32)}, "expected float32 (5,)"),
    "columns": (LIKE | {"curve": np.zeros((0, 3))}, "array 'curve' is float64 (3, 2)"),
    "one more": (LIKE | {"rate": np.zeros(1)}, "array 'rate' is missing"),
    "one less": ({"curve": LIKE["curve"]}, "array 'mean' is unknown"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_state_of_other_arrays_is_not_used(
    other: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keep(tmp_path, 3)
    like, reason = OTHERS[other]
    assert FileCheckpointer(tmp_path, ORIGIN).load(NAME, like, growing=("curve",)) is None
    assert reason in caplog.text


def test_growing_arrays_are_of_one_length(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    FileCheckpointer(tmp_path, ORIGIN).write(NAME, 1, {"a": np.zeros(3), "b": np.zeros(2)})
    like = {"a": np.zeros(0), "b": np.zeros(0)}
    assert FileCheckpointer(tmp_path, ORIGIN).load(NAME, like, growing=("a", "b")) is None
    assert "a, b are not of one length" in caplog.text


def test_writing_waits_and_takes_a_small_share_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    checkpointer = FileCheckpointer(tmp_path, ORIGIN)

    def write_slowly() -> dict[str, np.ndarray]:
        now[0] += 0.5
        return state_of(1)

    written: list[float] = []
    for _ in range(4000):
        now[0] += 0.1
        before, begin = checkpointer.spent_s, now[0]
        checkpointer.offer(NAME, 1, write_slowly)
        if checkpointer.spent_s > before:
            written.append(begin - 100.0)
    assert written[0] == pytest.approx(checkpoint.CHECKPOINT_INTERVAL_S, abs=0.11)
    assert 3 <= len(written) <= 5
    spent = np.arange(1, len(written)) * 0.5
    assert (np.array(written[1:]) >= spent / checkpoint.CHECKPOINT_SHARE).all()


def test_a_full_disk_costs_the_checkpoint_and_not_the_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "x"))

    monkeypatch.setattr(checkpoint, "write_bytes", refuse)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_INTERVAL_S", 0.0)
    checkpointer = FileCheckpointer(tmp_path, ORIGIN)
    checkpointer.offer(NAME, 1, lambda: state_of(1))
    assert "was not written" in caplog.text
    assert "No space left" in caplog.text
    with caplog.at_level(logging.INFO):
        assert checkpointer.load(NAME, LIKE, growing=("curve",)) is None
