"""Exports from the command line."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from app.exports.files import request_of
from app.exports.making import make
from app.exports.permalink import state_from_query
from app.exports.request import SUFFIXES, FileRequest
from app.jobs.catalog import Catalog
from physhandi.data.exporters import FORMATS, export_run
from physhandi.errors import UsageError
from physhandi.run import Run


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What the command line asks for."""

    format: Any
    """Which kind of file."""
    out: Path
    """File or folder to write."""
    link: str = ""
    """Link of the viewer, or its part after the question mark."""
    sequence: str | None = None
    """Which sequence of the run; None for what the link says, else the first one."""
    frame: int | None = None
    """Which frame; None for what the link says."""
    width: int = 1280
    """Width of a picture [px]."""
    height: int = 720
    """Height of a picture [px]."""
    device: str = "cpu"
    """Warp device, if the link changes parameters."""
    overwrite: bool = False
    """Whether to replace what is there."""


def export(run: Run, wish: Wish, catalog: Catalog) -> Path:
    """Write a run as a file.

    Args:
        run: A finished run.
        wish: What is asked for.
        catalog: Finds recordings that have moved.

    Returns:
        What was written.

    Raises:
        UsageError: If a field of the link makes no sense, or the path is in use.
        PhysHandiError: If the file cannot be made.
    """
    query = dict(read_link(wish.link))
    if wish.sequence is not None:
        query["sequence"] = wish.sequence
    state = state_from_query(query)
    is_changed = bool(state.parameter_changes) or state.automatic_substeps
    if wish.format in FORMATS and not is_changed:
        return export_run(
            run,
            wish.format,
            wish.out,
            sequence=state.sequence_name,
            frame=wish.frame,
            overwrite=wish.overwrite,
        )
    if wish.format == "yaml":
        raise UsageError("yaml describes the run itself; leave changed parameters out of the link.")
    if wish.frame is not None and wish.format not in {"png", "zip"}:
        raise UsageError(
            f"A single frame can be exported as ply, png or zip, not as {wish.format}."
        )
    if wish.frame is not None:
        query["f"] = str(wish.frame)
    order = _order(run, wish, query, catalog)
    order.check()
    out = wish.out
    suffix = f".{SUFFIXES.get(wish.format, wish.format)}"
    if out.suffix != suffix:
        raise UsageError(f"{out} does not end in '{suffix}', as a file of {wish.format} does.")
    if out.is_dir() or (out.exists() and not wish.overwrite):
        raise UsageError(f"{out} exists already. Choose another path, or allow overwriting.")
    out.parent.mkdir(parents=True, exist_ok=True)
    make(order, out)
    return out


def read_link(text: str) -> Mapping[str, str]:
    """Read what comes after the question mark of a link, or is all of it.

    Raises:
        UsageError: If a field comes twice; names it.
    """
    query = urlsplit(text).query if "?" in text else text
    fields: dict[str, str] = {}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name in fields:
            raise UsageError(f"{name[:40]}: the link has this field twice.")
        if name != "token":
            fields[name] = value
    return fields


def _order(run: Run, wish: Wish, query: Mapping[str, str], catalog: Catalog) -> FileRequest:
    whole = request_of(catalog, run, wish.format, query)
    return FileRequest(
        kind="run",
        folder=str(run.folder.resolve()),
        format=wish.format,
        query=query,
        recordings=whole.recordings,
        width=wish.width,
        height=wish.height,
        device=wish.device,
        link=whole.link,
    )
