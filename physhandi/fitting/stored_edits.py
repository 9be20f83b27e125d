"""Edits of an object as files: those that a run is asked for, and those that a rollout has."""

import hashlib
from pathlib import Path
from typing import Any

from physhandi.data.files import write_bytes
from physhandi.errors import UsageError
from physhandi.simulation.edits import Edits, decode_edits, encode_edits

EDITS_FILE = "edits.json"
"""File of a run's folder with the edits that it was asked for."""
MOST_EDIT_BYTES = 64 << 20
"""A larger file holds no edits."""


def describe_edits(edits: Edits) -> dict[str, Any]:
    """Give what a run's configuration says of its edits under ``edits``.

    Returns:
        Their titles (``steps``), and what tells them from other edits (``sha256``).
    """
    digest = hashlib.sha256(encode_edits(edits)).hexdigest()
    return {"steps": [edit.title for edit in edits], "sha256": digest}


def store_edits(folder: Path, edits: Edits) -> None:
    """Store edits in the folder of a run whose configuration describes them."""
    write_bytes(folder / EDITS_FILE, encode_edits(edits))


def read_edits(path: Path) -> Edits:
    """Read a file of edits.

    Raises:
        UsageError: If it is missing, too large or damaged; names it.
    """
    try:
        if path.stat().st_size > MOST_EDIT_BYTES:
            raise UsageError(
                f"{path} has more than {MOST_EDIT_BYTES >> 20} MiB, so it holds no edits."
            )
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}.") from error
    return decode_edits(content, str(path))
