"""The state of a live scene as the query of an address, and back.

``/runs/<id>/view?f=37&cam=px,py,pz,lx,ly,lz&show=nodes,forces`` opens a scene as somebody left it.

==================  ===============================================================================
``f``               frame
``sequence``        one of the run's sequences
``cam``             where the camera stands and what it looks at: six numbers [m]
``up``, ``fov``     what is upwards for the camera, if not z; its vertical field of view [degrees]
``show``            layers that are shown, separated by commas; all others are hidden
``color`` …         every choice of `Layers`, by its own name
``range``           values at the ends of the color scale, in SI units
``scale``           length of the force arrows
``mass``            what the object weighs [kg], if somebody said so on the screen
``from``            view whose image is the backdrop; none with ``show`` or ``cam`` but without this
``theme``           ``light`` or ``dark``
``fig``             1 for the figure that compares with PhysTwin
``play``            1 if the clock runs
``speed``, ``loop`` how it runs
``part``            first and last frame of what is played
``path``            key frames of the camera of a film, with ``;`` between them: frame and three
                    times three numbers [m] (place, what it looks at, upwards), field of view
a parameter         its name and value, if it is not as fitted; ``substeps_per_frame=auto``
==================  ===============================================================================
"""

import math
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.camera_path import CameraPath
from app.viewer.content.layers import THEMES, Layers
from app.viewer.content.session_state import KeyFrame, Pose, SessionState
from physhandi.data.sequence_meta import HEAVIEST, LIGHTEST
from physhandi.errors import UsageError
from physhandi.simulation.parameters import AUTOMATIC, PARAMETERS, SimulationParameters

_FARTHEST = 1e5
_LARGEST_VALUE = 1e12
_LAST_FRAME = 10_000_000
_LONGEST = 200
_MOST_SUBSTEPS = 20_000
_SCALES, _SPEEDS, _FOVS = (0.1, 5.0), (0.1, 2.0), (1.0, 170.0)
_UP = (0.0, 0.0, 1.0)
_LONGEST_PATH = 2_800
"""Key frames are told by a link as long as servers and mails take the address: about 40."""
_KEYS = (
    *("f", "sequence", "cam", "up", "fov", "show", "range", "scale", "from"),
    *("theme", "fig", "play", "speed", "loop", "part", "mass", "path"),
)
_NUMBERS = {"scale": ("force_scale", _SCALES), "mass": ("mass", (LIGHTEST, HEAVIEST))}
_LAYER_TYPES: dict[str, Any] = get_type_hints(Layers)
_SWITCHES = tuple(name for name, kind in _LAYER_TYPES.items() if kind is bool and name != "dark")
_CHOICES: dict[str, tuple[str, ...]] = {
    name: get_args(kind) for name, kind in _LAYER_TYPES.items() if get_origin(kind) is Literal
}
_PARAMETERS = tuple(name for name, parameter in PARAMETERS.items() if parameter.is_in_links)


def state_to_query(state: SessionState) -> dict[str, str]:
    """Write what a user has set up as the fields of an address.

    Args:
        state: What a session tells about itself.

    Returns:
        Text by field; what is as usual is left out.
    """
    query = {"f": str(state.frame)}
    if state.sequence_name:
        query["sequence"] = state.sequence_name
    if state.pose is not None:
        query |= _pose_to_query(state.pose)
    query |= _layers_to_query(_named_layers(state))
    rest: dict[str, tuple[bool, str]] = {
        "theme": (state.theme != THEMES[0], state.theme),
        "fig": (state.is_figure, "1"),
        "play": (state.is_playing, "1"),
        "speed": (state.speed != 1.0, _number(state.speed)),
        "loop": (not state.does_loop, "0"),
        "part": (state.part is not None, ",".join(map(str, state.part or ()))),
        "path": (bool(state.camera_keys) and holds_path(state), _path_text(state)),
    }
    query |= {name: text for name, (is_given, text) in rest.items() if is_given}
    for name, value in state.parameter_changes.items():
        if name in _PARAMETERS:
            query[name] = _parameter_text(value)
    if state.automatic_substeps:
        query["substeps_per_frame"] = AUTOMATIC
    return query


