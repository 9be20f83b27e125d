"""Foreign pickles: what they hold is read, what they ask for never happens."""

import collections
import os
import pickle
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
import scipy.sparse
import torch
from support.hostile.foreign_pickle import chumpy_array, chumpy_select, python2_pickle
from support.hostile.hostile_pickles import BROKEN, EXPLODING, Hostile, canaries

from physhandi.data.untrusted.pickles import read_untrusted
from physhandi.errors import ImportFailedError

ARRAYS = {
    "double": np.random.default_rng(0).normal(size=(4, 3, 2)),
    "fortran": np.asfortranarray(np.arange(12.0, dtype=np.float32).reshape(3, 4)),
    "flags": np.array([[True, False], [False, False]]),
    "index": np.arange(6, dtype=np.int64)[::2],
    "empty": np.zeros((0, 3)),
    "text": np.array(["hand", "b"]),
    "big_endian": np.arange(5, dtype=">f8"),
    "zero_dim": np.array(2.5),
}


def _store(folder: Path, content: bytes, name: str = "foreign.pkl") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_trees_and_arrays_come_back(tmp_path: Path, protocol: int) -> None:
    tree = {
        **ARRAYS,
        "numbers": [1, -2.5, True, None, 10**40, float("inf")],
        "nested": ({0: {1: {"object": ARRAYS["flags"]}}}, ["ä", "日本"]),
        "ordered": collections.OrderedDict([("a", 1), ("b", [])]),
        "set": {3},
        "numpy": [np.float32(0.25), np.int64(7), np.bool_(True)],
        "shared": [ARRAYS["double"]] * 3,
    }
    read = read_untrusted(_store(tmp_path, pickle.dumps(tree, protocol)))
    assert list(read) == list(tree)
    for name, array in ARRAYS.items():
        assert read[name].dtype == array.dtype.newbyteorder("="), name
        np.testing.assert_array_equal(read[name], array, strict=name != "big_endian")
    assert read["numbers"] == tree["numbers"]
    assert read["nested"][1] == ["ä", "日本"]
    np.testing.assert_array_equal(read["nested"][0][0][1]["object"], ARRAYS["flags"])
    assert (read["ordered"], read["set"]) == ({"a": 1, "b": []}, [3])
    assert read["numpy"] == [0.25, 7, True]
    assert [type(number) for number in read["numpy"]] == [float, int, bool]
    np.testing.assert_array_equal(read["shared"][2], ARRAYS["double"])


def test_python_2_files_with_chumpy_and_sparse_matrices_are_read(tmp_path: Path) -> None:
    array = np.random.default_rng(1).normal(size=(5, 3, 4))
    dense = np.where(np.random.default_rng(2).random((4, 6)) < 0.4, 2.5, 0.0)
    assert dense.any()
    tree = {
        "array": array,
        "fortran": np.asfortranarray(array[0]),
        "ch": chumpy_array(array),
        "select": chumpy_select(array),
        "columns": scipy.sparse.csc_matrix(dense),
        "rows": scipy.sparse.csr_matrix(dense),
        "text": "caf\xe9",
    }
    content = python2_pickle(tree)
    assert b"chumpy.reordering\nSelect" in content
    read = read_untrusted(_store(tmp_path, content))
    for name in ("array", "ch", "select"):
        np.testing.assert_array_equal(read[name], array, strict=True)
    np.testing.assert_array_equal(read["fortran"], array[0], strict=True)
    for name in ("columns", "rows"):
        np.testing.assert_array_equal(read[name], dense, strict=True)
    assert read["text"] == "caf\xe9"


@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix", "csc_array", "csr_array"])
def test_sparse_matrices_of_today_become_dense(tmp_path: Path, kind: str) -> None:
    dense = np.arange(12.0).reshape(3, 4) * (np.arange(12).reshape(3, 4) % 2)
    content = pickle.dumps(getattr(scipy.sparse, kind)(dense))
    np.testing.assert_array_equal(read_untrusted(_store(tmp_path, content)), dense, strict=True)


