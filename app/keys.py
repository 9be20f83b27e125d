"""Every key and mouse action of the viewer: what is bound, shown in the help and documented."""

from dataclasses import dataclass
from typing import Literal

Action = Literal[
    "play",
    "next",
    "previous",
    "ten_on",
    "ten_back",
    "first",
    "last",
    "slower",
    "pause",
    "faster",
    "part_begin",
    "part_end",
    "layer",
    "form",
    "color",
    "color_back",
    "clear",
    "reset",
    "snapshot",
    "figure",
    "theme",
    "undo",
    "redo",
    "hold",
    "one_frame",
    "pin",
    "compare_mode",
    "swap",
    "steer",
    "edit",
]
"""Actions of keys in the live scene."""


@dataclass(frozen=True, kw_only=True)
class Key:
    """One key, or a row of keys that do the same to different things."""

    shown: tuple[str, ...]
    """Its caption, key by key."""
    about: str
    """Its effect, for people."""
    action: Action | None = None
    """Action that it triggers in the live scene; None for keys of the browser or the page."""
    hotkeys: tuple[str, ...] = ()
    """Names by which the scene knows the keys."""
    modifier: Literal["shift", "cmd/ctrl", "cmd/ctrl+shift"] | None = None
    """Key that is held with it."""


@dataclass(frozen=True, kw_only=True)
class KeyGroup:
    """Keys that belong together."""

    title: str
    """Heading."""
    keys: tuple[Key, ...]
    """The keys."""


LAYER_KEYS = (
    ("hands", "hands"),
    ("nodes", "object nodes"),
    ("surface", "surface"),
    ("object_springs", "object springs"),
    ("virtual_springs", "virtual springs"),
    ("controls", "control nodes"),
    ("forces", "force arrows"),
    ("observed", "observed points"),
    ("cameras", "cameras"),
)
"""Layers that the keys 1 to 9 switch, by the names of their fields, and what they are called."""

_ROW = tuple(str(number) for number in range(1, len(LAYER_KEYS) + 1))
_LAYERS = ", ".join(f"{key} {name}" for key, (_, name) in zip(_ROW, LAYER_KEYS, strict=True))

