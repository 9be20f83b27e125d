"""Damage to the small files of a folder, by types and structure as well as by bytes.

Who chooses is given: a seeded random generator, or hypothesis.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
Choose = Callable[[Sequence[Any]], Any]
"""Gives one of several."""

WRONG = (
    *(None, True, False, 0, -1, 1, 7, 2**31, 2**63, 2**64, -(2**70), 10**400, 0.5, -1e308, 1e308),
    *("", "x", "a\0b", "..", "../../x", "/", "\u202e", "²", "2026-13-99", "9" * 30, "é" * 300),
    *([], [1], [[]], [None], ["a", 2], {}, {"a": {}}, {"": 1}, {"name": [1]}, [{}], [[1, 2], [3]]),
)
"""Values that belong nowhere, or in few places."""
ODD_YAML = ("!!binary aGk=", "2026-01-01", ".nan", "-.inf", "!!set {a}", "{1: 2}", "&a [*a]")
"""What YAML has and JSON has not."""
BYTES = (
    *(b"", b"\xff\xfe", b"\0", b"null", b"7", b"[]", b"{}", b'"x"', b"[" * 3000, b"{" * 500),
    *(b"[" * 400 + b"]" * 400, b'{"a":' * 200 + b"1" + b"}" * 200, b"NaN", b"1e999", b"9" * 5000),
    *("²".encode(), b"- [\n", b"a: b: c", b"\t", b"%", b"a: &a\n  b: *a\n", b"<b>&amp;"),
)
"""What is no file of ours at all."""


def places(content: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Walk through all places of nested lists and fields."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        yield (*at, key)
        if isinstance(value, list | dict):
            yield from places(value, (*at, key))


def damage_content(content: Any, choose: Choose) -> Any:
    """Give one place of plain data another value or name, take it away, or wrap it."""
    content = json.loads(json.dumps(content))
    found = list(places(content)) if isinstance(content, list | dict) else []
    if not found:
        return choose(WRONG)
    place = choose(found)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    deed = choose(("replace", "replace", "replace", "remove", "wrap", "deepen", "rename", "double"))
    if deed == "replace":
        inner[place[-1]] = choose(WRONG)
    elif deed == "remove":
        del inner[place[-1]]
    elif deed == "wrap":
        inner[place[-1]] = choose(([inner[place[-1]]], {"a": inner[place[-1]]}))
    elif deed == "deepen":
        for _ in range(choose((3, 99, 150))):
            inner[place[-1]] = [inner[place[-1]]]
    elif isinstance(inner, dict):
        inner[choose(("x", "", "..", "a/b", "sheet"))] = inner[place[-1]]
        if deed == "rename":
            del inner[place[-1]]
    else:
        inner.append(choose(WRONG))
    return content


def damage_file(path: Path, choose: Choose) -> None:
    """Damage a file in place."""
    original = path.read_bytes()
    deed = choose(("structure",) * 7 + ("bytes", "cut", "odd"))
    is_yaml, is_json = path.suffix == ".yaml", path.suffix == ".json"
    if deed == "structure" and (is_yaml or is_json):
        content = yaml.load(original, _Loader) if is_yaml else json.loads(original)  # noqa: S506
        content = damage_content(content, choose)
        path.write_text(yaml.dump(content, Dumper=_Dumper) if is_yaml else json.dumps(content))
    elif deed == "structure" and path.suffix == ".jsonl":
        lines = original.splitlines()
        number = choose(range(len(lines)))
        lines[number] = json.dumps(damage_content(json.loads(lines[number]), choose)).encode()
        path.write_bytes(b"\n".join(lines) + b"\n")
    elif deed == "structure" and path.suffix == ".csv":
        rows = [line.split(",") for line in original.decode().splitlines()]
        row = choose(rows)
        row[choose(range(len(row)))] = str(choose((*WRONG, "x" * 200_000, '"', "nan", "-inf")))
        path.write_text("\n".join(",".join(row) for row in rows))
    elif deed == "odd" and is_yaml:
        lines = original.decode().splitlines()
        number = choose(range(len(lines)))
        lines[number] = lines[number].partition(":")[0] + ": " + choose(ODD_YAML)
        path.write_text("\n".join(lines) + "\n")
    elif deed == "cut" and original:
        path.write_bytes(original[: choose(range(len(original)))])
    else:
        path.write_bytes(choose(BYTES))