def state_from_query(query: Mapping[str, str]) -> SessionState:
    """Read the fields of an address.

    What does not depend on the run is checked here; whether it has the frame, the sequence and
    the view is found out when the scene is opened.

    Args:
        query: Text by field, as `state_to_query` writes it; all are optional.

    Raises:
        UsageError: If a field is unknown or its value makes no sense; names the field.
    """
    allowed = {*_KEYS, *_CHOICES, *_PARAMETERS}
    for name, text in query.items():
        if name not in allowed:
            raise UsageError(
                f"{name[:40]!r}: a link has no such field. It has: {', '.join(sorted(allowed))}."
            )
        if len(text) > {"show": 2 * _LONGEST, "path": _LONGEST_PATH}.get(name, _LONGEST):
            raise UsageError(f"{name}: the value is too long.")
    changes = {name: text for name, text in query.items() if name in _PARAMETERS}
    is_automatic = changes.get("substeps_per_frame") == AUTOMATIC
    if is_automatic:
        del changes["substeps_per_frame"]
    theme = query.get("theme", THEMES[0])
    if theme not in THEMES:
        raise UsageError(f"theme: {theme!r} is not one of {', '.join(THEMES)}.")
    return SessionState(
        sequence_name=query.get("sequence") or None,
        frame=_integer(query, "f", _LAST_FRAME),
        is_playing=_switch(query, "play", usual=False),
        speed=_real(query, "speed", _SPEEDS, 1.0),
        does_loop=_switch(query, "loop", usual=True),
        part=_part_from_query(query),
        layers=None,
        layer_changes=_layers_from_query(query),
        theme=theme,
        prefers_dark=False,
        parameters=None,
        parameter_changes={name: _parameter(name, text) for name, text in changes.items()},
        automatic_substeps=is_automatic,
        is_figure=_switch(query, "fig", usual=False),
        pose=_pose_from_query(query),
        camera_keys=_path_from_query(query),
    )


def holds_path(state: SessionState) -> bool:
    """Tell whether a link has room for all key frames of a state's camera path."""
    return len(_path_text(state)) <= _LONGEST_PATH


def _named_layers(state: SessionState) -> dict[str, Any]:
    if state.layers is None:
        return dict(state.layer_changes)
    return {name: getattr(state.layers, name) for name in _LAYER_TYPES}


def _layers_to_query(layers: Mapping[str, Any]) -> dict[str, str]:
    query: dict[str, str] = {}
    if any(name in layers for name in _SWITCHES):
        query["show"] = ",".join(name for name in _SWITCHES if layers.get(name))
    usual = Layers()
    for name in _CHOICES:
        if layers.get(name, getattr(usual, name)) != getattr(usual, name):
            query[name] = str(layers[name])
    if layers.get("force_scale", 1.0) != 1.0:
        query["scale"] = _number(layers["force_scale"])
    if layers.get("color_range"):
        query["range"] = _numbers(layers["color_range"])
    if layers.get("looks_from"):
        query["from"] = str(layers["looks_from"])
    if layers.get("mass"):
        query["mass"] = _number(layers["mass"])
    return query


def _layers_from_query(query: Mapping[str, str]) -> dict[str, Any]:
    layers: dict[str, Any] = {}
    if "show" in query:
        shown = [name for name in query["show"].split(",") if name]
        unknown = [name for name in shown if name not in _SWITCHES]
        if unknown:
            raise UsageError(
                f"show: there is no layer {unknown[0][:40]!r}. There are: {', '.join(_SWITCHES)}."
            )
        layers = {name: name in shown for name in _SWITCHES}
    for name, choices in _CHOICES.items():
        if name in query:
            if query[name] not in choices:
                raise UsageError(
                    f"{name}: {query[name][:40]!r} is not one of {', '.join(choices)}."
                )
            layers[name] = query[name]
    layers |= {
        field: _real(query, name, ends, 1.0)
        for name, (field, ends) in _NUMBERS.items()
        if name in query
    }
    ends = _reals(query, "range", 2)
    if ends is not None:
        if ends[0] >= ends[1]:
            raise UsageError("range: the first value is not smaller than the second one.")
        layers["color_range"] = ends
    if {"from", "show", "cam"} & set(query):  # Who says what is seen, says it without a backdrop.
        layers["looks_from"] = query.get("from") or None
    return layers


def _pose_to_query(pose: Pose) -> dict[str, str]:
    query = {
        # A micrometre is nothing here; without this, rounding would be written as 1e-18.
        "cam": _numbers(np.round((*pose.position, *pose.look_at), 6) + 0.0),
        "fov": _number(math.degrees(pose.fov)),
    }
    if not np.allclose(pose.up, _UP, atol=1e-6):
        query["up"] = _numbers(pose.up)
    return query


def _pose_from_query(query: Mapping[str, str]) -> Pose | None:
    fov = math.radians(_real(query, "fov", _FOVS, 45.0))
    up = np.array(_reals(query, "up", 3) or _UP)
    if "cam" not in query:
        if {"fov", "up"} & set(query):
            raise UsageError("cam: it is missing, and 'fov' and 'up' mean nothing without it.")
        return None
    place = np.array(_reals(query, "cam", 6))
    return _pose(place[:3], place[3:], up, fov)


