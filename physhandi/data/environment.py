"""Environment of a computation: device, versions and the state of the source."""

import os
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from physhandi.data.run_folder import now
from physhandi.devices import processor_name

ENVIRONMENT = "environment.json"
_PACKAGES = ("physhandi", "warp-lang", "torch", "numpy", "scipy")
_SOURCE = Path(__file__).resolve().parents[2]


def describe_environment(device: str, device_name: str = "") -> dict[str, Any]:
    """Describe the program and the machine that this process runs on.

    Args:
        device: Warp device, for example ``"cuda:0"``.
        device_name: What the device calls itself; a processor is asked here.

    Returns:
        ``started`` (the time now), ``device``, ``device_name``, ``cpu_count``, ``system``,
        ``python``, ``packages`` (name and version of those installed) and ``commit`` of the
        checkout; none outside of one.
    """
    return {
        "started": now(),
        "device": device,
        "device_name": processor_name() if device == "cpu" else device_name,
        "cpu_count": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": dict(_installed()),
        "commit": commit_of(_SOURCE),
    }


@cache
def _installed() -> dict[str, str]:
    """Versions of the packages that figures depend on, as they were when this process began."""
    versions: dict[str, str] = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def commit_of(checkout: Path) -> str | None:
    """Read which commit a git checkout stands at, without git; None if it is no checkout."""
    folder = checkout / ".git"
    try:
        head = (folder / "HEAD").read_text(encoding="ascii").strip()
        if not head.startswith("ref: "):
            return head
        reference = head.removeprefix("ref: ")
        if (folder / reference).is_file():
            return (folder / reference).read_text(encoding="ascii").strip()
        for line in (folder / "packed-refs").read_text(encoding="ascii").splitlines():
            commit, _, name = line.partition(" ")
            if name == reference:
                return commit
    except (OSError, ValueError):
        return None
    return None
