"""What the fields of a settings class mean, read from where they are declared."""

import ast
import inspect
import re
from functools import cache
from itertools import pairwise

_UNIT = re.compile(r"\s*\[((?:1/)?[A-Za-z][^\]\d]*)\]")


@cache
def notes_of(kind: type) -> dict[str, tuple[str, str]]:
    """Read what each field of a dataclass means, and its unit; empty where none is given."""
    (declared,) = ast.parse(inspect.getsource(kind)).body
    notes: dict[str, tuple[str, str]] = {}
    body = declared.body if isinstance(declared, ast.ClassDef) else []
    for field, note in pairwise(body):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(note, ast.Expr)
            and isinstance(note.value, ast.Constant)
        ):
            text = " ".join(str(note.value.value).split())
            unit = _UNIT.search(text)
            notes[field.target.id] = (_UNIT.sub("", text), unit[1].strip() if unit else "")
    return notes
