"""The tabs of a scene's panel."""

import threading
from typing import Literal

import viser

TabName = Literal["Play", "Look", "Physics", "Edit", "Steer", "Inspect", "Export"]

_BELOW = 1e9
"""Order of the tabs: below the clock, which is seen with all of them."""


class Tabs:
    """Tabs below everything else in the panel; each is filled by those who know its things.

    Which one is open is known to the browser alone: web_assets/scene.js opens the first, and one
    that is asked for here.
    """

    def __init__(self, gui: viser.GuiApi, *names: TabName) -> None:
        """Add the tabs.

        Args:
            gui: Where to.
            names: The tabs in their order.
        """
        self._wish = gui.add_html("")
        self._wish_count = 0
        self._lock = threading.Lock()
        group = gui.add_tab_group(order=_BELOW)
        self._tabs = {name: group.add_tab(name) for name in names}

    def __getitem__(self, name: TabName) -> viser.GuiTabHandle:
        """Give the tab to fill: a context in which controls are added."""
        return self._tabs[name]

    def open(self, name: TabName) -> None:
        """Open a tab, because what a user asked for is there."""
        with self._lock:
            self._wish_count += 1
            self._wish.content = f'<i hidden data-tab="{name}" data-wish="{self._wish_count}"></i>'
