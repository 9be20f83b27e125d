"""Foreign pickles, read in a child process that cannot execute what they ask for.

A pickle is a program. Nothing in it is trusted: the child knows only stand-ins for containers and
arrays, has limits of memory and time, and hands back arrays (.npz) and a tree (JSON).
"""

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

import numpy as np

from physhandi.data.untrusted_worker import REFUSED
from physhandi.errors import ImportFailedError

logger = logging.getLogger(__name__)

_WORKER = "physhandi.data.untrusted_worker"
_PACKAGE_ROOT = Path(__file__).parents[2]
_ADVICE = (
    "Only numbers, text, containers, NumPy arrays, sparse matrices, chumpy arrays and tensors of "
    "a torch checkpoint are read. Nothing of the file was executed; use the file as its publisher "
    "released it, or store plain arrays."
)


def read_untrusted(path: Path, *, time_limit_s: float = 120.0, memory_limit: int = 8 << 30) -> Any:
    """Read a foreign pickle or torch checkpoint without executing anything of it.

    NumPy numbers become Python numbers, sparse matrices dense arrays, chumpy arrays and torch
    tensors NumPy arrays, sets lists, and bytes text (latin1, as Python 2 meant it).

    Args:
        path: A pickle of any protocol, Python 2's included, or what ``torch.save`` wrote (the zip
            format of torch 1.6 and later).
        time_limit_s: Most time that reading may take [s].
        memory_limit: Most address space that reading may take [byte]; the arrays may take a
            quarter of it.

    Returns:
        A tree of dict, list, tuple, str, int, float, bool, None and arrays.

    Raises:
        ImportFailedError: If the file is missing, broken, too large, or asks for anything else;
            names the file and what it asks for.
    """
    path = Path(path)
    if not path.is_file():
        raise ImportFailedError(f"{path} is not a file.")
    with tempfile.TemporaryDirectory(prefix="physhandi-import-") as folder:
        _read_in_child(path.absolute(), Path(folder), time_limit_s, memory_limit)
        return _collect(Path(folder))


def _read_in_child(path: Path, out: Path, time_limit_s: float, memory_limit: int) -> None:
    seconds = max(1, round(time_limit_s))
    limits = [str(seconds), str(memory_limit)]
    kept = {name: value for name, value in os.environ.items() if name[:10] != "PHYSHANDI_"}
    try:
        child = subprocess.run(
            [sys.executable, "-m", _WORKER, str(path), str(out), *limits],
            # `-m` searches the working directory first, so it must be the one of our packages.
            cwd=_PACKAGE_ROOT,
            env={**kept, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=time_limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ImportFailedError(
            f"{path}: refused, because reading it took more than {time_limit_s:g} s. {_ADVICE}"
        ) from None
    if child.returncode == REFUSED:
        reason = (out / "refusal.txt").read_text(encoding="utf-8")
        raise ImportFailedError(f"{path}: refused, because {reason}. {_ADVICE}")
    if child.returncode:
        logger.debug("the reader of %s said: %s", path, child.stderr.decode(errors="replace"))
        raise ImportFailedError(
            f"{path}: refused, because its reader ended {_ending(child.returncode)}. {_ADVICE}"
        )


def _ending(code: int) -> str:
    if code >= 0:
        return f"with exit code {code}"
    known = {signal.SIGKILL: "for want of memory or time", signal.SIGXCPU: "for want of time"}
    return known.get(signal.Signals(-code), f"by signal {-code}; it may be nested too deeply")


def _collect(folder: Path) -> Any:
    with np.load(folder / "array.npz", allow_pickle=False) as stored:
        arrays = [np.array(stored[str(number)]) for number in range(len(stored.files))]
    return _decode(json.loads((folder / "tree.json").read_text(encoding="ascii")), arrays)


def _decode(value: Any, arrays: list[Any]) -> Any:
    if not isinstance(value, dict):
        return value
    ((tag, content),) = cast("dict[str, Any]", value).items()
    if tag == "array":
        return arrays[content]
    if tag == "dict":
        return {_decode(key, arrays): _decode(item, arrays) for key, item in content}
    items: list[Any] = [_decode(item, arrays) for item in content]
    return tuple(items) if tag == "tuple" else items
