"""Settings as frozen classes: each field says its type, bounds, unit and meaning where it stands.

::

    class HandFitConfig(Settings, frozen=True, kw_only=True):
        depth_noise: Annotated[float, Meta(ge=1e-5, le=1.0)] = 0.004
        '''Error to be expected of a depth measurement on the hand [m].'''

From such declarations come validation, the words of its errors, forms, tables and documentation.
"""

import ast
import difflib
import inspect
import math
import re
import sys
import threading
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Literal, Self, cast

import msgspec
import numpy as np
from msgspec import Meta

from physhandi.errors import SettingsError
from physhandi.typed import to_typed

LARGEST_NUMBER = 1e30
"""Larger numbers, squared or multiplied, leave the simulator's float32; no setting exceeds it."""
Finite = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]

ValueKind = Literal["number", "whole", "switch", "choice", "text", "settings", "mapping"]


@dataclass(frozen=True, kw_only=True)
class Field:
    """Declaration of one field of a class of settings."""

    name: str
    """Its name."""
    type: Any
    """Type with bounds, as msgspec checks it."""
    kind: ValueKind
    """Kind of its value; ``settings`` and ``mapping`` hold further fields."""
    about: str
    """Meaning, in a sentence."""
    unit: str
    """Unit; empty for a mere number."""
    low: float | None
    """Lowest value; none if that side is open."""
    high: float | None
    """Highest value; none if that side is open."""
    choices: tuple[str, ...]
    """Values of a choice."""
    is_optional: bool
    """Whether it may be empty (None)."""
    is_required: bool
    """Whether it has no default."""
    inner: "type[Settings] | None"
    """Class of the settings that it holds, or that each item of its mapping is."""
    notes: tuple[Any, ...]
    """Further metadata of its annotation."""

    def problem_of(self, value: Any) -> str:
        """Say what a value ought to be if it is wrong; empty if it is right."""
        try:
            to_typed(value, self.type)
        except msgspec.ValidationError:
            return self.wanted
        return ""

    def converted(self, value: Any) -> Any:
        """Read a number that is written as text, or a whole one with a point; leave the rest."""
        if self.kind not in {"number", "whole"} or isinstance(value, bool | np.bool_):
            return value
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            return value
        if self.kind == "number":
            return number
        return int(number) if number.is_integer() else value

    @property
    def wanted(self) -> str:
        """Allowed values, in words."""
        if self.kind in {"settings", "mapping"}:
            return "a mapping of fields"
        if self.kind == "switch":
            return "true or false"
        empty = ", or nothing" if self.is_optional else ""
        if self.kind == "choice":
            return f"one of {', '.join(self.choices)}{empty}"
        if self.kind == "text":
            return f"text{empty}"
        return f"a {'whole ' if self.kind == 'whole' else ''}number {self.range}{empty}"

    @property
    def range(self) -> str:
        """Its bounds in words, such as ``from 0 to 2``."""
        low, high = (None if end is None else f"{end:.10g}" for end in (self.low, self.high))
        if low is not None and high is not None:
            return f"from {low} to {high}"
        return (
            f"from {low} on" if low is not None else f"up to {high}" if high else "that is finite"
        )


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all classes of settings; a value out of bounds is refused wherever one is made."""

    def __post_init__(self) -> None:
        """Check the plain fields; numbers get the type of their field.

        Raises:
            SettingsError: If a value is of the wrong kind or out of bounds; names all of them.
        """
        problems: dict[str, str] = {}
        for field in fields_of(type(self)):
            if field.inner is not None:
                continue
            given = getattr(self, field.name)
            value = given.item() if isinstance(given, np.generic) else given
            try:
                value = to_typed(value, field.type)
            except msgspec.ValidationError:
                problems[field.name] = _wrong(field.name, given, field.wanted)
            else:
                if value is not given:
                    msgspec.structs.force_setattr(self, field.name, value)
        if problems:
            raise SettingsError(problems)

    def replace(self, **changes: Any) -> Self:
        """Make a copy in which some fields have other values.

        Raises:
            SettingsError: If a field is unknown, or a value of the wrong kind or out of bounds.
        """
        names = [field.name for field in fields_of(type(self))]
        unknown = {name: no_such("field", name, names) for name in changes if name not in names}
        if unknown:
            raise SettingsError(unknown)
        return msgspec.structs.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values, ready for YAML or JSON."""
        return msgspec.to_builtins(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read settings from plain values; fields that are left out keep their default.

        Raises:
            SettingsError: If a field is unknown or missing, or a value is of the wrong kind or out
                of bounds; names all of them by their paths.
        """
        try:
            return to_typed(values, cls)
        except (msgspec.ValidationError, SettingsError) as error:
            raise SettingsError(problems_in(cls, values, "") or {"": f"{error}"}) from None


@cache
def fields_of(kind: type[Settings]) -> tuple[Field, ...]:
    """List what a class of settings declares, field by field."""
    meanings = _meanings(kind.__module__)[kind.__name__]
    return tuple(_field(item, *meanings.get(item.name, ("", ""))) for item in _declared(kind))


def changes(before: Any, after: Any, *, tolerance: float = 0.0) -> dict[str, Any]:
    """Give what changed: the values of `after` that `before` has not, by their names or paths.

    Args:
        before: Settings, or values by name.
        after: Likewise.
        tolerance: Numbers that differ by a smaller share of themselves are the same.
    """
    was, now = _values(before), _values(after)
    return {
        name: value
        for name, value in now.items()
        if name not in was or not is_same(was[name], value, tolerance=tolerance)
    }


def is_same(first: Any, second: Any, *, tolerance: float = 0.0) -> bool:
    """Tell whether two values of a setting are the same; 1 and 1.0 are, 1 and True are not."""
    if _is_number(first) and _is_number(second):
        return first == second or math.isclose(first, second, rel_tol=tolerance)
    return type(first) is type(second) and first == second


def flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Name every value inside nested fields by its path, with dots between."""
    if not isinstance(value, Mapping):
        return {path: value}
    flat: dict[str, Any] = {}
    for name, inner in cast("Mapping[str, Any]", value).items():
        flat |= flatten(inner, f"{path}.{name}" if path else str(name))
    return flat


def shown(value: Any) -> str:
    """Quote a wrong value, shortened, in an error."""
    text = "empty" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def no_such(what: str, name: str, names: Iterable[str]) -> str:
    """Say that there is no field or setting of a name, and which one comes nearest."""
    near = difflib.get_close_matches(name, names := list(names), n=1, cutoff=0.6)
    if near:
        return f"There is no {what} '{name[:80]}'. Do you mean '{near[0]}'?"
    offered = ", ".join(names) if len(names) <= 40 else ""
    return f"There is no {what} '{name[:80]}'." + (f" There are: {offered}." if offered else "")


def _values(settings: Any) -> Mapping[str, Any]:
    return settings.to_dict() if isinstance(settings, Settings) else settings


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _wrong(path: str, value: Any, wanted: str) -> str:
    return f"{path} is {shown(value)}; expected {wanted}."


def problems_in(kind: type[Settings], values: Any, path: str = "") -> dict[str, str]:
    """Find all that is wrong with plain values, by path; msgspec names the first, without keys.

    Args:
        kind: Class of settings that they are to become.
        values: Values by name.
        path: Where they belong.
    """
    if not isinstance(values, Mapping):
        return {path: _wrong(path or "It", values, "a mapping of fields")}
    given = cast("Mapping[str, Any]", values)
    fields = {field.name: field for field in fields_of(kind)}
    at = f"{path}." if path else ""
    problems = {
        f"{at}{name}": no_such("field", f"{at}{name}", [f"{at}{other}" for other in fields])
        for name in given
        if name not in fields
    }
    for name, field in fields.items():
        if name in given:
            problems |= _problems_of(field, given[name], f"{at}{name}")
        elif field.is_required:
            problems[f"{at}{name}"] = f"{path or 'It'} lacks the field '{name}'."
    return problems or _problems_between(kind, given, path)


def _problems_of(field: Field, value: Any, path: str) -> dict[str, str]:
    """Find what is wrong with the value of a field."""
    if field.kind == "settings" and field.inner:
        return problems_in(field.inner, value, path)
    if field.kind == "mapping" and field.inner and isinstance(value, Mapping):
        problems: dict[str, str] = {}
        for key, item in cast("Mapping[str, Any]", value).items():
            problems |= problems_in(field.inner, item, f"{path}.{key}")
        return problems
    wanted = field.problem_of(value)
    return {path: _wrong(path, value, wanted)} if wanted else {}


def _problems_between(kind: type[Settings], values: Any, path: str) -> dict[str, str]:
    """Find what a class of settings itself refuses, when each field is right alone."""
    at = f"{path}." if path else ""
    try:
        to_typed(values, kind)
    except SettingsError as error:
        return {
            f"{at}{name}" if name else path: message if name or not path else f"{path}: {message}"
            for name, message in error.fields.items()
        }
    except msgspec.ValidationError as error:
        return {path: f"{path}: {error}"}
    return {}


def _declared(kind: type[Settings]) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(kind)


def _field(item: msgspec.structs.FieldInfo, about: str, unit: str) -> Field:
    hint, notes, is_optional = _unwrapped(item.type)
    bounds = {
        name: next((v for n in notes if (v := getattr(n, name, None)) is not None), None)
        for name in ("ge", "le")
    }
    choices: tuple[str, ...] = ()
    inner: type[Settings] | None = None
    origin = typing.get_origin(hint)
    if origin is Literal:
        kind: ValueKind = "choice"
        choices = typing.get_args(hint)
    elif origin is dict:
        kind = "mapping"
        held = typing.get_args(hint)[1]
        inner = held if isinstance(held, type) and issubclass(held, Settings) else None
    elif isinstance(hint, type) and issubclass(hint, Settings):
        kind, inner = "settings", hint
    else:
        kind = _KINDS[hint]
    return Field(
        name=item.name,
        type=item.type,
        kind=kind,
        about=about,
        unit=unit,
        low=_end(bounds["ge"]),
        high=_end(bounds["le"]),
        choices=choices,
        is_optional=is_optional,
        is_required=item.required,
        inner=inner,
        notes=tuple(note for note in notes if not isinstance(note, Meta)),
    )


_KINDS: dict[Any, ValueKind] = {float: "number", int: "whole", bool: "switch", str: "text"}


def _end(bound: float | None) -> float | None:
    return None if bound is None or abs(bound) >= LARGEST_NUMBER else float(bound)


def _unwrapped(hint: Any) -> tuple[Any, list[Any], bool]:
    """Take a type apart into the plain type, its annotations, and whether None is one of it."""
    if typing.get_origin(hint) is Annotated:
        inner, *notes = typing.get_args(hint)
        plain, others, is_optional = _unwrapped(inner)
        return plain, [*others, *notes], is_optional
    if typing.get_origin(hint) in {types.UnionType, typing.Union}:
        (inner,) = (kind for kind in typing.get_args(hint) if kind is not type(None))
        plain, notes, _ = _unwrapped(inner)
        return plain, notes, True
    return hint, [], False


_parsing = threading.Lock()
_UNIT = re.compile(r"\s*\[((?:1/)?[A-Za-z][^\]\d]*)\]")


@cache
def _meanings(module: str) -> dict[str, dict[str, tuple[str, str]]]:
    """Read meaning and unit of each field of a module's classes from the text below it."""
    # Python 3.11 counts the depth of a tree that it makes for all threads together, and fails.
    with _parsing:
        declared = ast.parse(inspect.getsource(sys.modules[module])).body
    return {item.name: _notes(item) for item in declared if isinstance(item, ast.ClassDef)}


def _notes(declared: ast.ClassDef) -> dict[str, tuple[str, str]]:
    meanings: dict[str, tuple[str, str]] = {}
    for declaration, note in pairwise(declared.body):
        if (
            isinstance(declaration, ast.AnnAssign)
            and isinstance(declaration.target, ast.Name)
            and isinstance(note, ast.Expr)
            and isinstance(note.value, ast.Constant)
        ):
            text = " ".join(str(note.value.value).split())
            unit = _UNIT.search(text)
            meanings[declaration.target.id] = (
                _UNIT.sub("", text),
                unit[1].strip() if unit else "",
            )
    return meanings
