"""Keys that are held on the page, which arrive by a websocket of their own.

viser tells when a key is pressed, but not how long it is held. The page tells over this channel
which keys are held now, each time that changes; the channel tells the page when to listen.
"""

import json
import threading
from collections.abc import Callable
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.content.session_state import Pose
from physhandi.errors import UsageError
from physhandi.typed import decode_json

MOST_LETTERS = 1_000
"""Longest message of a page."""

HeldKey = Literal[
    "KeyW",
    "KeyS",
    "KeyA",
    "KeyD",
    "KeyE",
    "KeyQ",
    "KeyI",
    "KeyK",
    "KeyJ",
    "KeyL",
    "KeyU",
    "KeyO",
    "KeyR",
    "KeyF",
]
"""Places of keys on a keyboard, by their names in browsers."""
Press = Literal["undo", "record", "grip"]
"""Actions of keys that act once when they go down."""

_MOVES: dict[str, tuple[int, int]] = {
    "KeyW": (0, 1),
    "KeyS": (0, -1),
    "KeyD": (1, 1),
    "KeyA": (1, -1),
    "KeyE": (2, 1),
    "KeyQ": (2, -1),
}
"""Axis of the view (ahead, right, up) along which a key moves the wrist, and its sign."""
_TURNS: dict[str, tuple[int, int]] = {
    "KeyI": (1, -1),
    "KeyK": (1, 1),
    "KeyJ": (2, 1),
    "KeyL": (2, -1),
    "KeyO": (0, 1),
    "KeyU": (0, -1),
}
"""About which of these axes the hand turns, and which way."""


class _FromPage(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Message of the page."""

    held: frozenset[HeldKey] | None = None
    press: Press | None = None


def view_axes(pose: Pose) -> Float[ndarray, "3 3"]:
    """Give the directions ahead, right and up of somebody who stands upright and looks there.

    Args:
        pose: Their camera.

    Returns:
        Rows of unit vectors; up is the world's, ahead and right are level.
    """
    up = np.array([0.0, 0.0, 1.0])
    # One who looks straight down walks where the top of the picture is.
    for direction in (pose.look_at - pose.position, pose.up):
        level = np.asarray(direction, np.float64) * (1.0, 1.0, 0.0)
        length = float(np.linalg.norm(level))
        if length > 1e-3 * float(np.linalg.norm(direction)):
            ahead = level / length
            return np.stack([ahead, np.cross(ahead, up), up])
    return np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def velocity_of(
    held: frozenset[str], axes: Float[ndarray, "3 3"], speed: float, turn_speed: float
) -> tuple[float, ...]:
    """Tell how held keys move a wrist.

    Args:
        held: The keys.
        axes: Ahead, right and up; see `view_axes`.
        speed: Of the wrist, whatever the number of keys [m/s].
        turn_speed: Likewise [rad/s].

    Returns:
        Velocity of the wrist [m/s], then its turning about the world's axes [rad/s].
    """
    parts: list[ndarray] = []
    for table, most in ((_MOVES, speed), (_TURNS, turn_speed)):
        way = np.zeros(3)
        for key in held & set(table):
            axis, sign = table[key]
            way += sign * axes[axis]
        length = float(np.linalg.norm(way))
        parts.append(way * (most / length) if length > 1e-9 else np.zeros(3))
    return tuple(float(value) for value in np.concatenate(parts))


PageListener = Callable[[str | None], None]


class KeyChannel:
    """Between the page of one session, which tells keys, and whoever steers in it.

    One page is heard at a time; another one that comes takes its place. Keys of a page that goes
    are let go.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._on_held: Callable[[frozenset[str]], None] | None = None
        self._on_press: Callable[[Press], None] | None = None
        self._listener: PageListener | None = None
        self._state: dict[str, Any] = {"steering": False}

    def attach(
        self, on_held: Callable[[frozenset[str]], None], on_press: Callable[[Press], None]
    ) -> None:
        """Hear keys.

        Args:
            on_held: Called with all keys that are held, when these change.
            on_press: Called when a key goes down.
        """
        with self._lock:
            self._on_held, self._on_press = on_held, on_press

    def detach(self) -> None:
        """Hear nothing any more."""
        with self._lock:
            self._on_held = self._on_press = None
        self.tell({"steering": False})

    def tell(self, state: dict[str, Any]) -> None:
        """Tell the page what is going on: whether hands are steered, and what to say about it."""
        with self._lock:
            if state == self._state:
                return
            self._state = state
            if self._listener is not None:
                self._listener(json.dumps(state))

    def listen(self, listener: PageListener) -> None:
        """Have a page told what is going on, now and whenever it changes.

        Args:
            listener: Gets the text to send; None when another page has taken its place.
        """
        with self._lock:
            before, self._listener = self._listener, listener
            if before is not None:
                before(None)
            listener(json.dumps(self._state))
        self._release()

    def leave(self, listener: PageListener) -> None:
        """Forget a page that is gone, and let go of its keys."""
        with self._lock:
            if self._listener is not listener:
                return
            self._listener = None
        self._release()

    def hear(self, text: str) -> None:
        """Take a message of the page.

        Raises:
            UsageError: If it is none; says what is wrong with it.
        """
        if len(text) > MOST_LETTERS:
            raise UsageError(f"A message has at most {MOST_LETTERS} letters, not {len(text)}.")
        try:
            message = decode_json(text, _FromPage)
        except (msgspec.DecodeError, UnicodeError) as error:
            raise UsageError(
                f'This is no message: {error}. Expected {{"held": ["KeyW", …]}} with keys among '
                f'{", ".join(get_args(HeldKey))}, or {{"press": …}}.'
            ) from error
        with self._lock:
            on_held, on_press = self._on_held, self._on_press
        if message.held is not None and on_held is not None:
            on_held(frozenset(message.held))
        if message.press is not None and on_press is not None:
            on_press(message.press)

    def _release(self) -> None:
        with self._lock:
            on_held = self._on_held
        if on_held is not None:
            on_held(frozenset())
