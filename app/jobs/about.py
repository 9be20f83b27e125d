"""Name, tags and note that a user gives a run."""

import threading
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from app.jobs.catalog import Catalog
from physhandi.errors import RunError

_lock = threading.Lock()


def one_line(text: str) -> str:
    """Trim a text that a user gave for one line.

    Raises:
        ValueError: If it has a sign that cannot be printed, such as a line break.
    """
    text = text.replace("\xa0", " ").strip()
    if not text.isprintable():
        raise ValueError("it has a line break or another sign that cannot be printed")
    return text


Line = Annotated[str, Field(max_length=120), AfterValidator(one_line)]
"""A name or another text of one line; may be empty."""


def _named(text: str) -> str:
    text = one_line(text)
    if not text:
        raise ValueError("a run needs a name")
    return text


def _word(text: str) -> str:
    text = one_line(text)
    if not text or "," in text or " " in text:
        raise ValueError("a tag is one word without blanks and commas")
    return text


def _lines(text: str) -> str:
    text = text.replace("\r\n", "\n").replace("\t", "    ").replace("\xa0", " ").strip()
    if not text.replace("\n", "").isprintable():
        raise ValueError("it has a sign that cannot be printed")
    return text


Tag = Annotated[str, Field(max_length=40), AfterValidator(_word)]


class RunChanges(BaseModel):
    """New name, tags or note of a run; a field that is left out stays as it is."""

    model_config = ConfigDict(extra="forbid")

    name: Annotated[str, Field(max_length=120), AfterValidator(_named)] | None = None
    tags: Annotated[list[Tag], Field(max_length=20)] | None = None
    """Words that lists can be filtered by."""
    note: Annotated[str, Field(max_length=4000), AfterValidator(_lines)] | None = None
    """Plain text of several lines."""


def change_about(catalog: Catalog, run_id: str, changes: RunChanges) -> None:
    """Write a run's new name, tags or note, also while it is at work.

    Args:
        catalog: Finds the run.
        run_id: The run.
        changes: What changes.

    Raises:
        RunError: If the run is unknown, damaged or bundled.
    """
    with _lock:  # Two changes at a time must not take each other back.
        if catalog.run_item(run_id).is_bundled:
            raise RunError(f"Run '{run_id}' came with the program and stays as it is.")
        label = None if changes.tags is None else ", ".join(dict.fromkeys(changes.tags))
        catalog.run(run_id).rename(changes.name, label=label, note=changes.note)
