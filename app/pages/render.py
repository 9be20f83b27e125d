"""Filling templates, and how numbers, names and times are written on pages."""

from collections.abc import Iterable
from functools import cache
from typing import Any
from urllib.parse import urlencode

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from app.jobs.log import level_of
from app.keys import KEYS
from app.security import READ_ONLY
from app.settings import WEB_ASSETS

_SPELLINGS = {
    "l1": "L1",
    "l2": "L2",
    "f1": "F1",
    "iou": "IoU",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "rrd": "RRD",
    "mpjpe": "MPJPE",
    "phystwin": "PhysTwin",
    "5mm": "5 mm",
    "10mm": "10 mm",
}
_TITLES = {
    400: "The server cannot answer this",
    404: "Nothing is here",
    409: "That does not work now",
    422: "That is not possible",
    429: "Too much at once",
    500: "Something went wrong",
}


@cache
def _environment() -> Environment:
    """The templates, each of which is compiled when it is first shown, once in a process."""
    environment: Any = Environment(
        loader=FileSystemLoader(WEB_ASSETS / "templates"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        short=short,
        words=words,
        duration=duration,
        about=about,
        level=level_of,
        millimetres=millimetres,
        query=query,
    )
    environment.globals.update(key_groups=KEYS, only_looks=READ_ONLY)
    return environment


def fill(name: str, **values: Any) -> str:
    """Fill a template; everything a user wrote is escaped."""
    return _environment().get_template(name).render(values)


class Pages:
    """Renders the pages of the application."""

    def render(
        self, request: Request, name: str, *, status: int = 200, **values: Any
    ) -> HTMLResponse:
        """Fill a template for who asks.

        Args:
            request: Who asks.
            name: File of the template.
            status: HTTP status.
            values: What the template needs.
        """
        values["root_path"] = request.app.state.root_path
        values["may_change"] = getattr(request.state, "may_change", False)
        return HTMLResponse(fill(name, **values), status_code=status)

    def error(self, request: Request, status: int, message: str) -> HTMLResponse:
        """Show an error in the frame of the application."""
        title = _TITLES.get(status, "That did not work")
        return self.render(
            request, "error.html", status=status, code=status, title=title, message=message
        )


def short(value: Any) -> str:
    """Show a number with about four digits, anything else as it is."""
    if value is None:
        return "none"
    if not isinstance(value, float):
        return str(value)
    size = abs(value)
    if 1e3 <= size < 1e7:
        return f"{value:.0f}"
    return f"{value:.3e}".replace("e-0", "e-") if 0 < size < 1e-3 else f"{value:.4g}"


def words(value: Any) -> str:
    """Show a name of the program as words, short forms as they are usually written."""
    return " ".join(_SPELLINGS.get(part, part) for part in str(value).replace("_", " ").split(" "))


def millimetres(metres: Any) -> str:
    """Show a length of a list, in which the column names the unit."""
    if metres is None:
        return "–"  # noqa: RUF001  # a dash, as tables have it
    value = metres * 1000.0
    return f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"


def query(values: Iterable[str], name: str) -> str:
    """Write the part of an address that gives one field several values."""
    return urlencode([(name, value) for value in values])


def duration(seconds: Any) -> str:
    """Show a time that is left or was taken."""
    if seconds is None:
        return ""
    if 0 < seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    if minutes and not rest:
        return f"{minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def about(seconds: float) -> str:
    """Show a time that is only estimated, in steps that promise no more than is known."""
    if seconds < 5:
        return "a few seconds"
    step = 5 if seconds < 60 else 10 if seconds < 600 else 60
    rounded = max(step, round(seconds / step) * step)
    return f"about {rounded} s" if rounded < 60 else f"about {duration(rounded)}"
