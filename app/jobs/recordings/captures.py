"""Folders of the server's machine from which recordings may be imported in the browser."""

from dataclasses import dataclass
from pathlib import Path

from app.jobs.catalog import NotFoundError
from app.settings import ServerSettings
from physhandi.data.importers.bag import BAG_SUFFIXES
from physhandi.data.importers.recorded_stream import natural_key
from physhandi.data.sequence_meta import safe_name
from physhandi.errors import UsageError

_MOST_LISTED = 500


class UnknownCaptureError(UsageError, NotFoundError):
    """There is no such place in the folders that may be imported from."""


@dataclass(frozen=True)
class CaptureEntry:
    """A folder or bag that is listed."""

    name: str
    """Its name."""
    place: str
    """Path by which it is requested: the folder's name and the way from there, with slashes."""
    is_bag: bool
    """Whether it is a bag."""


class CaptureFolders:
    """Lists and finds recordings; nothing outside of the operator's folders is ever named."""

    def __init__(self, settings: ServerSettings) -> None:
        """Prepare.

        Args:
            settings: Tell the folders.
        """
        self.own = settings.capture_dir
        self._roots: dict[str, Path] = {"captures": self.own}
        for folder in settings.captures:
            label = safe_name(folder.name, longest=None) or "folder"
            number = 1
            while label in self._roots:
                number += 1
                label = f"{label.removesuffix(f'_{number - 1}')}_{number}"
            self._roots[label] = folder

    @property
    def roots(self) -> dict[str, Path]:
        """The folders by the names that they have in browsers."""
        return dict(self._roots)

    def list(self, place: str = "") -> list[CaptureEntry]:
        """List the folders and bags in a folder, or the operator's folders.

        Raises:
            UnknownCaptureError: If there is no such folder.
        """
        if not place:
            return [CaptureEntry(label, label, False) for label in self._roots]
        folder = self.find(place)
        if not folder.is_dir():
            return []
        entries: list[CaptureEntry] = []
        for path in sorted(folder.iterdir(), key=natural_key):
            is_bag = path.is_file() and path.suffix.lower() in BAG_SUFFIXES
            if (is_bag or path.is_dir()) and self._look(f"{place}/{path.name}") is not None:
                entries.append(CaptureEntry(path.name, f"{place}/{path.name}", is_bag))
        return entries[:_MOST_LISTED]

    def find(self, place: str) -> Path:
        """Find a folder or file.

        Raises:
            UnknownCaptureError: If there is none, or it lies, by a link, outside of the folders.
        """
        path = self._look(place)
        if path is None:
            raise UnknownCaptureError(
                f"There is no '{place}' in the folders that this server imports from "
                f"({', '.join(self._roots)})."
            )
        return path

    def _look(self, place: str) -> Path | None:
        label, *parts = place.split("/")
        root = self._roots.get(label)
        if root is None or not all(map(_is_name, parts)):
            return None
        if not parts:
            root.mkdir(parents=True, exist_ok=True)
        try:
            path = root.joinpath(*parts).resolve(strict=True)
        except (OSError, RuntimeError):  # Nothing there, too long, or links in a circle.
            return None
        return path if path.is_relative_to(root.resolve()) else None


def _is_name(part: str) -> bool:
    return part not in {"", ".", ".."} and not part.startswith(".") and not {"\\", "\0"} & set(part)
