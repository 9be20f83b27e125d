"""Pickles that want to do harm, and pickles that are broken or explode."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile.foreign_pickle import Call, Global, New, python2_pickle


class Hostile:
    """Calls a function when it is unpickled."""

    def __init__(self, *call: Any) -> None:
        self._call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call[0], self._call[1:]


def canaries(canary: Path) -> dict[str, tuple[bytes, str]]:
    """Pickles that would leave a file behind, and what their refusal names."""
    touch = f"touch {canary}"
    code = f"__import__('pathlib').Path({str(canary)!r}).touch()"
    system = Call(Global("os", "system"), (touch,))
    return {
        "os.system": (pickle.dumps(Hostile(os.system, touch)), r"posix\.system"),
        "protocol 0": (f"cos\nsystem\n(S'{touch}'\ntR.".encode(), r"os\.system"),
        "inst": (f"(S'{touch}'\nios\nsystem\n.".encode(), r"os\.system"),
        "eval": (pickle.dumps(Hostile(eval, code)), r"builtins\.eval"),
        "exec": (
            python2_pickle(Call(Global("__builtin__", "exec"), (code,))),
            r"__builtin__\.exec",
        ),
        "getattr": (python2_pickle(Call(Global("builtins", "getattr"), ("a", "b"))), "getattr"),
        "import": (python2_pickle(Call(Global("builtins", "__import__"), ("os",))), "__import__"),
        "open": (pickle.dumps(Hostile(open, str(canary), "w")), r"_?io\.open"),
        "dotted": (b"\x80\x04\x8c\x05numpy\x8c\x08__init__\x93.", r"numpy\.__init__"),
        "dotted path": (
            b"\x80\x04\x8c\x08builtins\x8c\x0edict.__class__\x93.",
            r"dict\.__class__",
        ),
        "numpy loader": (
            python2_pickle(Call(Global("numpy", "load"), (str(canary),))),
            r"numpy\.load",
        ),
        "inside an array": (pickle.dumps(np.array([Hostile(os.system, touch)])), "system"),
        "inside a list": (pickle.dumps([1, {"a": (Hostile(os.system, touch),)}]), "system"),
        "as a dtype": (python2_pickle(Call(Global("numpy", "dtype"), (system,))), "system"),
        "in chumpy": (
            python2_pickle(New(Global("chumpy.ch", "Ch"), {"x": system})),
            r"os\.system",
        ),
        "chumpy lambda": (python2_pickle(New(Global("chumpy.ch", "ChLambda"), {})), "ChLambda"),
        "memo": (b"\x80\x02cos\nsystem\nq\x00X" + _text(touch) + b"\x85h\x00\x8cR.", "system"),
        "extension": (b"\x80\x02\x82\x01.", "extension"),
        "persistent": (b"\x80\x02X" + _text("storage") + b"Q.", "outside of the file"),
        "torch without archive": (
            python2_pickle(Call(Global("torch._utils", "_rebuild_tensor_v2"), ())),
            "_rebuild_tensor_v2",
        ),
        "set on a function": (
            python2_pickle(Call(Global("_codecs", "encode"), ("a",), {"_function": 1})),
            "no attribute",
        ),
        "build on a function": (
            b"\x80\x02c_codecs\nencode\n}X" + _text("_function") + b"Nsb.",
            "attributes of a function",
        ),
        "build on a class": (
            b"\x80\x02cnumpy\ndtype\nN}X" + _text("_build") + b"Ns\x86b.",
            "state",
        ),
    }


def _text(text: str) -> bytes:
    return len(text).to_bytes(4, "little") + text.encode()


def _tuples(depth: int) -> bytes:
    return b"\x80\x02)" + b"\x85" * depth + b"."


def _doubling(depth: int) -> bytes:
    """A list of two references to a list of two references to ..., ``2**depth`` in all."""
    rows = b"".join(
        b"]q" + bytes([i]) + (b"h" + bytes([i - 1])) * 2 + b"\x86a" for i in range(1, depth)
    )
    return b"\x80\x02]q\x00" + rows + b"."


BROKEN: dict[str, Callable[[], bytes]] = {
    "deep tuples": lambda: _tuples(1_000_000),
    "deep key": lambda: b"\x80\x02})" + b"\x85" * 1_000_000 + b"Ns.",
    "loop": lambda: b"\x80\x02]q\x00h\x00a.",
    "chumpy loop": lambda: b"\x80\x02cchumpy.ch\nCh\n)\x81q\x00}X" + _text("x") + b"h\x00sb.",
    "doubling": lambda: _doubling(25),
    "memo bomb": lambda: b"\x80\x02Nr\xff\xff\xff\x7f.",
    "bytearray bomb": lambda: b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b".",
    "text bomb": lambda: b"\x80\x04\x8d" + (1 << 40).to_bytes(8, "little") + b"a.",
    "frame bomb": lambda: b"\x80\x04\x95" + (1 << 62).to_bytes(8, "little") + b"N.",
    "count as bytes": lambda: python2_pickle(Call(Global("__builtin__", "bytearray"), (1 << 40,))),
    "sparse bomb": lambda: python2_pickle(_sparse((10**7, 10**7), 10**7)),
    "sparse outside": lambda: python2_pickle(_sparse((3, 2), 2, index=3)),
    "sparse disorder": lambda: python2_pickle(_sparse((3, 2), 2, end=-1)),
    "truncated": lambda: pickle.dumps({"a": np.ones(9)})[:-40],
    "empty": lambda: b"",
    "text": lambda: b"# not a pickle\n",
    "npz": lambda: b"\x93NUMPY\x01\x00",
    "object array": lambda: pickle.dumps(np.array([{}, []], dtype=object)),
    "record array": lambda: pickle.dumps(np.zeros(2, dtype=[("a", "O"), ("b", "f8")])),
    "short array": lambda: python2_pickle(_array((5,), b"\0" * 8)),
    "array without content": lambda: python2_pickle(Call(Global("numpy", "ndarray"), ((3,),))),
    "huge integer": lambda: pickle.dumps(1 << 100_000),
    "chumpy without array": lambda: python2_pickle(New(Global("chumpy.ch", "Ch"), {"x": 1})),
    "chumpy without state": lambda: python2_pickle(New(Global("chumpy.ch", "Ch"), [1])),
    "select without array": lambda: python2_pickle(_select({"a": 1, "idxs": np.arange(2)})),
    "select outside": lambda: python2_pickle(_select({"a": np.ones(2), "idxs": np.array([2])})),
    "select reshaped": lambda: python2_pickle(
        _select({"a": np.ones(2), "idxs": np.arange(2), "preferred_shape": (3,)})
    ),
    "sparse without parts": lambda: python2_pickle(
        New(Global("scipy.sparse.csr", "csr_matrix"), {"_shape": (2, 2)})
    ),
    "sparse cut": lambda: python2_pickle(_sparse((3, 5), 2)),
    "shape of text": lambda: python2_pickle(_array(("a",), b"\0" * 8)),
    "shape of none": lambda: python2_pickle(_array(None, b"\0" * 8)),
    "array of numbers": lambda: python2_pickle(_array((1,), 5)),
    "negative shape": lambda: python2_pickle(_array((-1, -1), b"\0" * 8)),
    "scalar without bytes": lambda: python2_pickle(
        Call(Global("numpy.core.multiarray", "scalar"), (1,))
    ),
    "buffer without type": lambda: python2_pickle(
        Call(Global("numpy._core.numeric", "_frombuffer"), (b"", "f8", (0,), "C"))
    ),
    "buffer without shape": lambda: python2_pickle(
        Call(Global("numpy._core.numeric", "_frombuffer"), (b"",))
    ),
    "byte order": lambda: python2_pickle(
        _array((1,), b"\0" * 8, Call(Global("numpy", "dtype"), ("f8",), (3, "x")))
    ),
    "date": lambda: python2_pickle(
        _array((1,), b"\0" * 8, Call(Global("numpy", "dtype"), ("M8",)))
    ),
    "rebuilt text": lambda: python2_pickle(
        Call(Global("copy_reg", "_reconstructor"), ("a", "b", None))
    ),
    "encoding": lambda: python2_pickle(Call(Global("_codecs", "encode"), ("a", "utf-16"))),
    "set of text": lambda: python2_pickle(Call(Global("__builtin__", "set"), ("abc",))),
    "ordered number": lambda: python2_pickle(Call(Global("collections", "OrderedDict"), (5,))),
    "bare name": lambda: python2_pickle([Global("_codecs", "encode")]),
    "complex": lambda: pickle.dumps(1j, protocol=2),
}


def _select(state: dict[str, Any]) -> New:
    return New(Global("chumpy.reordering", "Select"), state)


def _array(shape: tuple[int, ...], raw: bytes, dtype: Call | None = None) -> Call:
    dtype = dtype or Call(Global("numpy", "dtype"), ("f8", 0, 1))
    array = (Global("numpy", "ndarray"), (0,), "b")
    state = (1, shape, dtype, False, raw)
    return Call(Global("numpy.core.multiarray", "_reconstruct"), array, state)


def _sparse(shape: tuple[int, int], major: int, index: int = 0, end: int = 1) -> New:
    indptr = np.zeros(major + 1, np.int32)
    indptr[-1] = end
    parts = {"data": np.ones(1), "indices": np.array([index]), "indptr": indptr}
    return New(Global("scipy.sparse.csc", "csc_matrix"), {"_shape": shape, **parts})


EXPLODING = {"deep tuples", "deep key", "doubling"} | {name for name in BROKEN if "bomb" in name}
"""What may exhaust the process that reads it."""
