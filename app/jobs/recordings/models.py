"""Networks that a user has put into the data folder, to find masks and tracks in the browser."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from app.settings import ServerSettings
from physhandi.errors import UsageError
from physhandi.perception.mask_model import mask_model_kind
from physhandi.perception.track_model import track_model_kind

Finds = Literal["masks", "tracks"]
_KINDS: dict[Finds, Callable[[Path], str]] = {"masks": mask_model_kind, "tracks": track_model_kind}


@dataclass(frozen=True)
class ModelEntry:
    """A network that can be chosen."""

    name: str
    """Name of its folder."""
    finds: Finds
    """Kind of annotation that it makes; networks for tracks are code, which is executed."""
    kind: str
    """Its kind, as provenance calls it."""


class ModelFolders:
    """Lists and finds networks. Browsers name them, never a place of the server's machine."""

    def __init__(self, settings: ServerSettings) -> None:
        """Prepare.

        Args:
            settings: Tell the folder.
        """
        self.folder = settings.model_dir

    def list(self) -> list[ModelEntry]:
        """List what the folder holds; what is no network, or lacks its weights, is left out.

        Folders are described by their files; nothing of them is executed.
        """
        if not self.folder.is_dir():
            return []
        entries: list[ModelEntry] = []
        for path in sorted(self.folder.iterdir()):
            for finds, kind in _KINDS.items():
                try:
                    entries.append(ModelEntry(path.name, finds, kind(path)))
                except UsageError:
                    continue
        return entries

    def find(self, name: str, finds: Finds) -> Path:
        """Find the folder of a network.

        Raises:
            UsageError: If there is none of that name that finds this.
        """
        if not any((entry.name, entry.finds) == (name, finds) for entry in self.list()):
            raise UsageError(f"{self.folder} holds no network '{name}' that finds {finds}.")
        return self.folder / name
