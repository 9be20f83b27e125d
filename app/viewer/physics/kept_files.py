"""Named items that users keep for every scene of a server: one file each, in one folder."""

import logging
import re
import threading
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from app.viewer.ui.guard import without_markup
from physhandi.errors import PhysHandiError, UsageError, describe

logger = logging.getLogger(__name__)

_MOST_FILES = 200
_MOST_LETTERS = 60


class Named(Protocol):
    """Something with a name."""

    @property
    def name(self) -> str:
        """Its name for people."""
        ...


Kept = TypeVar("Kept", bound=Named)


class KeptFiles(Generic[Kept]):
    """One file for each thing that users have kept, which people may edit and copy.

    Safe to use from several threads; every session that shows the list hears of changes.
    """

    what: str
    """Word for one of them."""
    kinds: frozenset[str]
    """Suffixes of its files; new ones have `new_kind`."""
    new_kind: str
    """Suffix of new files."""

    def __init__(self, folder: Path, shown_folder: str) -> None:
        """Prepare; the folder is made when the first thing is kept.

        Args:
            folder: Where its files are.
            shown_folder: What people call this folder.
        """
        self.folder = folder
        self._shown_folder = shown_folder
        self._lock = threading.RLock()
        self._listeners: list[Callable[[], None]] = []

    @abstractmethod
    def read(self, path: Path) -> Kept:
        """Read a file.

        Raises:
            UsageError: If it holds something else; names the field and what is expected.
            OSError: If it cannot be read.
        """

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call a function after every change; returns what ends that."""
        with self._lock:
            self._listeners.append(listener)

        def unsubscribe() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return unsubscribe

    def presets(self) -> tuple[tuple[Kept, ...], tuple[str, ...]]:
        """Read all files by name, and say of each bad one what is wrong with it."""
        presets: list[Kept] = []
        problems: list[str] = []
        for path, item, problem in self._read():
            if item is None:
                problems.append(f"{self._shown_folder}/{path.name}: {problem}")
            else:
                presets.append(item)
        return tuple(sorted(presets, key=lambda item: item.name.casefold())), tuple(problems)

    def delete(self, name: str) -> None:
        """Remove what users have kept under a name.

        Raises:
            UsageError: If there is nothing of that name.
        """
        with self._lock:
            paths = [path for path, item, _ in self._read() if item and item.name == name]
            if not paths:
                raise UsageError(f"There is no {self.what} of yours called '{name}'.")
            paths[0].unlink(missing_ok=True)
        self._tell()

    def _put(self, name: str, write: Callable[[Path], None]) -> None:
        """Have a file written; one of the same name is replaced."""
        with self._lock:
            self.folder.mkdir(parents=True, exist_ok=True)
            write(self._place(name))
        self._tell()

    def _place(self, name: str) -> Path:
        """Choose the file of a name: its own, or a free one named after it."""
        files = list(self._read())
        for path, item, _ in files:
            if item is not None and item.name.casefold() == name.casefold():
                return path
        if len(files) >= _MOST_FILES:
            raise UsageError(f"{_MOST_FILES} are kept already. Delete one of them first.")
        stem = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "preset"
        used = {path.stem for path, _, _ in files}
        numbered = (stem if number == 1 else f"{stem}-{number}" for number in range(1, 10**6))
        return self.folder / f"{next(free for free in numbered if free not in used)}{self.new_kind}"

    def _read(self) -> list[tuple[Path, Kept | None, str]]:
        """Read every file: what it holds, or else its problem."""
        if not self.folder.is_dir():
            return []
        paths = [path for path in sorted(self.folder.iterdir()) if path.suffix in self.kinds]
        files: list[tuple[Path, Kept | None, str]] = []
        names: dict[str, str] = {}
        for path in paths[:_MOST_FILES]:
            if path.name.startswith("."):
                continue
            try:
                item = self.read(path)
                first = names.setdefault(item.name.casefold(), path.name)
                if first != path.name:
                    raise UsageError(f"name '{item.name}' is that of {first} too. Rename one.")
                files.append((path, item, ""))
            except (PhysHandiError, OSError) as error:
                files.append((path, None, describe(error)))
        return files

    def _tell(self) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            try:
                listener()
            except Exception:
                # Its session may have just ended, which is no matter of whoever made the change.
                logger.exception("a session could not be told of a changed %s", self.what)


def checked_kept_name(name: str, taken: frozenset[str], what: str) -> str:
    """Give a name without blanks around it.

    Args:
        name: What somebody has typed, or a file says.
        taken: Names that the program has given, folded.
        what: What is to be called by it.

    Raises:
        UsageError: If it is empty, too long, odd or taken by the program.
    """
    name = " ".join(name.split())
    if not name or len(name) > _MOST_LETTERS:
        raise UsageError(f"Type a name of 1 to {_MOST_LETTERS} letters first.")
    if without_markup(name) != name:
        raise UsageError("A preset's name is made of letters, digits, blanks and . , : ( ) + - / _")
    if name.casefold() in taken:
        raise UsageError(f"'{name}' is a {what} of the program. Choose another name.")
    return name
