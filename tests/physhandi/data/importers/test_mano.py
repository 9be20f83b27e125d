"""The import of MANO files: arrays are kept to the bit, anything else is said by its field."""

import hashlib
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile.foreign_pickle import Call, Global
from support.inputs.mano_file import mano_arrays, write_mano

from physhandi.data.importers.mano import import_mano
from physhandi.errors import ImportFailedError


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_array_is_kept(tmp_path: Path, side: str) -> None:
    source = write_mano(tmp_path, side)
    path = import_mano(source, tmp_path / "hands")
    assert path == tmp_path / "hands" / f"mano_{side}.npz"
    arrays = mano_arrays(side)
    with np.load(path, allow_pickle=False) as stored:
        for name, array in arrays.items():
            dense = array.toarray() if name == "J_regressor" else array
            np.testing.assert_array_equal(stored[name], dense, err_msg=name)
        assert {stored[name].dtype for name in ("v_template", "shapedirs")} == {np.dtype("f8")}
        assert stored["f"].dtype == np.int64
        assert stored["source_sha256"] == hashlib.sha256(source.read_bytes()).hexdigest()
        assert (stored["side"], stored["format"]) == (side, "physhandi-mano-1")
        assert not stored["is_shape_mirrored"]
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_plain_arrays_of_today_are_read_too(tmp_path: Path) -> None:
    arrays = {**mano_arrays("right")}
    arrays["J_regressor"] = arrays["J_regressor"].toarray().astype(np.float32)
    source = tmp_path / "MANO_RIGHT.pkl"
    source.write_bytes(pickle.dumps(arrays))
    with np.load(import_mano(source, tmp_path)) as stored:
        np.testing.assert_array_equal(stored["posedirs"], arrays["posedirs"])
        np.testing.assert_array_equal(stored["J_regressor"], arrays["J_regressor"])


def test_the_left_hands_known_fault_is_mended(tmp_path: Path) -> None:
    right, left = (mano_arrays(side)["shapedirs"] for side in ("right", "left"))
    faulty = left * np.array([-1.0, 1, 1])[:, None]
    np.testing.assert_array_equal(faulty, right)
    with np.load(import_mano(write_mano(tmp_path, "left", shapedirs=faulty), tmp_path)) as stored:
        np.testing.assert_array_equal(stored["shapedirs"], left)
        assert stored["is_shape_mirrored"]
    assert np.abs(left[:, 0]).max() > 0.005


def _with(name: str, index: Any, value: float) -> np.ndarray:
    array = mano_arrays("right")[name]
    array = np.array(array.toarray() if name == "J_regressor" else array)
    array[index] = value
    return array


def _scaled(name: str, factor: float) -> np.ndarray:
    return mano_arrays("right")[name] * factor


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "shapedirs missing": ({"shapedirs": None}, r"the field 'shapedirs' is missing"),
    "too few shapes": (
        {"shapedirs": np.zeros((778, 3, 9))},
        r"'shapedirs' is float64 of shape \(778, 3, 9\); MANO has numbers of shape \(778, 3, 10\)",
    ),
    "SMPL": ({"v_template": np.zeros((6890, 3))}, r"'v_template' is float64 of shape \(6890, 3\)"),
    "list": ({"weights": [[1.0] * 16] * 778}, "'weights' is no array"),
    "text": ({"hands_mean": np.array(["a"] * 45)}, "'hands_mean' is <U1"),
    "NaN": (
        {"posedirs": lambda: _with("posedirs", (5, 2, 7), np.nan)},
        r"'posedirs' .* at \[5, 2, 7\]",
    ),
    "infinite": (
        {"weights": lambda: _with("weights", (0, 3), np.inf)},
        r"'weights' .* at \[0, 3\]",
    ),
    "millimetres": (
        {"v_template": lambda: _scaled("v_template", 1000.0)},
        "m long; MANO is in metres",
    ),
    "weights": ({"weights": lambda: _scaled("weights", 0.5)}, "'weights' sums to"),
    "regressor": ({"J_regressor": lambda: _scaled("J_regressor", 2.0)}, "'J_regressor' sums to"),
    "faces": (
        {"f": lambda: _with("f", (3, 1), 778)},
        "'f' has vertices from 0 to 778; there are 778",
    ),
    "tree": (
        {"kintree_table": lambda: _with("kintree_table", (0, 5), 9)},
        "'kintree_table' joins .* MANO joins",
    ),
    "style": ({"bs_type": "other"}, "'bs_type' is 'other'"),
    "class": (
        {"hands_mean": Call(Global("os", "system"), ("true",))},
        r"refused, because it asks for os\.system",
    ),
}


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_faults_are_named_and_nothing_is_written(tmp_path: Path, fault: str) -> None:
    changes, named = FAULTS[fault]
    made = {name: value() if callable(value) else value for name, value in changes.items()}
    source = write_mano(tmp_path, **made)
    with pytest.raises(ImportFailedError, match=named) as caught:
        import_mano(source, tmp_path / "hands")
    assert str(source) in str(caught.value)
    assert not (tmp_path / "hands").exists()


def test_an_older_import_survives_a_faulty_one(tmp_path: Path) -> None:
    path = import_mano(write_mano(tmp_path), tmp_path)
    before = path.read_bytes()
    with pytest.raises(ImportFailedError):
        import_mano(write_mano(tmp_path, f=None), tmp_path)
    assert path.read_bytes() == before


def test_the_name_tells_the_side(tmp_path: Path) -> None:
    source = write_mano(tmp_path)
    for name in ("hand.pkl", "right_and_left.pkl"):
        with pytest.raises(ImportFailedError, match="does not tell the side"):
            import_mano(source.rename(tmp_path / name), tmp_path)
        source = tmp_path / name
    (tmp_path / "mano_right.pkl").write_bytes(pickle.dumps([1]))
    with pytest.raises(ImportFailedError, match="no dictionary"):
        import_mano(tmp_path / "mano_right.pkl", tmp_path)
    with pytest.raises(ImportFailedError, match="is not a file"):
        import_mano(tmp_path / "MANO_LEFT.pkl", tmp_path)


class _Touch:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


def test_a_hostile_file_touches_nothing(tmp_path: Path) -> None:
    source, canary = tmp_path / "MANO_RIGHT.pkl", tmp_path / "canary"
    arrays = {**mano_arrays("right"), "extra": _Touch(canary)}
    source.write_bytes(pickle.dumps(arrays))
    with pytest.raises(ImportFailedError, match=r"asks for posix\.system"):
        import_mano(source, tmp_path / "hands")
    assert not canary.exists()
    pickle.loads(source.read_bytes())  # noqa: S301 - what the importer must not do
    assert canary.exists()