def test_torch_checkpoints_become_arrays(tmp_path: Path) -> None:
    stiffness = torch.nn.Parameter(torch.linspace(1, 9, 12))
    # As `torch.optim.Adam` tells it, which imports PyTorch's compiler for seconds.
    moments = {"exp_avg": torch.linspace(0.2, 1.8, 12), "exp_avg_sq": torch.linspace(0.04, 3.2, 12)}
    group = {"lr": 1e-3, "betas": (0.9, 0.99), "eps": 1e-8, "amsgrad": False, "foreach": None}
    optimizer = {
        "state": {0: {"step": torch.tensor(1.0), **moments}},
        "param_groups": [{**group, "params": [0]}],
    }
    base = torch.arange(24, dtype=torch.float64).reshape(2, 3, 4)
    kinds = (torch.float16, torch.bfloat16, torch.int64, torch.int16, torch.uint8, torch.bool)
    saved = {
        "epoch": 7,
        "spring_Y": stiffness,
        "slice": base[1, 1:, ::2],
        "transposed": base.permute(2, 0, 1),
        "expanded": torch.ones(1).expand(5),
        "scalar": torch.tensor(3.5),
        "empty": torch.zeros(0, 3),
        "kinds": [torch.tensor([0, 1, 3]).to(kind) for kind in kinds],
        "module": torch.nn.Linear(3, 2).state_dict(),
        "size": base.size(),
        "optimizer_state_dict": optimizer,
    }
    path = tmp_path / "best_7.pth"
    torch.save(saved, path)
    read = read_untrusted(path)
    assert read["epoch"] == 7
    for name in ("spring_Y", "slice", "transposed", "expanded", "scalar", "empty"):
        expected = saved[name].detach().numpy()
        np.testing.assert_array_equal(read[name], expected, strict=True)
    for array, kind in zip(read["kinds"], kinds, strict=True):
        np.testing.assert_array_equal(array, torch.tensor([0, 1, 3]).to(kind).float().numpy())
    np.testing.assert_array_equal(read["module"]["weight"], saved["module"]["weight"].numpy())
    assert list(read["size"]) == [2, 3, 4]
    state = read["optimizer_state_dict"]
    assert state["param_groups"] == optimizer["param_groups"]
    for name, value in optimizer["state"][0].items():
        np.testing.assert_array_equal(state["state"][0][name], value.numpy(), strict=True)
        assert np.any(state["state"][0][name]), name


IN_A_CHILD = ("os.system", "protocol 0", "inst", "eval", "inside an array", "in chumpy", "memo")
"""Enough to prove the way through a child; the reader itself is tested with all of them."""


@pytest.mark.parametrize("case", IN_A_CHILD)
def test_what_a_hostile_pickle_asks_for_never_happens(tmp_path: Path, case: str) -> None:
    canary = tmp_path / "canary"
    content, named = canaries(canary)[case]
    path = _store(tmp_path, content)
    with pytest.raises(ImportFailedError, match=named) as caught:
        read_untrusted(path)
    assert str(caught.value).startswith(f"{path}: refused, because ")
    assert "Nothing of the file was executed" in str(caught.value)
    assert not canary.exists()


