"""Launches that are captured as a graph and replayed."""

from collections.abc import Callable
from typing import Any

import warp as wp


class Recording:
    """What a function launches, captured on first use and when told that arrays have moved."""

    def __init__(self, launches: Callable[[], None], device: Any) -> None:
        """Remember what to capture.

        Args:
            launches: Launches kernels, without waiting for them.
            device: Warp device that they run on.
        """
        self._launches = launches
        self._device = device
        self._version: int | None = None
        self.graph: wp.Graph | None = None

    def replay(self, version: int = 0) -> None:
        """Run the launches.

        Args:
            version: Of the arrays that they use; if it is another one than last time, the
                launches are captured again.
        """
        if self.graph is None or version != self._version:
            with wp.ScopedCapture(device=self._device, force_module_load=True) as capture:
                self._launches()
            if capture.graph is None:
                raise RuntimeError(f"Warp captured no graph on {self._device}.")
            self.graph, self._version = capture.graph, version
        wp.capture_launch(self.graph)
