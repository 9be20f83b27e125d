"""Wording of what pydantic finds wrong with settings, requests and stored files."""

from collections.abc import Iterable
from typing import Any


def wrong_fields(errors: Iterable[Any]) -> list[tuple[str, str]]:
    """Name each wrong field, its parts joined by dots, and say what is wrong with it.

    Args:
        errors: What ``errors()`` of a `ValidationError` or FastAPI's of requests gives.

    Returns:
        At least one pair; a field is empty if it is several together that are wrong.
    """
    # pydantic begins with the class of what a validator of ours raises.
    return [
        (".".join(map(str, entry["loc"])), str(entry["msg"]).removeprefix("Value error, "))
        for entry in errors
    ]
