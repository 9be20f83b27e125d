"""Arrays in files: NumPy's own ``.npy``, and safetensors."""

import math
import os
import tokenize
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from safetensors import numpy as safetensors_numpy

from physhandi.data.files import write_atomically

_MAGIC = b"\x93NUMPY"
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
"""Readers of headers by the version of the format."""
_ODD = (tokenize.TokenError, SyntaxError, TypeError, KeyError, OverflowError, MemoryError)


def write_array(path: Path, array: np.ndarray) -> None:
    """Write an array as ``.npy``; arrays of Python objects are refused (ValueError)."""
    contiguous = np.asarray(array, order="C")

    def write(stream: BinaryIO) -> None:
        # NumPy's own writer of files does not say that a disk is full, so it is given no file.
        np.save(_Unlabelled(stream), contiguous, allow_pickle=False)

    write_atomically(path, write)


class _Unlabelled:
    """Something that can be written to, and nothing else."""

    def __init__(self, stream: BinaryIO) -> None:
        self.write = stream.write


def read_array(path: Path, *, mmap: bool = False) -> np.ndarray:
    """Read an ``.npy`` file without ever unpickling.

    Args:
        path: File to read.
        mmap: Map the file instead of reading it; the array is read-only.

    Raises:
        ValueError: If the file is not a whole array of plain numbers.
        FileNotFoundError: If there is no such file.
    """
    with path.open("rb") as stream:
        start = stream.read(len(_MAGIC))
        if start != _MAGIC:
            kinds = {b"": "the file is empty", b"PK": "it is an archive, not one array"}
            raise ValueError(kinds.get(start[:2], "it does not begin as one"))
        stream.seek(0)
        try:
            mapped = _mapped(path, stream)
        except _ODD as error:  # What NumPy lets out of a header that it cannot parse.
            raise ValueError(f"its header is damaged ({error})") from error
    return mapped if mmap else np.array(mapped)


def _mapped(path: Path, stream: BinaryIO) -> np.ndarray:
    """Map the array of an open file, as `numpy.load` does, which parses its header once more.

    Raises:
        ValueError: If its header announces more than the file holds, or Python objects.
    """
    read = _HEADERS.get(npy.read_magic(stream))
    if read is None:  # Names of fields that are not Latin, which NumPy judges itself.
        mapped: Any = np.load(path, mmap_mode="r", allow_pickle=False)
        return mapped
    shape, is_fortran, kind = read(stream)
    offset = stream.tell()
    announced, there = math.prod(shape) * kind.itemsize, stream.seek(0, os.SEEK_END) - offset
    if announced > there:
        raise ValueError(
            f"its header announces {shape} numbers of {kind}, {announced} bytes, but {there} follow"
        )
    if kind.hasobject:
        raise ValueError("it holds Python objects")
    return np.memmap(stream, kind, "r", offset, shape, "F" if is_fortran else "C")


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """Read a ``.safetensors`` file."""
    return safetensors_numpy.load(path.read_bytes())
