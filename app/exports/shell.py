"""Exports from the command line."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from app.exports.files import request_of
from app.exports.making import Report, carried_splats, make, surface_of
from app.exports.permalink import state_from_query
from app.exports.request import Beside
from app.jobs.catalog import Catalog
from app.viewer.content.camera_path import read_camera_path
from physhandi.data.exporters import FORMATS, PLY, export_run
from physhandi.errors import UsageError
from physhandi.run import Run


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export from the command line."""

    format: Any
    """Format of the file."""
    out: Path
    """File or folder to write."""
    link: str = ""
    """Link of the viewer, or its part after the question mark."""
    sequence: str | None = None
    """Sequence of the run; None for that of the link, else the first one."""
    frame: int | None = None
    """Frame; None for that of the link."""
    width: int = 1280
    """Width of a picture [px]."""
    height: int = 720
    """Height of a picture [px]."""
    turn: float = 0.0
    """Angle by which the camera of a film goes round [degrees]."""
    camera_path: Path | None = None
    """File that tells how the camera of a film moves."""
    view: str = ""
    """Camera of the recording from which a film is taken."""
    beside: Beside | None = None
    """Picture beside such a film."""
    device: str = "cpu"
    """Warp device, if the link changes parameters."""
    overwrite: bool = False
    """Whether to replace what is there."""


def export(
    run: Run,
    options: ExportOptions,
    catalog: Catalog,
    report: Report = lambda _done, _of: None,
) -> Path:
    """Write a run as a file.

    Args:
        run: A finished run.
        options: What is asked for.
        catalog: Finds recordings that have moved.
        report: Told how many frames are finished, and of how many.

    Returns:
        What was written.

    Raises:
        UsageError: If a field of the link makes no sense, or the path is in use.
        PhysHandiError: If the file cannot be made.
    """
    query = dict(read_link(options.link))
    if options.sequence is not None:
        query["sequence"] = options.sequence
    if options.frame is not None and options.format in {"png", "zip"}:
        query["f"] = str(options.frame)
    state = state_from_query(query)
    order = replace(
        request_of(catalog, run, options.format, query),
        folder=str(run.folder.resolve()),
        frame=options.frame if options.format in PLY else None,
        width=options.width,
        height=options.height,
        turn=options.turn,
        camera_path=_path_text(options.camera_path),
        view=options.view,
        beside=options.beside,
        device=options.device,
    )
    if options.format in FORMATS and not state.is_changed:
        return export_run(
            run,
            options.format,
            options.out,
            sequence=state.sequence_name,
            frame=options.frame,
            overwrite=options.overwrite,
            surface=partial(surface_of, order),
            carry=carried_splats,
        )
    if options.frame is not None and options.format not in {*PLY, "png", "zip"}:
        raise UsageError(
            f"A single frame can be exported as ply, splat-ply, png or zip, not as "
            f"{options.format}."
        )
    order.check()
    out = options.out
    suffix = f".{order.suffix}"
    if out.suffix != suffix:
        raise UsageError(f"{out} does not end in '{suffix}', as a file of {options.format} does.")
    if out.is_dir() or (out.exists() and not options.overwrite):
        raise UsageError(f"{out} exists already. Choose another path, or give --overwrite.")
    out.parent.mkdir(parents=True, exist_ok=True)
    make(order, out, report)
    return out


def _path_text(path: Path | None) -> str:
    """Read a camera path, and refuse one that makes no sense by its file's name."""
    if path is None:
        return ""
    read_camera_path(path)
    return path.read_text(encoding="utf-8")


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
