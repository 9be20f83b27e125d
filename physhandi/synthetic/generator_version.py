"""Which generator made a sequence: a hash of the code that decides it, and MuJoCo's version."""

import hashlib
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from physhandi.data.sequence import Sequence

_PARTS = (
    *("bodies.py", "solids.py", "tubes.py", "scenes.py", "stage.py", "shot.py"),
    *("actions.py", "handling.py", "grasp.py", "places.py", "hand_script.py", "hand_shapes.py"),
    *("true_hand.py", "assets", "engines", "cameras.py", "sensors.py", "degradations.py"),
    *("presets.py", "filming.py", "rendering.py", "rasterizer.py", "recording.py"),
    "synthesize.py",
)
_KINDS = {".py", ".npz", ".yaml", ".tflite", ".glb"}


@lru_cache(maxsize=1)
def generator_version() -> str:
    """Name the version of the generator, ``CODE-mujoco-VERSION``.

    Any change of its code counts, for which sequences of other code may differ.
    """
    try:
        engine = version("mujoco")
    except PackageNotFoundError:
        engine = "none"
    return f"{code_hash(Path(__file__).parent, _PARTS)}-mujoco-{engine}"


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


def told_version(recording: Sequence) -> str:
    """Give the version of the generator that made a recording; empty if it does not tell."""
    return str(recording.provenance.get("generator") or "")


def outdated(recording: Sequence) -> str:
    """Say that a made recording comes of another generator than this one; empty if it does not."""
    if "synthesize" not in recording.provenance:
        return ""
    made, present = told_version(recording), generator_version()
    if made == present or (present.endswith("-none") and made.startswith(present[:12])):
        return ""
    by = f"another version of the generator ({made})" if made else "an unknown generator"
    return (
        f"Sequence '{recording.name}' was made by {by}; the present one ({present}) may make it "
        f"otherwise. To have it made anew, delete {recording.folder} first."
    )
