"""How busy this machine is: processors, memory, disk, graphics cards, and what each run takes."""

import os
import threading
import time
from pathlib import Path
from typing import Any

import psutil

from app.jobs.cards import Cards
from app.jobs.processes import supervisor_of
from physhandi.data.environment import processor_name

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
        self._known: dict[int, psutil.Process] = {}
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
            found = self._family(supervisor)
            memory, busy = 0, 0.0
            for process in found:
                try:
                    memory += process.memory_info().rss
                    busy += process.cpu_percent() / 100.0
                except psutil.Error:
                    continue
            alive = {process.pid for process in found}
            gone = [pid for pid in self._known if not psutil.pid_exists(pid)]
            for pid in gone:
                del self._known[pid]
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
        return [self._known.setdefault(process.pid, process) for process in members]

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
