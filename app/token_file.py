"""Tokens that are kept in files, so that cookies and links outlive the server."""

import os
import re
import secrets
import stat
from pathlib import Path

from physhandi.data.files import temporary_name
from physhandi.errors import UsageError

_TOKEN = re.compile(r"[A-Za-z0-9._~-]{16,256}")
_MOST_BYTES = 1024


def read_or_make_token(path: Path) -> str:
    """Read a token from its file, which is made if it is missing.

    The file is a secret: who can read it can do all that its token allows. A new one has mode 600,
    and is whole as soon as it is there.

    Raises:
        UsageError: If others may read or change it, or it holds no token; names file and remedy.
        OSError: If it can neither be read nor made.
    """
    path = path.expanduser()
    try:
        return _read(path)
    except FileNotFoundError:
        _make(path)
        return _read(path)  # Another server may have been faster.


def _make(path: Path) -> None:
    made = path.with_name(temporary_name(path.name))
    descriptor = os.open(made, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_urlsafe(32) + "\n")
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(made, path)  # Never replaces one that is there.
        except FileExistsError:
            return
    finally:
        made.unlink()


def _read(path: Path) -> str:
    # What blocks when it is opened, such as a named pipe, must not hold up the server.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise UsageError(f"{path} is no file that could hold a token.")
        if about.st_mode & 0o077:
            mode = stat.S_IMODE(about.st_mode)
            raise UsageError(
                f"{path} holds a token, and others may use it (mode {mode:o}). Delete it for a new "
                f"one, or, if nobody has read it, make it yours alone: chmod 600 {path}"
            )
        if about.st_uid != os.geteuid():
            raise UsageError(
                f"{path} belongs to another user, who can change the token. Name a file of the "
                "user that the server runs as."
            )
        content = os.read(descriptor, _MOST_BYTES)
    finally:
        os.close(descriptor)
    token = content.decode("ascii", "replace").strip()
    if not _TOKEN.fullmatch(token):
        raise UsageError(
            f"{path} holds no token: expected one line of 16 to 256 letters, digits and . _ ~ -. "
            "Delete it, and a new one is made."
        )
    return token
