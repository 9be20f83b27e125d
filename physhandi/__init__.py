"""Hands and spring-mass objects from sparse-view RGB-D video (docs/python.md)."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from physhandi.api import check as check
    from physhandi.api import load as load
    from physhandi.api import open_run as open_run
    from physhandi.api import reconstruct as reconstruct
    from physhandi.api import simulate as simulate
    from physhandi.data.sequence import Sequence as Sequence
    from physhandi.run import Run as Run

__version__ = "0.1.0"
_PLACES = {
    "check": "api",
    "load": "api",
    "open_run": "api",
    "reconstruct": "api",
    "simulate": "api",
    "Sequence": "data.sequence",
    "Run": "run",
}
__all__ = [
    "Run",
    "Sequence",
    "__version__",
    "check",
    "load",
    "open_run",
    "reconstruct",
    "simulate",
]


def __getattr__(name: str) -> object:
    """Import what is asked for when it is first asked for: simulators take seconds to load."""
    if name not in _PLACES:
        raise AttributeError(f"module 'physhandi' has no attribute '{name}'")
    value = getattr(import_module(f"physhandi.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