KEYS: tuple[KeyGroup, ...] = (
    KeyGroup(
        title="Time",
        keys=(
            Key(shown=("space",), about="play or pause", action="play", hotkeys=("space",)),
            Key(shown=("→",), about="one frame on", action="next", hotkeys=("arrowright",)),
            Key(shown=("←",), about="one frame back", action="previous", hotkeys=("arrowleft",)),
            Key(
                shown=("shift", "→"),
                about="ten frames on",
                action="ten_on",
                hotkeys=("arrowright",),
                modifier="shift",
            ),
            Key(
                shown=("shift", "←"),
                about="ten frames back",
                action="ten_back",
                hotkeys=("arrowleft",),
                modifier="shift",
            ),
            Key(shown=("home",), about="first frame", action="first", hotkeys=("home",)),
            Key(shown=("end",), about="last frame", action="last", hotkeys=("end",)),
            Key(shown=("J",), about="play slower", action="slower", hotkeys=("J",)),
            Key(shown=("K",), about="pause", action="pause", hotkeys=("K",)),
            Key(shown=("L",), about="play faster", action="faster", hotkeys=("L",)),
            Key(
                shown=("I",),
                about="play from this frame on",
                action="part_begin",
                hotkeys=("I",),
            ),
            Key(shown=("O",), about="play up to this frame", action="part_end", hotkeys=("O",)),
        ),
    ),
    KeyGroup(
        title="Look",
        keys=(
            Key(
                shown=("1", "…", "9"),
                about=f"show or hide a layer: {_LAYERS}",
                action="layer",
                hotkeys=_ROW,
            ),
            Key(
                shown=("0",),
                about="show the object as a surface, as splats if it has some, or as nodes",
                action="form",
                hotkeys=("0",),
            ),
            Key(shown=("C",), about="color by the next quantity", action="color", hotkeys=("C",)),
            Key(
                shown=("shift", "C"),
                about="color by the quantity before",
                action="color_back",
                hotkeys=("C",),
                modifier="shift",
            ),
            Key(shown=("R",), about="camera back to the overview", action="reset", hotkeys=("R",)),
            Key(shown=("T",), about="light or dark", action="theme", hotkeys=("T",)),
            Key(shown=("F",), about="figure: ours and PhysTwin's", action="figure", hotkeys=("F",)),
            Key(shown=("S",), about="save a picture", action="snapshot", hotkeys=("S",)),
            Key(shown=("P",), about="copy a link to this view"),
        ),
    ),
    KeyGroup(
        title="Physics",
        keys=(
            Key(
                shown=("ctrl", "Z"),
                about="undo a change of the parameters",
                action="undo",
                hotkeys=("Z",),
                modifier="cmd/ctrl",
            ),
            Key(
                shown=("ctrl", "shift", "Z"),
                about="redo it",
                action="redo",
                hotkeys=("Z",),
                modifier="cmd/ctrl+shift",
            ),
            Key(shown=("H",), about="hold the simulation or go on", action="hold", hotkeys=("H",)),
            Key(shown=("N",), about="simulate one more frame", action="one_frame", hotkeys=("N",)),
        ),
    ),
    KeyGroup(
        title="Compare",
        keys=(
            Key(
                shown=("V",),
                about="compare with the rollout kept as A, or with what was fitted; again to stop",
                action="pin",
                hotkeys=("V",),
            ),
            Key(
                shown=("M",),
                about="A and B side by side, over each other, or wiped",
                action="compare_mode",
                hotkeys=("M",),
            ),
            Key(shown=("X",), about="swap the sides of A and B", action="swap", hotkeys=("X",)),
        ),
    ),
    KeyGroup(
        title="Steer",
        keys=(
            Key(
                shown=("G",),
                about="steer the hand from this frame on; again to return to playback",
                action="steer",
                hotkeys=("G",),
            ),
            Key(
                shown=("W", "S", "A", "D", "Q", "E"),
                about="while steering: move the hand ahead, back, left, right, down, up",
            ),
            Key(
                shown=("I", "K", "J", "L", "U", "O"),
                about="while steering: tip it ahead and back, turn and roll it left and right",
            ),
            Key(
                shown=("R", "F"),
                about="while steering: close and open its fingers; none of these fourteen keys "
                "means anything else then",
            ),
            Key(
                shown=("X",),
                about="while steering: let go of the object, or grip what is near the hand; "
                "a point is held no more",
            ),
            Key(
                shown=("click",),
                about="while steering: bend the finger whose dot is clicked, or hold a point of "
                "the object and move that",
            ),
            Key(
                shown=("space",),
                about="while steering: begin or end to record what you do",
            ),
            Key(
                shown=("ctrl", "Z"),
                about="while steering: back to before the last drag, held key or grip",
            ),
        ),
    ),
    KeyGroup(
        title="Edit",
        keys=(
            Key(
                shown=("B",),
                about="edit: select nodes or springs and change them; again to end it",
                action="edit",
                hotkeys=("B",),
            ),
            Key(
                shown=("drag",),
                about="while editing: select what the rectangle, lasso or brush holds; with shift "
                "add it, with ctrl take it out; the right button still moves the camera",
            ),
            Key(
                shown=("click",),
                about="while editing: select one node or spring; with shift add it or take it out",
            ),
        ),
    ),
    KeyGroup(
        title="Inspect",
        keys=(
            Key(
                shown=("click",),
                about="read a node, spring, control node or hand vertex, and its history",
            ),
            Key(shown=("shift", "click"), about="read the hand, also in front of the object"),
            Key(
                shown=("esc",), about="forget what was clicked", action="clear", hotkeys=("escape",)
            ),
            Key(shown=("click in a chart",), about="go to that frame"),
        ),
    ),
    KeyGroup(
        title="Camera",
        keys=(
            Key(shown=("drag",), about="turn; with the right button move"),
            Key(shown=("wheel",), about="zoom"),
            Key(shown=("W", "A", "D", "Q", "E"), about="move ahead and aside, down and up"),
            Key(shown=("?",), about="this help"),
        ),
    ),
)
"""All keys of the live scene."""


def key_of(action: Action) -> Key:
    """Find the key that triggers an action."""
    return next(key for group in KEYS for key in group.keys if key.action == action)
