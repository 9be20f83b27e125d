"""What axe-core finds on a page that keeps people from using it."""

import json
from typing import Any

from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Frame, Page

COLOR_RULES = ("color-contrast", "link-in-text-block")
"""What axe looks for in colors: all that another color scheme can violate."""
_GRAVE = {"serious", "critical"}
_SPARED = {"selectors": False, "preload": False}
"""Nobody reads selectors of what is found; there are no sounds, which are loaded beforehand."""
_RUN = "options => axe.run(options)"


def violations(page: Page | Frame, *rules: str) -> list[str]:
    """Name the serious and critical violations on a page, and where they are.

    Args:
        page: What is looked at, without frames in it.
        rules: Names of axe's rules; none for all of them.
    """
    options: dict[str, Any] = {"resultTypes": ["violations"], "iframes": False} | _SPARED
    if rules:
        options["runOnly"] = list(rules)
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE_SCRIPT)
    return [
        f"{found['id']}: {place['html'][:160]} {json.dumps(place['any'][:1])[:240]}"
        for found in page.evaluate(_RUN, options)["violations"]
        if found["impact"] in _GRAVE
        for place in found["nodes"]
    ]
