"""Graphics cards, as the driver's own tool `nvidia-smi` tells; without one there is none."""

import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Collection
from typing import Any

_KEPT_S = 2.0
"""How old an answer may be before the tool is asked again [s]."""
_PATIENCE_S = 10.0
"""The tool takes seconds where the driver sleeps between its calls [s]."""
_MEBIBYTE = 2**20
_FIELDS = ("index", "name", "utilization.gpu", "memory.used", "memory.total", "temperature.gpu")

Ask = Callable[[list[str]], str]
"""Calls the tool with arguments and gives what it prints; raises OSError if it fails."""


def ask_driver(arguments: list[str]) -> str:
    """Call `nvidia-smi`.

    Raises:
        OSError: If it is not there, fails or does not answer.
    """
    tool = shutil.which("nvidia-smi")
    if tool is None:
        raise FileNotFoundError("nvidia-smi")
    try:
        return subprocess.run(
            [tool, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=True,
        ).stdout
    except subprocess.SubprocessError as error:
        raise OSError(str(error)) from error


class Cards:
    """Knows what graphics cards do; asked in a thread of its own, so that nobody waits for it."""

    def __init__(self, ask: Ask = ask_driver) -> None:
        """Prepare; nothing is asked yet."""
        self._ask = ask
        self._lock = threading.Lock()
        self._asking = False
        self._time: float | None = None
        self._cards: list[dict[str, Any]] = []
        self._by_process: dict[int, int] = {}

    def read(self) -> list[dict[str, Any]]:
        """Give what was found last, and see to it that it is not old the next time.

        Returns:
            For each card ``index name share memory memory_total temperature``: the share of time
            that it worked, bytes, and degrees Celsius; none where it does not tell.
        """
        with self._lock:
            is_old = self._time is None or time.monotonic() - self._time > _KEPT_S
            if is_old and not self._asking:
                self._asking = True
                threading.Thread(target=self.refresh, name="cards", daemon=True).start()
            return self._cards

    def memory_of(self, pids: Collection[int]) -> int | None:
        """Give the memory of graphics cards that processes hold [bytes]; none without a card."""
        with self._lock:
            if not self._cards:
                return None
            return sum(self._by_process.get(pid, 0) for pid in pids)

    def refresh(self) -> None:
        """Ask the tool now."""
        cards: list[dict[str, Any]] = []
        held: dict[int, int] = {}
        try:
            cards = [
                {
                    "index": int(values[0]),
                    "name": values[1],
                    "share": _scaled(values[2], 0.01),
                    "memory": _scaled(values[3], _MEBIBYTE),
                    "memory_total": _scaled(values[4], _MEBIBYTE),
                    "temperature": _scaled(values[5], 1.0),
                }
                for values in self._table(f"--query-gpu={','.join(_FIELDS)}", len(_FIELDS))
            ]
            for pid, memory in self._table("--query-compute-apps=pid,used_memory", 2):
                held[int(pid)] = held.get(int(pid), 0) + int(_scaled(memory, _MEBIBYTE) or 0)
        except (OSError, ValueError):
            cards = []  # There is no card, or its driver does not answer.
        with self._lock:
            self._cards, self._by_process = cards, held
            self._time, self._asking = time.monotonic(), False

    def _table(self, query: str, width: int) -> list[list[str]]:
        text = self._ask([query, "--format=csv,noheader,nounits"])
        rows = [[cell.strip() for cell in line.split(",")] for line in text.splitlines()]
        return [row for row in rows if len(row) == width]


def _scaled(text: str, factor: float) -> float | None:
    """Read a number; none for ``[N/A]`` and the like."""
    try:
        return float(text) * factor
    except ValueError:
        return None
