"""Keys by which clients that ask again get the run that they have already launched."""

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from physhandi.data.files import named_fields, write_json
from physhandi.data.run_folder import read_mapping
from physhandi.errors import RunError, UsageError

logger = logging.getLogger(__name__)

_FORMAT = "physhandi-launches/1"
MOST_LAUNCH_KEYS = 1000
"""Keys that are remembered; the oldest are forgotten first."""


@dataclass(frozen=True)
class KeyedRequest:
    """A wish for a run that may come several times."""

    key: str
    """The client's key, hashed: it may be of any length."""
    body: str
    """The request's body, hashed."""

    @classmethod
    def of(cls, key: str, body: Mapping[str, Any]) -> "KeyedRequest":
        """Make it of what came over the network."""
        text = json.dumps(body, sort_keys=True)
        return cls(*(hashlib.sha256(part.encode()).hexdigest() for part in (key, text)))


class LaunchKeys:
    """Remembers, over restarts, which run was launched by which key; its user holds a lock."""

    def __init__(self, path: Path) -> None:
        """Prepare; the file is read when the first key comes.

        Args:
            path: File that keeps them; made for the first key.
        """
        self._path = path
        self._read: dict[str, tuple[str, str, bool]] | None = None

    def run_of(self, request: KeyedRequest) -> str | None:
        """Give the id of the run that a request is for; None if it comes for the first time.

        Raises:
            UsageError: If another request had its key.
            RunError: If its run was deleted since.
        """
        if (entry := self._entries().get(request.key)) is None:
            return None
        body, run_id, is_deleted = entry
        if body != request.body:
            raise UsageError(
                f"Idempotency-Key: this key has launched run '{run_id}', which was asked for in "
                "other words. Use a new key for each fit, and the same only to ask again."
            )
        if is_deleted:
            raise RunError(
                f"Run '{run_id}', which this Idempotency-Key has launched, was deleted since. "
                "Use a new key to launch another one."
            )
        return run_id

    def note(self, request: KeyedRequest, run_id: str) -> None:
        """Remember a run that is about to be made."""
        entries = self._entries()
        recent = dict(list(entries.items())[-(MOST_LAUNCH_KEYS - 1) :])
        self._save(recent | {request.key: (request.body, run_id, False)})

    def note_deleted(self, run_id: str) -> None:
        """Remember that a run was deleted, so that who asks late does not get another one."""
        entries = self._entries()
        if any(entry[1] == run_id for entry in entries.values()):
            self._save({k: (b, r, gone or r == run_id) for k, (b, r, gone) in entries.items()})

    def _save(self, entries: dict[str, tuple[str, str, bool]]) -> None:
        write_json(self._path, {"format": _FORMAT, "launches": entries})
        self._read = entries

    def _entries(self) -> dict[str, tuple[str, str, bool]]:
        if self._read is None:
            self._read = self._load()
        return self._read

    def _load(self) -> dict[str, tuple[str, str, bool]]:
        try:
            content = read_mapping(self._path)
        except RunError as error:
            logger.warning("its keys are forgotten: %s", error)
            return {}
        entries: dict[str, tuple[str, str, bool]] = {}
        for key, entry in (named_fields(content.get("launches")) or {}).items():
            match cast("object", entry):
                case [str(body), str(run_id), bool(is_deleted)]:
                    entries[key] = (body, run_id, is_deleted)
                case _:
                    logger.warning("%s is damaged at key %s, which is forgotten", self._path, key)
        return entries
