"""Which generator made a sequence: a hash of the code that decides it, and MuJoCo's version."""

from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from physhandi.data.sequence import Sequence
from physhandi.synthetic.code_hash import code_hash

_PARTS = (
    *("bodies.py", "solids.py", "tubes.py", "scenes.py", "stage.py", "shot.py"),
    *("actions.py", "handling.py", "grasp.py", "places.py", "hand_script.py", "hand_shapes.py"),
    *("true_hand.py", "assets", "engines", "cameras.py", "sensors.py", "degradations.py"),
    *("presets.py", "filming.py", "rendering.py", "rasterizer.py", "recording.py"),
    "synthesize.py",
)


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
