"""Applications of which each takes over what checks the same parameters from those before it.

A server makes one application; tests make hundreds in a process, and nearly all of the time that
takes goes into studying the parameters of routes, of which most are never asked for.
"""

from types import CodeType
from typing import Any, get_args

import fastapi._compat.v2 as fields
from fastapi.routing import APIRoute
from pydantic import TypeAdapter

_adapters: dict[tuple[Any, str], TypeAdapter[Any]] = {}
_first: dict[tuple[CodeType, str], tuple[dict[str, Any], dict[str, Any]]] = {}
_init, _handle = APIRoute.__init__, APIRoute.handle


def _shared_adapter(checked: Any, *, config: Any = None) -> TypeAdapter[Any]:
    """Give what checks a type within some limits, of which it knows nothing but these."""
    type_, *limits = get_args(checked)
    key = type_, repr((limits, config))
    if key not in _adapters:
        _adapters[key] = TypeAdapter(checked, config=config)
    return _adapters[key]


def _init_by_first(route: APIRoute, path: str, endpoint: Any, **options: Any) -> None:
    """Describe a route as the first one of the same code and options, until it is asked for."""
    key = getattr(endpoint, "__code__", None), path
    if key[0] is None or hasattr(endpoint, "__wrapped__"):
        _init(route, path, endpoint, **options)
    elif key in _first and _first[key][0] == options:
        vars(route).update(_first[key][1], endpoint=endpoint, unstudied=options)
    else:
        _init(route, path, endpoint, **options)
        _first[key] = options, vars(route).copy()


async def _handle_by_own(route: APIRoute, scope: Any, receive: Any, send: Any) -> None:
    """Answer by the function of the application that was asked, which FastAPI studies first."""
    options = vars(route).pop("unstudied", None)
    if options is not None:
        _init(route, route.path, route.endpoint, **options)
    await _handle(route, scope, receive, send)


def share_checks() -> None:
    """Have all applications of this process share what checks their parameters."""
    fields.TypeAdapter = _shared_adapter
    APIRoute.__init__ = _init_by_first
    APIRoute.handle = _handle_by_own
