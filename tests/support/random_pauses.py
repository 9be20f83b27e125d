"""A pytest plugin that holds threads up at random, so that they meet in unusual ways.

It is used by ``make races``. What fails under it alone fails some day on a busy machine, too.
"""

import random
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

_APPLICATION = str(Path(__file__).resolve().parents[2] / "app")
_BENCHMARKS = f"{_APPLICATION}/benchmarks"


class Pauses:
    """Pauses, now and then, where a function of the application begins or ends."""

    def __init__(
        self, share: float, longest: float, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """Prepare; to be given to `sys.setprofile` and `threading.setprofile`.

        Args:
            share: Part of the beginnings and ends at which to pause.
            longest: The longest pause [s].
            sleep: Pauses.
        """
        self._share = share
        self._longest = longest
        self._sleep = sleep
        self._chance = random.Random()  # noqa: S311

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Hear of an event from the interpreter."""
        name = frame.f_code.co_filename
        # The client of the tests is a benchmark's, and is not what is tested.
        is_ours = name.startswith(_APPLICATION) and not name.startswith(_BENCHMARKS)
        if event in {"call", "return"} and is_ours and self._chance.random() < self._share:
            self._sleep(self._chance.random() * self._longest)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the pauses be chosen."""
    group = parser.getgroup("pauses")
    group.addoption("--pause-share", type=float, default=0.003, help="at how many calls to pause")
    group.addoption("--pause-longest", type=float, default=0.06, help="longest pause [s]")


def pytest_configure(config: pytest.Config) -> None:
    """Pause in all threads from now on."""
    share, longest = config.option.pause_share, config.option.pause_longest
    pauses = Pauses(float(share), float(longest))
    threading.setprofile(pauses)
    sys.setprofile(pauses)
    sys.setswitchinterval(1e-4)


def pytest_unconfigure() -> None:
    """Pause no more."""
    threading.setprofile(None)
    sys.setprofile(None)