def _pose(position: ndarray, look_at: ndarray, up: ndarray, fov: float) -> Pose:
    """Make a camera, unless it looks nowhere, or along its up."""
    ahead = look_at - position
    if np.linalg.norm(ahead) < 1e-9:
        raise UsageError("cam: the camera stands where it looks at (the first and last three).")
    if np.linalg.norm(np.cross(ahead, up)) < 1e-6 * np.linalg.norm(ahead):
        raise UsageError("up: the camera looks along it, so that nothing is upwards.")
    return Pose(position=position, look_at=look_at, up=up / np.linalg.norm(up), fov=fov)


def _path_text(state: SessionState) -> str:
    return ";".join(
        f"{key.frame},{_numbers((*_rounded(key.pose), math.degrees(key.pose.fov)))}"
        for key in state.camera_keys
    )


def _rounded(pose: Pose) -> Float[ndarray, " 9"]:
    """Give where a camera stands, what it looks at and its up to a micrometre."""
    return np.round((*pose.position, *pose.look_at, *pose.up), 6) + 0.0


def _path_from_query(query: Mapping[str, str]) -> tuple[KeyFrame, ...]:
    if not query.get("path"):
        return ()
    try:
        keys = tuple(map(_key_frame, query["path"].split(";")))
        return CameraPath(keys).keys
    except UsageError as error:
        raise UsageError(f"path: {error}") from None


def _key_frame(text: str) -> KeyFrame:
    name = f"key frame {text[:20]!r}"
    frame, _, rest = text.partition(",")
    numbers = np.array(_reals({name: rest}, name, 10))
    fov = math.radians(_finite(name, str(numbers[9]), _FOVS))
    pose = _pose(numbers[:3], numbers[3:6], numbers[6:9], fov)
    return KeyFrame(frame=_integer({name: frame}, name, _LAST_FRAME), pose=pose)


def _reals(query: Mapping[str, str], name: str, count: int) -> tuple[float, ...] | None:
    if name not in query:
        return None
    parts = query[name].split(",")
    if len(parts) != count:
        raise UsageError(f"{name}: expected {count} numbers separated by commas, got {len(parts)}.")
    most = _LARGEST_VALUE if name == "range" else _FARTHEST
    return tuple(_finite(name, part, (-most, most)) for part in parts)


def _real(query: Mapping[str, str], name: str, bounds: tuple[float, float], usual: float) -> float:
    return _finite(name, query[name], bounds) if name in query else usual


def _finite(name: str, text: str, bounds: tuple[float, float]) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"{name}: {text[:40]!r} is not a number.") from None
    if not bounds[0] <= value <= bounds[1]:
        raise UsageError(f"{name}: {text[:40]} is not between {bounds[0]:g} and {bounds[1]:g}.")
    return value


def _integer(query: Mapping[str, str], name: str, most: int) -> int:
    text = query.get(name, "0")
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) <= most):
        raise UsageError(f"{name}: {text[:40]!r} is not a whole number from 0 to {most}.")
    return int(text)


def _switch(query: Mapping[str, str], name: str, *, usual: bool) -> bool:
    text = query.get(name)
    if text not in {None, "0", "1"}:
        raise UsageError(f"{name}: {text[:40]!r} is neither 0 nor 1." if text else f"{name}: empty")
    return usual if text is None else text == "1"


def _part_from_query(query: Mapping[str, str]) -> tuple[int, int] | None:
    if "part" not in query:
        return None
    first, _, last = query["part"].partition(",")
    ends = [_integer({"part": text}, "part", _LAST_FRAME) for text in (first, last or "0")]
    if ends[0] >= ends[1]:
        raise UsageError(f"part: {query['part'][:40]!r} is not a first and a later last frame.")
    return ends[0], ends[1]


def _parameter(name: str, text: str) -> Any:
    """Read a parameter in the type of its field, within the bounds of the simulator."""
    kind = PARAMETERS[name].kind
    value: Any
    if kind == "switch":
        value = _switch({name: text}, name, usual=False)
    elif kind == "whole":
        value = _integer({name: text}, name, _MOST_SUBSTEPS)
    elif text == "none":
        value = None
    else:
        value = _finite(name, text, (-math.inf, math.inf))
    try:
        SimulationParameters.from_dict({name: value})
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    return value


def _parameter_text(value: Any) -> str:
    if value is None:
        return "none"
    return str(int(value)) if isinstance(value, bool | int) else repr(float(value))


def _number(value: float) -> str:
    return f"{float(value):.6g}"


def _numbers(values: Any) -> str:
    return ",".join(_number(value) for value in values)
