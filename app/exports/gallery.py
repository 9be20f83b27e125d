"""Galleries: folders of plain pages that show runs wherever files can be opened."""

import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.exports.files import request_of
from app.exports.making import make
from app.exports.shell import read_link
from app.jobs.catalog import Catalog
from app.jobs.views import RunSummary, summarize_run
from app.pages.render import fill
from app.previews.clip import clip_of_run
from physhandi.data.files import temporary_name, write_bytes, write_json
from physhandi.data.sequence_meta import safe_name
from physhandi.errors import UsageError
from physhandi.run import Run

GALLERY_FILE = "gallery.json"
"""File that marks a folder as a gallery and lists its contents."""
_INDEX, _PAGES, _PICTURES = "index.html", "runs", "pictures"
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data: blob:; "
    "worker-src blob: data:; base-uri 'none'; form-action 'none'"
)
_WAY_BACK = (
    '<a href="../index.html" style="position:fixed;right:12px;top:12px;z-index:1000;'
    "padding:6px 12px;border-radius:8px;background:#1d2733;color:#fff;text-decoration:none;"
    'font:14px/1.3 system-ui,sans-serif">← All results</a>'
)


@dataclass(frozen=True)
class _Card:
    """Entry of the index for a run."""

    name: str
    note: str
    pages: Mapping[str, str]
    """Address of the page of each of its sequences."""
    still: str
    moving: str
    summary: RunSummary


def write_gallery(
    runs: Sequence[Run],
    out: Path,
    catalog: Catalog,
    *,
    title: str = "Results",
    link: str = "",
    overwrite: bool = False,
    report: Callable[[str, int, int], None] = lambda _run, _done, _of: None,
) -> Path:
    """Write a folder with an index of runs and a page for each of their sequences.

    All pages hold what they show and ask no host for anything.

    Args:
        runs: Finished runs, in the order in which they are shown.
        out: Folder to make.
        catalog: Finds recordings that have moved.
        title: Heading of the index.
        link: Link of the viewer, or its part after the question mark: layers, colors, theme and
            camera of all pages.
        overwrite: Whether to replace a gallery that is there.
        report: Told the run, how many of its frames are finished, and of how many.

    Returns:
        The index.

    Raises:
        UsageError: If there is no run, the folder is in use, or a field of the link makes no sense.
        PhysHandiError: If a run is not finished or cannot be shown.
    """
    if not runs:
        raise UsageError("Name at least one run for the gallery.")
    query = dict(read_link(link))
    if "sequence" in query:
        raise UsageError("sequence: a gallery shows all sequences of its runs; leave it out.")
    _check_place(out, overwrite=overwrite)
    with _made_beside(out) as folder:
        (folder / _PAGES).mkdir()
        (folder / _PICTURES).mkdir()
        names = _file_names(runs)
        cards = [
            _write_run(run, name, folder, catalog, query, report=report)
            for run, name in zip(runs, names, strict=True)
        ]
        page = fill("gallery.html", title=title, cards=cards)
        write_bytes(folder / _INDEX, page.encode())
        about = {"title": title, "runs": [_describe(card) for card in cards]}
        write_json(folder / GALLERY_FILE, about)
    return out / _INDEX


def _check_place(out: Path, *, overwrite: bool) -> None:
    """Refuse to replace anything but a gallery, whatever was asked for."""
    if not (out.exists() or out.is_symlink()):
        return
    if not overwrite:
        raise UsageError(f"{out} exists already. Choose another folder, or give --overwrite.")
    if out.is_symlink() or not (out / GALLERY_FILE).is_file():
        raise UsageError(f"{out} is no gallery and is not replaced. Choose another folder.")


@contextmanager
def _made_beside(out: Path) -> Generator[Path]:
    """Give a folder to fill, which takes its place once all is written."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(temporary_name(out.name))
    temporary.mkdir()
    try:
        yield temporary
        if out.exists():
            shutil.rmtree(out)
        temporary.replace(out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _file_names(runs: Sequence[Run]) -> list[str]:
    """Name the files of each run after its id; runs of several data folders may share one."""
    names: list[str] = []
    for run in runs:
        base = safe_name(run.id)
        count, name = 1, base
        while name in names:
            count += 1
            name = f"{base}_{count}"
        names.append(name)
    return names


def _write_run(
    run: Run,
    name: str,
    folder: Path,
    catalog: Catalog,
    query: Mapping[str, str],
    *,
    report: Callable[[str, int, int], None],
) -> _Card:
    pages: dict[str, str] = {}
    for number, sequence in enumerate(run.sequence_names, 1):
        rel = f"{_PAGES}/{name}_{number}.html"
        order = request_of(catalog, run, "html", {**query, "sequence": sequence})
        make(order, folder / rel, lambda done, of: report(run.name, done, of))
        page = (folder / rel).read_text(encoding="utf-8")
        write_bytes(folder / rel, _for_gallery(page).encode())
        pages[sequence] = rel
    still, moving = f"{_PICTURES}/{name}.still.webp", f"{_PICTURES}/{name}.moving.webp"
    picture = clip_of_run(run.folder, is_still=True)
    clip = clip_of_run(run.folder)
    if picture is not None:
        picture.write_still(folder / still)
    if clip is not None:
        clip.write_moving(folder / moving)
    return _Card(
        name=run.name,
        note=run.note,
        pages=pages,
        still=still if picture is not None else "",
        moving=moving if clip is not None else "",
        summary=summarize_run(run),
    )


def _for_gallery(page: str) -> str:
    """Forbid a replay to ask any host for anything, and let it lead back to the index."""
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    page = page.replace("<head>", f"<head>{policy}", 1)
    return page.replace("<body>", f"<body>{_WAY_BACK}", 1)


def _describe(card: _Card) -> dict[str, Any]:
    return {
        "name": card.name,
        "pages": dict(card.pages),
        "track_error_fitted_m": card.summary.track_error_fitted,
        "track_error_predicted_m": card.summary.track_error_predicted,
        "reprojection_px": card.summary.reprojection,
    }
