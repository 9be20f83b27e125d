"""Writes into a data folder, says so in the middle of it, and waits to be killed or told to go on.

``python half_done.py DEED FOLDER``; the folder is a run's, or a sequence's.
"""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO
from unittest.mock import patch

import numpy as np

from physhandi.data.files import write_atomically
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_writer import write_sequence


def pause(*_: Any, **__: Any) -> None:
    """Tell that it is in the middle, and wait for a line."""
    sys.stdout.write("half\n")
    sys.stdout.flush()
    sys.stdin.readline()


def write_result(folder: Path) -> None:
    def write(stream: BinaryIO) -> None:
        stream.write(b"\x93NUMPY")
        stream.flush()
        pause()
        np.save(stream, np.arange(3.0))

    with RunFolder.open(folder).begin_attempt() as attempt:
        attempt.save_json("first.json", {"attempt": attempt.number})
        write_atomically(attempt.out / "rollout.npy", write)
        attempt.publish()


def begin(folder: Path) -> None:
    with RunFolder.open(folder).begin_attempt() as first:
        first.fail("It was stopped.")
    with patch("physhandi.data.attempt.take_over", pause):
        RunFolder.open(folder).begin_attempt()


def create(folder: Path) -> None:
    with patch("physhandi.data.run.write_yaml", pause):
        RunFolder.create(
            folder.with_name("new"), name="new", kind="simulation", sequences=["/a"], config={}
        )


def delete(folder: Path) -> None:
    with patch.object(shutil, "rmtree", pause):
        RunFolder.open(folder).delete()


def replace(folder: Path) -> None:
    move = Path.replace

    def stop_before_the_new_one(self: Path, target: Path) -> Path:
        if target == folder:
            pause()
        return move(self, target)

    meta = Sequence.load(folder).meta
    arrays = {path.name: np.load(path) for path in folder.glob("*.npy")}
    with patch.object(Path, "replace", stop_before_the_new_one):
        write_sequence(folder, meta, arrays, overwrite=True)


DEEDS: dict[str, Callable[[Path], None]] = {
    "write": write_result,
    "begin": begin,
    "create": create,
    "delete": delete,
    "replace": replace,
}

if __name__ == "__main__":
    DEEDS[sys.argv[1]](Path(sys.argv[2]))
