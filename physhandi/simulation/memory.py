"""How much memory a device has left."""

from pathlib import Path
from typing import Any

_CGROUP = Path("/sys/fs/cgroup")
_FILES = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    (
        "memory/memory.limit_in_bytes",
        "memory/memory.usage_in_bytes",
        "memory/memory.stat",
        "total_inactive_file",
    ),
)
"""Limit, use, statistics and the name of what could be dropped at once, of cgroups 2 and 1."""


def free_memory(device: Any) -> int:
    """Return how much memory a Warp device has left [B], to this process's container if in one."""
    if device.is_cuda:
        return int(device.free_memory)
    # A machine with a GPU can do without it.
    import psutil

    left = int(psutil.virtual_memory().available)
    within = container_memory(_CGROUP)
    return left if within is None else min(left, within)


def container_memory(folder: Path) -> int | None:
    """Return how much memory a container has left [B]; none if it has no limit.

    Args:
        folder: Where its control groups are told of.
    """
    for limit, used, statistics, droppable in _FILES:
        try:
            told = (folder / limit).read_text().strip()
            if told == "max":
                return None
            fields = dict(line.split() for line in (folder / statistics).read_text().splitlines())
            use = int((folder / used).read_text()) - int(fields.get(droppable, 0))
            return max(0, int(told) - use)
        except FileNotFoundError:
            continue
    return None
