"""The tables of docs/command-line.md, made of the commands themselves.

``PYTHONPATH=. python tests/command_line_page.py`` writes them anew.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from docstring_parser import parse
from tyro.extras import SubcommandApp

from app.cli import build
from app.cli.runs import Changes

PAGE = Path(__file__).parents[1] / "docs" / "command-line.md"
BEGIN, END = "<!-- commands: begin -->\n", "<!-- commands: end -->\n"


def commands(app: SubcommandApp, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Callable]]:
    for name, spec in app._subcommands.items():
        if isinstance(spec.target, SubcommandApp):
            yield from commands(spec.target, (*words, name))
        else:
            yield " ".join((*words, name)), spec.target


def named(hint: Any) -> tuple[str, str]:
    """The name and help that an annotation gives an option."""
    if get_origin(hint) is Annotated:
        for note in hint.__metadata__:
            if getattr(note, "name", None) or getattr(note, "help", None):
                return note.name or "", note.help or ""
        return named(get_args(hint)[0])
    return "", ""


def is_positional(hint: Any) -> bool:
    return "Positional" in repr(hint) or "POSITIONAL" in repr(hint).upper()


def bare(hint: Any) -> Any:
    return bare(get_args(hint)[0]) if get_origin(hint) is Annotated else hint


def kind_of(hint: Any) -> str:
    hint = bare(hint)
    if get_origin(hint) is Literal:
        return " ".join(map(str, get_args(hint)))
    if get_origin(hint) in {typing.Union, types.UnionType}:
        parts = [kind_of(part) for part in get_args(hint) if part is not type(None)]
        return " or ".join(parts)
    if get_origin(hint) is tuple:
        return f"{kind_of(get_args(hint)[0]).removesuffix(' …')} …"
    names = {str: "text", int: "whole number", float: "number", bool: "switch", Path: "path"}
    return names[hint]


def told_default(hint: Any) -> str:
    """What help says in the place of a default that the signature does not hold."""
    notes = hint.__metadata__ if get_origin(hint) is Annotated else ()
    told = (getattr(note, "help_behavior_hint", None) or "" for note in notes)
    return "".join(re.findall(r"^\(default: (.+)\)$", "".join(told)))


def default_of(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return "required"
    if value is None or value in {"", ()}:
        return ""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def rows(function: Callable) -> Iterator[tuple[str, str, str, str]]:
    hints = get_type_hints(function, include_extras=True)
    about = {item.arg_name: item.description or "" for item in parse(function.__doc__ or "").params}
    for name, parameter in inspect.signature(function).parameters.items():
        hint = hints[name]
        if bare(hint) is Changes:
            for field in dataclasses.fields(Changes):
                yield option(field.name, field.type, field.default, "")
        else:
            yield option(name, hint, parameter.default, about.get(name, ""))


def option(name: str, hint: Any, default: Any, about: str) -> tuple[str, str, str, str]:
    given, explained = named(hint)
    shown = (given or name.rstrip("_")).replace("_", "-")
    text = re.sub(r"\s+", " ", about or explained).replace("|", "\\|")
    return (
        shown.upper() if is_positional(hint) else f"`--{shown}`",
        kind_of(hint),
        default_of(default) or told_default(hint),
        text,
    )


def tables() -> str:
    lines = []
    for name, function in commands(build()):
        first = re.sub(r"\s+", " ", parse(function.__doc__ or "").short_description or "")
        lines += [
            f"### `physhandi {name}`",
            first,
            "",
            "| | takes | default | |",
            "|---|---|---|---|",
        ]
        lines += [f"| {' | '.join(row)} |" for row in rows(function)]
        lines.append("")
    return "\n".join(lines)


def page() -> str:
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    return before + BEGIN + tables() + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
