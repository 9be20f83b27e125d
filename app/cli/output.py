"""Output of commands: results as lines or JSON, and options that several commands share."""

import json
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from tyro.conf import UseAppendAction, arg

from physhandi.data.files import plain, without_non_finite

Item = TypeVar("Item")
Several = UseAppendAction[tuple[tuple[Item, ...], ...]]
"""Values of an option that takes several: all after one (``--click A B``), or each after one of its
own (``--click A --click B``). Of a plain tuple tyro would keep what follows the last one alone."""
DataDir = Annotated[
    Path | None,
    arg(help="Folder with `sequences/` and `runs/` (PHYSHANDI_DATA_DIR, else `data`)."),
]
Device = Annotated[str, arg(help="Warp device: auto, cpu, cuda or cuda:0.")]
Devices = Annotated[
    str,
    arg(help="Warp device: auto, cpu, cuda or cuda:0; several GPUs: all, or cuda:0,cuda:1."),
]
EngineChoice = Annotated[
    str | None,
    arg(
        help="Where it is computed: local, or ray://HOST:PORT, the address of the Jobs API of a "
        "Ray cluster (PHYSHANDI_ENGINE, else local; see docs/operations.md). There --device is "
        "auto, cpu or cuda."
    ),
]
Store = Annotated[
    str | None,
    arg(
        help="Address of a store, as fsspec understands it (s3://BUCKET/FOLDER, file:///FOLDER), "
        "where results are published, too (PHYSHANDI_STORE)."
    ),
]
AsJson = Annotated[bool, arg(name="json", help="Print JSON instead of lines.")]


def all_values(given: Several[Item], default: tuple[Item, ...] = ()) -> tuple[Item, ...]:
    """Give the values of an option in their order, however often it was given.

    Args:
        given: The values after each time that it was given.
        default: What it is if it was not given. Given without a value it has none.
    """
    return tuple(chain.from_iterable(given)) if given else default


def show(result: Mapping[str, Any], *, as_json: bool = False) -> None:
    """Print a result for people or, as JSON, for programs; NaN and infinity are null there."""
    if as_json:
        data = without_non_finite(plain(result))
        print(json.dumps(data, indent=2, ensure_ascii=False))
        return
    for line in lines(result):
        print(line)


def lines(result: Mapping[str, Any], indent: int = 0) -> Iterator[str]:
    """Lay nested results out for reading; what has no value is left out."""
    start = "  " * indent
    for key, value in result.items():
        if value is None:
            continue
        if isinstance(value, Mapping):
            below = list(lines(cast("Mapping[str, Any]", value), indent + 1))
            if below:
                yield f"{start}{key}:"
                yield from below
        elif isinstance(value, list | tuple):
            yield f"{start}{key}:"
            yield from (f"{start}  {_item(item)}" for item in cast("list[object]", value))
        else:
            yield f"{start}{key}: {f'{value:.6g}' if isinstance(value, float) else value}"


def _item(item: object) -> object:
    """Write fields of a listed item behind each other."""
    if not isinstance(item, Mapping):
        return item
    return ": ".join(str(value) for value in cast("Mapping[str, Any]", item).values())
