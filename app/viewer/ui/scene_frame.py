"""viser's page with what our scenes need beside it."""

import gzip
from functools import cache
from pathlib import Path

import viser

from app.settings import WEB_ASSETS

_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
_END = "</head>"


@cache
def scene_page() -> bytes:
    """Read the page that shows scenes, with our own script in it."""
    return with_script(_PAGE.read_text(encoding="utf-8")).encode()


@cache
def packed_scene_page() -> bytes:
    """Compress that page by gzip, once for all that answer with it."""
    return gzip.compress(scene_page(), mtime=0)


def with_script(page: str) -> str:
    """Put our script into viser's page, whose scripts are within it as well."""
    script = (WEB_ASSETS / "scene_frame.js").read_text(encoding="utf-8")
    return page.replace(_END, f"<script>{script}</script>{_END}", 1)
