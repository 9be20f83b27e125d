"""Ways to damage a PhysTwin case, for tests of its importer."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from physhandi.data.importers import phystwin_files
from physhandi.data.importers.phystwin import import_phystwin
from physhandi.errors import ImportFailedError
from support.inputs.phystwin_case import edit_json, edit_pickle, save_pickle

Damage = Callable[[Path], Any]
"""Changes the folder of a case."""


def final(field: str, change: Callable[[Any], Any]) -> Damage:
    def corrupt(folder: Path) -> None:
        path = folder / "final_data.pkl"
        edit_pickle(path, **{field: change(load(path)[field])})

    return corrupt


def put(*index: int, value: Any) -> Callable[[Any], Any]:
    def change(array: Any) -> Any:
        array[index] = value
        return array

    return change


def array_file(rel: str, value: Any) -> Damage:
    return lambda folder: np.save(folder / rel, value)


def image_file(rel: str, value: Any) -> Damage:
    return lambda folder: cv2.imwrite(str(folder / rel), value)


def metadata(**fields: Any) -> Damage:
    return lambda folder: edit_json(folder / "metadata.json", **fields)


def split(**fields: Any) -> Damage:
    return lambda folder: edit_json(folder / "split.json", **fields)


def pickle_file(rel: str, value: Any) -> Damage:
    return lambda folder: save_pickle(folder / rel, value)


def tracks(**fields: Any) -> Damage:
    def corrupt(folder: Path) -> None:
        path = folder / "cotracker/1.npz"
        with np.load(path) as stored:
            table = dict(stored) | fields
        np.savez(path, **table)

    return corrupt


def moved(source: str, target: str) -> Damage:
    return lambda folder: (folder / source).rename(folder / target) and None


def load(path: Path) -> Any:
    return pickle.loads(path.read_bytes())  # noqa: S301 - the test wrote it


def refuse(folder: Path, damage: Damage, message: str, patch: pytest.MonkeyPatch | None) -> None:
    """Damage a case and expect its refusal, with nothing left behind.

    Reading its good pickles in this process (`patch`) saves a child process for each.
    """
    if patch is not None:
        patch.setattr(phystwin_files, "read_untrusted", load)
    damage(folder)
    with pytest.raises(ImportFailedError, match=message):
        import_phystwin(folder, folder.parent / "out")
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
