"""Hash of the code and libraries that a result depends on.

What is stored under it is found again only as long as they are the same.
"""

import hashlib
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import cv2

import physhandi

INPUTS = ("synthetic/variants.py", "data/sequence_writer.py", "data/truth.py")
"""Makes what methods are given."""
PREDICTIONS = (
    *("pipeline.py", "data", "hand", "perception", "simulation", "fitting"),
    *("metrics/baselines.py", "metrics/alignment.py", "metrics/geometry.py"),
    *("synthetic/baselines.py", "synthetic/cells.py", "synthetic/hand_noise.py"),
    *INPUTS[:1],
)
"""Makes what methods predict: fits, rules, corrections and disturbances."""
SCORES = ("metrics", "synthetic/cell_scores.py", "data", "hand")
"""Makes figures of predictions."""
PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "cma", "safetensors")
"""Libraries that predictions and figures are computed with, beside OpenCV."""

_KINDS = {".py", ".npz", ".yaml", ".tflite", ".glb"}


@lru_cache(maxsize=8)
def code_version(parts: tuple[str, ...]) -> str:
    """Hash modules and folders of this library, and the versions of what it computes with.

    Args:
        parts: Files and folders, relative to the library.

    Raises:
        FileNotFoundError: If one is not there, for then nothing would tell that it has changed.
    """
    code = code_hash(Path(physhandi.__file__).parent, parts)
    # Several distributions carry OpenCV.
    versions = [f"opencv {cv2.__version__}", *(f"{name} {version(name)}" for name in PACKAGES)]
    return hashlib.sha256("\0".join([code, *versions]).encode()).hexdigest()[:16]


def code_hash(folder: Path, parts: tuple[str, ...]) -> str:
    """Hash files, and all sources and assets in folders.

    Args:
        folder: Where they lie.
        parts: Names of files and folders in it.

    Raises:
        FileNotFoundError: If a part does not exist.
    """
    digest = hashlib.sha256()
    for part in parts:
        path = folder / part
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file == path or file.suffix in _KINDS:
                digest.update(f"{file.relative_to(folder).as_posix()}\0".encode())
                digest.update(file.read_bytes())
    return digest.hexdigest()[:12]
