"""viser's page with what our scenes need beside it."""

from pathlib import Path

import viser

from app.settings import WEB_ASSETS

_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
_END = "</head>"


def scene_page() -> bytes:
    """Read the page that shows scenes, with our own script in it."""
    return with_script(_PAGE.read_text(encoding="utf-8")).encode()


def with_script(page: str) -> str:
    """Put our script into viser's page, whose scripts are within it as well."""
    script = (WEB_ASSETS / "scene_frame.js").read_text(encoding="utf-8")
    return page.replace(_END, f"<script>{script}</script>{_END}", 1)
