"""The fields of ``sequence.yaml``: what they mean, and how a wrong one is reported."""

import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from physhandi.data.camera import PinholeCamera
from physhandi.data.files import named_fields, parse_yaml, require_plain
from physhandi.errors import SequenceError

FORMAT = "physhandi-sequence/1"
UNFINISHED = "unfinished"
"""Provenance field of masks that are being stored."""
FILE = "sequence.yaml"
LONGEST_NAME = 64
"""Letters of the longest name of a sequence or a view."""
SAFE_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{LONGEST_NAME}}}")
_UNSAFE = re.compile("[^A-Za-z0-9_-]+")
_SIZE_LIMIT = 4_000_000
_MOST_FRAMES = 1_000_000

Side = Literal["right", "left"]
SIDES: tuple[Side, Side] = ("right", "left")
"""Hands in the order in which sequences list them."""
ShapeClass = Literal["sheet", "solid", "shell", "rope"]
"""Kinds of object: a layer, a filled body, a hollow one, or a long thin one."""
DIMENSION: dict[ShapeClass, int] = {"rope": 1, "sheet": 2, "shell": 2, "solid": 3}
"""Whether nodes fill a line, a surface or a body."""
LIGHTEST, HEAVIEST = 1e-6, 1e4
"""Ends of what an object may weigh [kg]."""


@dataclass(frozen=True, kw_only=True)
class ViewMeta:
    """One view as ``sequence.yaml`` describes it."""

    name: str
    """Name of the view and of its folder below ``views/``."""
    camera: PinholeCamera
    """Calibration of the view."""


