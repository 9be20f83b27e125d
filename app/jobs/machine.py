"""Load of this machine: processors, memory, disk, graphics cards, and the share of each run."""

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import psutil

from app.jobs.processes import supervisor_of
from physhandi.devices import processor_name

_CARDS_KEPT_S = 2.0
"""Age at which an answer of the tool is renewed [s]."""
_PATIENCE_S = 10.0
"""The tool takes seconds where the driver sleeps between its calls [s]."""
_MEBIBYTE = 2**20
_FIELDS = (
    *("index", "name", "utilization.gpu", "memory.used", "memory.total", "temperature.gpu"),
    "uuid",
)

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
            For each card ``index name share memory memory_total temperature uuid``: the share of
            time that it worked, bytes, and degrees Celsius; none where it does not tell.
        """
        with self._lock:
            is_old = self._time is None or time.monotonic() - self._time > _CARDS_KEPT_S
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

    def free_memory(self, uuid: str) -> float | None:
        """Give the free memory of a graphics card as it was found last [bytes]; none if unknown."""
        for card in self.read():
            if card["uuid"] == uuid and None not in (card["memory"], card["memory_total"]):
                return card["memory_total"] - card["memory"]
        return None

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
                    "uuid": values[6],
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


_KEPT_S = 1.0
"""Looking takes milliseconds, so however many pages ask, it is done once in this time [s]."""


class Machine:
    """Measures the load of this machine when somebody asks; safe to use from several threads."""

    def __init__(self, data_dir: Path, cards: Cards | None = None) -> None:
        """Prepare; nothing is measured yet.

        Args:
            data_dir: Folder whose disk is measured.
            cards: Knows the graphics cards; none asks the driver's own tool.
        """
        self._data_dir = data_dir
        self._cards = cards or Cards()
        self._lock = threading.Lock()
        self._time = -_KEPT_S
        self._load: dict[str, Any] = {}
        self._processes: dict[int, psutil.Process] = {}
        self._processor = processor_name()
        psutil.cpu_percent()  # The first call only starts the clock.

    def load(self) -> dict[str, Any]:
        """Tell how busy the machine is.

        Returns:
            ``processor`` (``name count share load``), ``memory`` and ``disk`` (``used total`` in
            bytes, ``share``) and ``cards``, one for each graphics card (see `Cards.read`). Shares
            are from 0 to 1.
        """
        with self._lock:
            if time.monotonic() - self._time >= _KEPT_S:
                self._time = time.monotonic()
                self._load = self._measure()
            return self._load

    def of_run(self, folder: Path) -> dict[str, Any] | None:
        """Tell what the processes of a run take.

        Args:
            folder: The run.

        Returns:
            ``memory`` in bytes, ``processors`` (how many it keeps busy), ``card_memory`` in bytes
            (none without a graphics card) and ``processes``; none if nothing of it runs.
        """
        supervisor = supervisor_of(folder)
        if not supervisor:
            return None
        with self._lock:
            family = self._family(supervisor)
            memory, busy = 0, 0.0
            for process in family:
                try:
                    memory += process.memory_info().rss
                    busy += process.cpu_percent() / 100.0
                except psutil.Error:
                    continue
            alive = {process.pid for process in family}
            gone = [pid for pid in self._processes if not psutil.pid_exists(pid)]
            for pid in gone:
                del self._processes[pid]
        taken = self._cards.memory_of(alive)
        return {
            "memory": memory,
            "processors": round(busy, 2),
            "card_memory": taken,
            "processes": len(alive),
        }

    def _family(self, supervisor: int) -> list[psutil.Process]:
        """Find a supervisor's processes; the same objects as before, which know their last time."""
        try:
            root = psutil.Process(supervisor)
            members = [root, *root.children(recursive=True)]
        except psutil.Error:
            return []
        return [self._processes.setdefault(process.pid, process) for process in members]

    def _measure(self) -> dict[str, Any]:
        memory = psutil.virtual_memory()
        folder = self._data_dir if self._data_dir.exists() else self._data_dir.parent
        disk = psutil.disk_usage(str(folder))
        used = memory.total - memory.available
        return {
            "processor": {
                "name": self._processor,
                "count": os.cpu_count() or 1,
                "share": round(psutil.cpu_percent() / 100.0, 3),
                "load": round(os.getloadavg()[0], 2),
            },
            "memory": {
                "used": used,
                "total": memory.total,
                "share": round(used / memory.total, 3),
            },
            "disk": {
                "used": disk.total - disk.free,
                "free": disk.free,
                "total": disk.total,
                "share": round(1.0 - disk.free / disk.total, 3),
            },
            "cards": self._cards.read(),
        }
