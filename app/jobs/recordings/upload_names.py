"""Names that files of others may have: what every system takes for a file in its folder."""

import unicodedata
from collections.abc import Iterable

from physhandi.errors import UsageError

MOST_FILES = 20_000
"""Files of one upload at most."""
_DEEPEST = 12
_LONGEST_PART, _LONGEST = 200, 500
_ELSEWHERE = frozenset('\\:<>"|?*')
"""Characters that some system gives a meaning of its own."""
_DEVICES = frozenset(
    ("con", "prn", "aux", "nul", *(f"{kind}{n}" for kind in ("com", "lpt") for n in range(1, 10)))
)
_LEFT_OUT = frozenset({"__MACOSX", "Thumbs.db", "desktop.ini"})


def is_left_out(name: str) -> bool:
    """Tell whether a file is one that systems leave behind, or hidden, and is not wanted."""
    parts = name.split("/")
    is_hidden = any(part.startswith(".") and part not in {".", ".."} for part in parts)
    return is_hidden or any(part in _LEFT_OUT for part in parts)


def check_names(names: Iterable[str]) -> None:
    """Refuse names that lead elsewhere, or that some system takes for something else.

    Args:
        names: Names with slashes, below the folder of the upload.

    Raises:
        UsageError: If one is of that kind, or two are the same for some system; names it.
    """
    files: dict[str, str] = {}
    folders: dict[str, str] = {}
    for number, name in enumerate(names):
        if number == MOST_FILES:
            raise UsageError(f"There are more than {MOST_FILES:,} files; leave some out.")
        wrong = _wrong_with(name)
        if wrong is not None:
            raise UsageError(f"{quoted_name(name)}: {wrong}. Rename it.")
        # Systems that ignore case and accents' spelling would write one over the other.
        key = unicodedata.normalize("NFC", name).casefold()
        if key in files:
            raise UsageError(
                f"{quoted_name(name)}: '{files[key]}' is the same name for some systems."
            )
        files[key] = name
        while "/" in key:
            key = key.rpartition("/")[0]
            folders.setdefault(key, name)
    for key, name in files.items():
        if key in folders:
            raise UsageError(
                f"{quoted_name(name)}: it is a file, and the folder of '{folders[key]}'."
            )


def quoted_name(name: str) -> str:
    """Write a name of others for people, in one line of bearable length."""
    plain = "".join(char if char.isprintable() else "�" for char in name)
    return f"'{plain[:80]}…'" if len(plain) > 80 else f"'{plain}'"


def _wrong_with(name: str) -> str | None:
    if not name or len(name) > _LONGEST:
        return f"a name has 1 to {_LONGEST} characters"
    if not name.isprintable() or _ELSEWHERE & set(name):
        return "it has characters that not every system allows in a file's name"
    parts = name.split("/")
    if len(parts) > _DEEPEST:
        return f"it lies deeper than {_DEEPEST} folders"
    return next(filter(None, map(_wrong_with_part, parts)), None)


def _wrong_with_part(part: str) -> str | None:
    if part in {"", ".", ".."}:
        return "it leads out of its folder, or nowhere"
    if len(part.encode()) > _LONGEST_PART:
        return f"a part of it is longer than {_LONGEST_PART} bytes"
    if part[-1] in ". " or part[0] == " ":
        return "a part of it begins or ends with a space, or ends with a dot"
    is_device = part.partition(".")[0].casefold() in _DEVICES
    return "some systems take it for a device" if is_device else None
