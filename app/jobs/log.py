"""The log of a run as a browser may see it: whole lines, without the insides of the program."""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from physhandi.data.run_folder import LOG

TAIL_BYTES = 20_000
"""Bytes of the end of a log that a page begins with."""
_PART_BYTES = 200_000
_TRACE = "Traceback (most recent call last):"
_BETWEEN = re.compile(
    r"(During handling of the above exception|The above exception was the direct cause)"
)
_FRAME = re.compile(r"\s|$")


@dataclass(frozen=True)
class LogPart:
    """A piece of a log."""

    text: str
    """Whole lines; a traceback is folded into the line that says what went wrong."""
    end: int
    """Byte position that the next piece begins at."""
    is_whole: bool
    """Whether it begins where it was asked to; a log that grew fast is cut short."""


def read_log(run_folder: Path, start: int | None = None, *, is_ended: bool = True) -> LogPart:
    """Read a log on from a position, as far as its lines are whole.

    Args:
        run_folder: The run.
        start: Byte position to begin at; None begins `TAIL_BYTES` before the end.
        is_ended: Whether nothing more will be written, so that the last line counts as whole.
    """
    stream = open_log(run_folder)
    if stream is None:
        return LogPart("", 0, is_whole=True)
    with stream:
        size = os.fstat(stream.fileno()).st_size
        limit = TAIL_BYTES if start is None else _PART_BYTES
        begin = max(0, size - limit) if start is None or size - start > limit else start
        begin = min(begin, size)
        stream.seek(begin)
        content = stream.read(size - begin)
    is_whole = begin == (0 if start is None else start)
    if not is_whole:
        first = content.find(b"\n") + 1
        content, begin = content[first:], begin + first
    if not is_ended:
        content = content[: _end_of_whole(content)]
    text = content.decode("utf-8", errors="replace")
    return LogPart("\n".join(_folded(text)), begin + len(content), is_whole)


def open_log(run_folder: Path) -> BinaryIO | None:
    """Open a log; a link that a job might have put there is not followed."""
    try:
        descriptor = os.open(run_folder / LOG, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    return os.fdopen(descriptor, "rb")


def level_of(line: str) -> str:
    """Tell how bad a line is: ``error``, ``warning`` or nothing."""
    level = re.match(r"\S+ \S+ (ERROR|CRITICAL|WARNING) ", line)
    if level:
        return "warning" if level[1] == "WARNING" else "error"
    return "error" if re.match(r"[A-Za-z_.]*(Error|Exception)\b", line) else ""


def _end_of_whole(content: bytes) -> int:
    """Find where the whole lines end; a traceback that is still being written is not whole."""
    end = content.rfind(b"\n") + 1
    trace = content.rfind(_TRACE.encode(), 0, end)
    if trace < 0:
        return end
    lines = content[trace:end].decode("utf-8", errors="replace").splitlines()[1:]
    is_over = any(not _FRAME.match(line) for line in lines)
    return end if is_over else content.rfind(b"\n", 0, trace) + 1


def _folded(text: str) -> Iterator[str]:
    """Leave the frames of tracebacks out; what they end with stays."""
    in_trace = False
    for line in text.split("\n"):
        if line.startswith(_TRACE):
            in_trace = True
        elif in_trace and _FRAME.match(line):
            continue
        elif not _BETWEEN.match(line):
            in_trace = False
            yield line
