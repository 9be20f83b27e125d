"""Applications of which each takes over what checks the same parameters from those before it.

A server makes one application; tests make hundreds in a process, and half of the time that takes
goes into what checks the parameters of routes, of which most are never asked for.
"""

from typing import Any, get_args

import fastapi._compat.v2 as fields
from pydantic import TypeAdapter

_adapters: dict[tuple[Any, str], TypeAdapter[Any]] = {}


def _shared_adapter(checked: Any, *, config: Any = None) -> TypeAdapter[Any]:
    """Give what checks a type within some limits, of which it knows nothing but these."""
    type_, *limits = get_args(checked)
    key = type_, repr((limits, config))
    if key not in _adapters:
        _adapters[key] = TypeAdapter(checked, config=config)
    return _adapters[key]


def share_checks() -> None:
    """Have all applications of this process share what checks their parameters."""
    fields.TypeAdapter = _shared_adapter
