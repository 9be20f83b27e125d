"""The reading side of a run folder: its state and its published outputs."""

from pathlib import Path
from typing import Any, Literal, cast

from numpy import ndarray
from safetensors import SafetensorError

from physhandi.data.files import named_fields, read_array, read_tensors
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import (
    ATTEMPTS,
    CANCEL,
    CURRENT,
    EXIT,
    MANIFEST,
    OUT,
    STAGES,
    artefacts,
    attempt_numbers,
    find_damage,
    inside,
    read_json,
    read_mapping,
    read_yaml,
)
from physhandi.errors import RunError

RunState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
_ENDS: tuple[RunState, ...] = ("succeeded", "failed", "cancelled")
_VANISHED = "The process that worked on this run is gone without a word. Start it again to go on."


class RunOutputs:
    """State and outputs of a run, read from its folder each time they are asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = folder.name

    @property
    def state(self) -> RunState:
        """How far the run is."""
        if live_holder(self.folder) is not None:
            return "running"
        state = read_mapping(self.folder / EXIT).get("state")
        for end in _ENDS:
            if state == end:
                return end
        numbers = attempt_numbers(self.folder)
        if numbers and self._published() == numbers[-1]:
            return "succeeded"
        if (self.folder / CANCEL).exists():
            return "cancelled"
        return "failed" if numbers else "queued"

    @property
    def error(self) -> str | None:
        """What went wrong in a failed run."""
        if self.state != "failed":
            return None
        return str(read_mapping(self.folder / EXIT).get("error", _VANISHED))

    @property
    def is_published(self) -> bool:
        """Whether there are published results."""
        return self._published() is not None

    @property
    def attempt(self) -> int | None:
        """Number of the latest attempt; none if no attempt was begun yet."""
        return max(attempt_numbers(self.folder), default=None)

    def stages(self) -> list[dict[str, Any]]:
        """Give the finished stages of the latest attempt, in the order in which they ended.

        Returns:
            For each stage ``name``, ``time`` of its end, ``seconds`` that it took (where they were
            measured), ``summary`` (what `Attempt.finish_stage` was told) and ``files``.

        Raises:
            RunError: If their list is damaged.
        """
        path = self.folder / ATTEMPTS / str(self.attempt) / STAGES
        content: Any = read_json(path) if path.is_file() else []
        if not isinstance(content, list):
            raise RunError(f"{path} must list stages; it is damaged.")
        stages = [named_fields(entry) or {} for entry in cast("list[Any]", content)]
        if any("name" not in stage for stage in stages):
            raise RunError(f"{path} must name its stages; it is damaged.")
        return stages

    @property
    def out(self) -> Path:
        """Folder of the published outputs, else of the latest attempt.

        Raises:
            RunError: If no attempt was begun yet.
        """
        number = self._published() or max(attempt_numbers(self.folder), default=None)
        if number is None:
            raise RunError(f"Run '{self.id}' has no outputs yet: it is {self.state}.")
        return self.folder / ATTEMPTS / str(number) / OUT

    def has(self, rel: str) -> bool:
        """Tell whether there is an output of that name."""
        if self._published() is None and not attempt_numbers(self.folder):
            return False
        return inside(self.out, rel).is_file()

    def array(self, rel: str, *, mmap: bool = True) -> ndarray:
        """Open an array; mapped ones are read-only.

        Raises:
            RunError: If it is missing or damaged.
        """
        path = self._existing(rel)
        try:
            return read_array(path, mmap=mmap)
        except (ValueError, OSError) as error:
            raise RunError(f"Run '{self.id}': {rel} is not a readable array: {error}.") from error

    def tensors(self, rel: str) -> dict[str, ndarray]:
        """Read named arrays.

        Raises:
            RunError: If the file is missing or damaged.
        """
        path = self._existing(rel)
        try:
            return read_tensors(path)
        except (SafetensorError, ValueError, OSError) as error:
            raise RunError(f"Run '{self.id}': {rel} is not readable: {error}.") from error

    def yaml(self, rel: str) -> Any:
        """Read plain data from YAML."""
        return read_yaml(self._existing(rel))

    def json(self, rel: str) -> Any:
        """Read plain data from JSON."""
        return read_json(self._existing(rel))

    def verify(self, *, allows_more: bool = False) -> None:
        """Compare all published files with the hashes of their manifest.

        Args:
            allows_more: Whether files may lie among the results that the manifest does not know,
                such as a user's notes.

        Raises:
            RunError: If nothing is published, or a file is missing, changed or unknown; names it.
        """
        number = self._published()
        if number is None:
            if self.state == "succeeded":
                raise RunError(
                    f"Run '{self.id}' has ended, but its results are not whole: '{CURRENT}' does "
                    f"not lead to an attempt with a {MANIFEST}. Run it again."
                )
            raise RunError(
                f"Run '{self.id}' is {self.state}: there is nothing published to read yet."
            )
        folder = self.folder / ATTEMPTS / str(number)
        files = named_fields(read_mapping(folder / MANIFEST).get("files"))
        if files is None:
            raise RunError(f"{folder / MANIFEST} lists no files; it is damaged. Run it again.")
        damage = find_damage(folder / OUT, files)
        if damage is None and not allows_more:
            unknown = [rel for rel, _ in artefacts(folder / OUT) if rel not in files]
            damage = f"{unknown[0]} is not in {MANIFEST}" if unknown else None
        if damage is not None:
            raise RunError(
                f"Run '{self.id}': {damage}. Its results cannot be trusted; run it again."
            )

    def _published(self) -> int | None:
        path = self.folder / CURRENT
        text = path.read_text().strip() if path.is_file() else ""
        is_whole = text.isdigit() and (self.folder / ATTEMPTS / text / MANIFEST).is_file()
        return int(text) if is_whole else None

    def _existing(self, rel: str) -> Path:
        path = inside(self.out, rel)
        if not path.is_file():
            raise RunError(f"Run '{self.id}' has no {rel}; it is {self.state}.")
        return path