@dataclass(frozen=True, kw_only=True)
class SequenceMeta:
    """Everything that ``sequence.yaml`` says about a sequence."""

    name: str
    """Name of the sequence: letters, digits, ``_`` and ``-``."""
    frame_rate: float
    """Frames per second [Hz]."""
    frame_count: int
    """Number of frames."""
    description: str = ""
    """Description of the recorded scene, in one or two sentences."""
    metric: bool = True
    """Whether lengths are metres; otherwise one unit is whatever `length_unit` says."""
    length_unit: str = "m"
    """Name of the unit of all lengths."""
    ground_height: float | None = None
    """Height of the table or floor above z = 0; None if there is none."""
    gravity: float = 9.81
    """Gravitational acceleration along -z [m/s²]."""
    hands: tuple[Side, ...] = ()
    """Hands that take part, in the order of the keypoints' hand axis."""
    views: tuple[ViewMeta, ...] = ()
    """Calibrated views."""
    reconstruction: int | None = None
    """Number of leading frames that are fitted; None means the first 70 %."""
    controlled_markers: tuple[int, ...] = ()
    """Markers that are fixed to a control, so that metrics do not score them."""
    surface_node_count: int | None = None
    """Number of leading object nodes that lie on the surface; None if that is not known."""
    provenance: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Where the recording comes from: origin, licence, importer and its settings."""
    label: str = ""
    """Free label of the user."""
    shape: ShapeClass | None = None
    """Kind of object; None if that is to be found from what the first frame shows."""
    mass: float | None = None
    """Mass of the object [kg]; None if nobody weighed it."""

    @property
    def has_unfinished_masks(self) -> bool:
        """Whether the process ended while masks and tracks were being put in place."""
        return bool((named_fields(self.provenance.get("masks")) or {}).get(UNFINISHED))

    @property
    def reconstruction_count(self) -> int:
        """Number of leading frames that are fitted."""
        if self.reconstruction is None:
            return default_reconstruction_count(self.frame_count)
        return self.reconstruction

    def to_dict(self) -> dict[str, Any]:
        """Describe the sequence as ``sequence.yaml`` does."""
        return {
            "format": FORMAT,
            "name": self.name,
            "description": self.description,
            "label": self.label,
            "frame_rate": self.frame_rate,
            "frame_count": self.frame_count,
            "metric": self.metric,
            "length_unit": self.length_unit,
            "ground_height": self.ground_height,
            "gravity": self.gravity,
            "hands": list(self.hands),
            "controlled_markers": list(self.controlled_markers),
            "surface_node_count": self.surface_node_count,
            "split": {"reconstruction": self.reconstruction_count},
            "views": [{"name": v.name, "camera": v.camera.to_dict()} for v in self.views],
            "provenance": dict(self.provenance),
            **({} if self.shape is None else {"shape": self.shape}),
            **({} if self.mass is None else {"mass": self.mass}),
        }


def safe_name(name: str, longest: int | None = LONGEST_NAME, *, joins_unsafe: bool = False) -> str:
    """Give a name that a file or folder may have: letters that it may not have become _.

    Args:
        name: Any text.
        longest: How many letters count, the first ones; None for all.
        joins_unsafe: Whether such letters one after the other become one _, instead of one each.
    """
    return _UNSAFE.sub(lambda unsafe: "_" * (1 if joins_unsafe else len(unsafe[0])), name)[:longest]


def default_reconstruction_count(frame_count: int) -> int:
    """Hold out the last 30 % of a sequence that does not say how to split it, as PhysTwin does."""
    return max(1, 7 * frame_count // 10)


def read_meta(folder: Path) -> SequenceMeta:
    """Read and check ``sequence.yaml`` of a folder.

    Raises:
        SequenceError: If the file is missing, not YAML, or has a missing, unknown or wrong field.
    """
    path = folder / FILE
    where = f"Sequence '{folder.name}'"
    try:
        if path.stat().st_size > _SIZE_LIMIT:
            raise SequenceError(f"{where}: {FILE} is larger than {_SIZE_LIMIT} bytes.", file=FILE)
        content = parse_yaml(path.read_text(encoding="utf-8"), reads_dates=False)
    except (FileNotFoundError, NotADirectoryError):
        raise SequenceError(
            f"{where}: {FILE} is missing in {folder}. Give the folder that an importer wrote.",
            file=FILE,
            remedy="give the folder that an importer wrote",
        ) from None
    except (ValueError, OSError) as error:
        raise SequenceError(
            f"{where}: {FILE} cannot be read as YAML: {error}.",
            file=FILE,
            remedy="correct what the line says",
        ) from error
    return parse_meta(content, where)


def parse_meta(content: Any, where: str) -> SequenceMeta:
    """Check the content of ``sequence.yaml``; `where` starts each message."""
    fields = _Fields(content, f"{where}: {FILE}")
    file_format = fields.take("format", str)
    if file_format != FORMAT:
        fields.fail("format", file_format, f"{FORMAT!r}; this version reads no other")
    frame_count = fields.whole("frame_count", least=1, most=_MOST_FRAMES)
    split = _Fields(fields.take("split", dict, {}), f"{where}: {FILE}: split")
    default = default_reconstruction_count(frame_count)
    reconstruction = split.whole("reconstruction", least=1, default=default)
    split.finish()
    if reconstruction > frame_count:
        fields.fail("split.reconstruction", reconstruction, f"at most frame_count = {frame_count}")
    meta = SequenceMeta(
        name=fields.name("name"),
        frame_rate=fields.number("frame_rate", above=0.0),
        frame_count=frame_count,
        description=fields.take("description", str, ""),
        metric=fields.take("metric", bool, True),
        length_unit=fields.take("length_unit", str, "m"),
        ground_height=fields.optional_number("ground_height"),
        gravity=fields.number("gravity", default=9.81),
        hands=_hands(fields),
        views=_views(fields, where),
        reconstruction=reconstruction,
        controlled_markers=_markers(fields),
        surface_node_count=fields.optional_whole("surface_node_count", least=0),
        provenance=_provenance(fields),
        label=fields.take("label", str, ""),
        shape=cast("ShapeClass | None", fields.optional_choice("shape", get_args(ShapeClass))),
        mass=_mass(fields),
    )
    fields.finish()
    return meta


def _hands(fields: "_Fields") -> tuple[Side, ...]:
    sides: list[Side] = []
    for side in fields.take("hands", list, []):
        if side not in ("right", "left") or side in sides:
            fields.fail("hands", side, "each of 'right' and 'left' at most once")
        sides.append(side)
    return tuple(sides)


def _mass(fields: "_Fields") -> float | None:
    mass = fields.optional_number("mass")
    if mass is not None and not LIGHTEST <= mass <= HEAVIEST:
        fields.fail("mass", mass, f"the object's mass in kilograms, {LIGHTEST:g} to {HEAVIEST:g}")
    return mass


def _markers(fields: "_Fields") -> tuple[int, ...]:
    markers: list[int] = fields.take("controlled_markers", list, [])
    for marker in markers:
        if type(marker) is not int or marker < 0 or markers.count(marker) > 1:
            fields.fail("controlled_markers", marker, "different marker numbers from 0 on")
    return tuple(markers)


def _provenance(fields: "_Fields") -> dict[str, Any]:
    provenance = fields.take("provenance", dict, {})
    try:
        require_plain({"provenance": provenance})
    except ValueError as error:
        fields.refuse("provenance", str(error), "plain data: text, finite numbers, lists, fields")
    return provenance


def _views(fields: "_Fields", where: str) -> tuple[ViewMeta, ...]:
    views: list[ViewMeta] = []
    for index, item in enumerate(fields.take("views", list, [])):
        view = _Fields(item, f"{where}: {FILE}: views[{index}]")
        name = view.name("name")
        if any(name == other.name for other in views):
            view.fail("name", name, "a name that no other view has")
        camera = view.take("camera", dict)
        try:
            views.append(ViewMeta(name=name, camera=PinholeCamera.from_dict(camera)))
        except ValueError as error:
            raise SequenceError(
                f"{where}: {FILE}: camera of view '{name}': {error}.",
                file=FILE,
                field=f"views[{index}].camera",
                remedy="correct the calibration",
            ) from error
        view.finish()
    return tuple(views)


_MISSING = object()
_LARGEST = 10**300
"""Larger whole numbers have no float."""


def _short(value: Any) -> str:
    # YAML's aliases can make a few lines stand for more text than there is memory.
    try:
        text = reprlib.repr(value)
    except ValueError:  # Python writes no whole number of more than 4300 digits.
        return "a huge number"
    return text if len(text) <= 80 else text[:77] + "..."


class _Fields:
    """A YAML mapping whose fields are taken one by one; what is left over is unknown."""

    def __init__(self, content: Any, where: str) -> None:
        if not isinstance(content, dict):
            raise SequenceError(
                f"{where} must hold named fields, not {_short(content)}.", file=FILE
            )
        self._left = dict(cast("dict[Any, Any]", content))
        self._where = where

    def fail(self, field_name: str, value: Any, expected: str) -> None:
        self.refuse(field_name, f"{field_name} is {_short(value)}", expected)

    def refuse(self, field_name: str, problem: str, expected: str) -> None:
        raise SequenceError(
            f"{self._where}: {problem}; expected {expected}.",
            file=FILE,
            field=field_name,
            remedy=f"give {expected}",
        )

    def take(self, name: str, kind: type, default: Any = _MISSING) -> Any:
        value = self._any(name, default)
        if type(value) is not kind:
            names = {str: "text", bool: "true or false", list: "a list", dict: "named fields"}
            self.fail(name, value, names.get(kind, kind.__name__))
        return named_fields(value) if kind is dict else value

    def _any(self, name: str, default: Any) -> Any:
        if name not in self._left and default is _MISSING:
            raise SequenceError(
                f"{self._where}: field '{name}' is missing; add it.",
                file=FILE,
                field=name,
                remedy="add it",
            )
        return self._left.pop(name, default)

    def whole(
        self, name: str, *, least: int, most: int | None = None, default: Any = _MISSING
    ) -> int:
        value = self._any(name, default)
        if type(value) is not int or value < least:
            self.fail(name, value, f"a whole number from {least} on")
        if most is not None and value > most:
            self.fail(name, value, f"at most {most}")
        return value

    def optional_whole(self, name: str, *, least: int) -> int | None:
        is_given = self._left.get(name) is not None
        return self.whole(name, least=least) if is_given else self._left.pop(name, None)

    def number(self, name: str, *, above: float = -math.inf, default: Any = _MISSING) -> float:
        value = self._any(name, default)
        is_number = type(value) is float or (type(value) is int and abs(value) < _LARGEST)
        if not is_number or not math.isfinite(value) or not value > above:
            limit = "" if above == -math.inf else f" above {above:g}"
            self.fail(name, value, f"a finite number{limit}")
        return float(value)

    def optional_number(self, name: str) -> float | None:
        return self.number(name) if self._left.get(name) is not None else self._left.pop(name, None)

    def optional_choice(self, name: str, choices: tuple[str, ...]) -> str | None:
        value = self._left.pop(name, None)
        if value is not None and value not in choices:
            self.fail(name, value, f"one of {', '.join(choices)}")
        return value

    def name(self, name: str) -> str:
        value = self.take(name, str)
        if not SAFE_NAME.fullmatch(value):
            self.fail(name, value, "1-64 letters, digits, '_' or '-'")
        return value

    def finish(self) -> None:
        if self._left:
            key = next(iter(self._left))
            raise SequenceError(
                f"{self._where}: field {key!r} is not known. Remove it or correct its spelling.",
                file=FILE,
                field=str(key)[:80],
                remedy="remove it or correct its spelling",
            )
