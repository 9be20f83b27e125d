"""Hash of the code and libraries that a result depends on, as a key of stored results."""

import hashlib
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2

import physhandi
from physhandi.data.sequence import Sequence

INPUTS = ("synthetic/suite/variants.py", "data/sequence_writer.py", "data/truth.py")
"""Code that makes the inputs of methods."""
PREDICTIONS = (
    *("pipeline.py", "fitted_object.py", "object_rollout.py", "settings.py", "triangles.py"),
    *("rotations.py", "adam.py", "one_thread.py", "typed.py"),
    *("unique_rows.py", "data", "hand", "perception", "simulation", "fitting"),
    *("metrics/baselines.py", "metrics/alignment.py", "metrics/geometry.py"),
    "metrics/truth_metrics.py",
    *("synthetic/suite/methods.py", "synthetic/suite/cells.py"),
    *INPUTS[:1],
)
"""Code that makes predictions: fits, rules, corrections and noise."""
LOOKS = (
    *("appearance", "rendering", "data", "metrics", "perception", "simulation"),
    *("settings.py", "srgb.py", "triangles.py", "rotations.py", "adam.py"),
    *("one_thread.py", "typed.py", "unique_rows.py", "fitting/appearance_fit.py"),
)
"""Code that fits what an object looks like, and draws it."""
SCORES = (
    *("metrics", "synthetic/suite/cells.py", "hand"),
    *LOOKS,
)
"""Code that scores predictions."""
PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "cma", "safetensors")
"""Libraries that predictions and figures are computed with, beside OpenCV."""

_KINDS = {".py", ".npz", ".yaml", ".tflite", ".glb"}


@lru_cache(maxsize=8)
def code_version(parts: tuple[str, ...]) -> str:
    """Hash modules and folders of this library, and the versions of what it computes with.

    Args:
        parts: Files and folders, relative to the library.

    Raises:
        FileNotFoundError: If one does not exist, as its changes would go unnoticed.
    """
    code = code_hash(Path(physhandi.__file__).parent, parts)
    # Several distributions carry OpenCV.
    versions = [f"opencv {cv2.__version__}", *(f"{name} {version(name)}" for name in PACKAGES)]
    return hashlib.sha256("\0".join([code, *versions]).encode()).hexdigest()[:16]


def code_hash(folder: Path, parts: tuple[str, ...]) -> str:
    """Hash files, and all sources and assets in folders.

    Args:
        folder: Folder that contains them.
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


_PARTS = (
    *(f"synthetic/{part}" for part in ("assets", "bodies", "engines", "film", "hands")),
    *("synthetic/synthesize.py", "rendering", "triangles.py"),
)


@lru_cache(maxsize=1)
def generator_version() -> str:
    """Return the version of the generator, ``CODE-mujoco-VERSION``.

    Any change of its code counts, since it may change sequences.
    """
    try:
        engine = version("mujoco")
    except PackageNotFoundError:
        engine = "none"
    return f"{code_hash(Path(physhandi.__file__).parent, _PARTS)}-mujoco-{engine}"


def recorded_version(recording: Sequence) -> str:
    """Return the version of the generator that made a recording; empty if unknown."""
    return str(recording.provenance.get("generator") or "")


def outdated(recording: Sequence) -> str:
    """Explain that another generator made a synthetic recording; empty if this one did."""
    if "synthesize" not in recording.provenance:
        return ""
    recorded, present = recorded_version(recording), generator_version()
    if recorded == present or (present.endswith("-none") and recorded.startswith(present[:12])):
        return ""
    by = f"another version of the generator ({recorded})" if recorded else "an unknown generator"
    return (
        f"Sequence '{recording.name}' was made by {by}; the present one ({present}) may make it "
        f"otherwise. To have it made anew, delete {recording.folder} first."
    )
