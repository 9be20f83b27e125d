"""Recordings of other people that some tests read; they lie beside the repository."""

import os
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "data"


def recording(name: str) -> Path:
    """Give the path of a recording; without it the test is skipped, or fails in CI."""
    path = FOLDER / name
    if not path.exists():
        told = f"needs the recording {name} in ../shared/data"
        if os.environ.get("CI"):
            pytest.fail(f"{told}, which CI has")
        pytest.skip(told)
    return path