def test_the_canaries_would_sing(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    for case in ("os.system", "protocol 0", "inst", "eval", "open", "inside an array"):
        canary.unlink(missing_ok=True)
        result = pickle.loads(canaries(canary)[case][0])  # noqa: S301 - what the reader must not do
        if case == "open":
            result.close()
        assert canary.exists(), case


@pytest.mark.parametrize("case", sorted(EXPLODING | {"empty", "truncated"}))
def test_broken_and_exploding_files_are_refused_in_a_copy_that_ends_with_them(
    tmp_path: Path, case: str
) -> None:
    good = _store(tmp_path, pickle.dumps([1, 2]), "good.pkl")
    assert read_untrusted(good) == [1, 2]
    (reader,) = readers()
    path = _store(tmp_path, BROKEN[case]())  # Some end the copy without a word.
    with pytest.raises(ImportFailedError, match=r"foreign\.pkl: refused, because"):
        read_untrusted(path, time_limit_s=600.0, memory_limit=3 << 30)
    assert read_untrusted(good) == [1, 2]
    assert readers() == [reader]
    assert reader.children() == []


def test_memory_and_time_are_limited(tmp_path: Path) -> None:
    path = _store(tmp_path, pickle.dumps(np.zeros(4_300_000)))
    with pytest.raises(ImportFailedError, match="more memory than is allowed"):
        read_untrusted(path, memory_limit=1 << 27)
    assert read_untrusted(path, memory_limit=1 << 28).shape == (4_300_000,)
    with pytest.raises(ImportFailedError, match=r"took more than 0\.001 s"):
        read_untrusted(path, time_limit_s=0.001)


def test_a_reader_that_was_killed_is_replaced(
    tmp_path: Path,
) -> None:
    path = _store(tmp_path, pickle.dumps(np.arange(3)))
    assert list(read_untrusted(path)) == [0, 1, 2]
    (reader,) = readers()
    reader.kill()
    assert list(read_untrusted(path)) == [0, 1, 2]
    assert readers() != [reader]


def readers() -> list[psutil.Process]:
    """The processes of this one that read pickles."""
    module = "physhandi.data.untrusted.pickles"
    found = []
    for process in psutil.Process().children():
        with suppress(psutil.Error):  # Of other tests, and ending at this moment.
            found += [process] if module in process.cmdline() else []
    return found


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ImportFailedError, match=r"nowhere\.pkl is not a file"):
        read_untrusted(tmp_path / "nowhere.pkl")
    with pytest.raises(ImportFailedError, match="is not a file"):
        read_untrusted(tmp_path)


def _rewritten(path: Path, change: dict[str, bytes], *, compress: bool = False) -> Path:
    """Copy a checkpoint with some members replaced."""
    changed = path.with_name("changed.pth")
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w", method) as new:
        for name in old.namelist():
            inner = name.partition("/")[2]
            new.writestr(name, change.get(inner, old.read(name)))
    return changed


def test_hostile_checkpoints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pth"
    torch.save({"spring_Y": torch.arange(5.0)}, path)
    np.testing.assert_array_equal(read_untrusted(path)["spring_Y"], np.arange(5.0))
    canary = tmp_path / "canary"
    hostile = pickle.dumps(Hostile(os.system, f"touch {canary}"))
    with zipfile.ZipFile(path) as archive:
        content = archive.read("model/data.pkl")
    with pytest.raises(ImportFailedError, match=r"posix\.system"):
        read_untrusted(_rewritten(path, {"data.pkl": hostile}))
    assert not canary.exists()
    assert content.count(b"K\x05") >= 1
    beyond = content.replace(b"K\x05\x85", b"K\x63\x85")
    for change, named in (
        ({"data.pkl": beyond}, "beyond its storage"),
        ({"data/0": b"\0" * 19}, "cut off"),
        ({"data/0": b"\0" * 400}, "another size"),
        ({"data.pkl": b""}, "no whole pickle"),
    ):
        with pytest.raises(ImportFailedError, match=named):
            read_untrusted(_rewritten(path, change))
    bomb = _rewritten(path, {"data/0": b"\0" * 5_000_000}, compress=True)
    assert bomb.stat().st_size < 100_000
    with pytest.raises(ImportFailedError, match="is compressed"):
        read_untrusted(bomb)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a/readme.txt", "no checkpoint")
    with pytest.raises(ImportFailedError, match=r"without a/data\.pkl"):
        read_untrusted(tmp_path / "other.zip")


def test_old_torch_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.pth"
    torch.save({"a": torch.ones(2)}, path, _use_new_zipfile_serialization=False)
    with pytest.raises(ImportFailedError, match=r"before 1\.6"):
        read_untrusted(path)
