"""How a session's page looks: its theme, and what the colors of the scene mean."""

import viser

from app.viewer.content import Content
from app.viewer.layers import BLUE, GREEN, GREY, RED, SKIN, YELLOW
from app.viewer.observed import DepthCloud


def set_theme(server: viser.ViserServer, *, dark: bool) -> None:
    """Dress the page."""
    server.gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, brand_color=(36, 99, 203)
    )


def add_legend(server: viser.ViserServer, content: Content) -> None:
    """Tell what the colors mean."""
    entries: list[tuple[tuple[int, int, int], str]] = []
    if content.hands or content.skeletons:
        entries.append((SKIN["right"], "hand"))
    controls = "control points" if content.hands or content.markers is None else "grippers"
    if content.fitted is not None:
        entries += [(BLUE, "object"), (RED, "controls, forces"), (YELLOW, "virtual springs")]
    elif content.control is not None:
        entries.append((RED, controls))
    if content.observed is not None and not isinstance(content.observed, DepthCloud):
        is_marked = content.markers is not None or (
            content.tracks is not None and content.tracks.node is not None
        )
        entries.append((GREEN, "markers" if is_marked else "observed"))
    if content.views:
        entries.append((GREY, "cameras"))
    dots = "".join(
        '<span style="white-space:nowrap;margin-right:0.8em">'
        f'<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:50%;'
        f'background:rgb{color};margin-right:0.35em"></span>{label}</span>'
        for color, label in entries
    )
    server.gui.add_html(f'<div style="font-size:0.8em;padding:0.2em 0.9em 0.5em">{dots}</div>')
