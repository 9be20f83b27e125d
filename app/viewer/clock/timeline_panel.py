"""The clock of one session in its panel and under its keys."""

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from app.keys import Action
from app.viewer.clock.playback import Playback
from app.viewer.ui.guard import Guard
from app.viewer.ui.keyboard import bind

_SETTLED = 0.3
"""Time without a scrub after which the slider is told once more where it stands [s]."""
_SPEEDS = (0.1, 2.0)
_PACES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
"""Speeds that keys step through."""


class TimelinePanel:
    """Play, scrub, step, speed and loop, with hot keys."""

    def __init__(
        self,
        server: viser.ViserServer,
        playback: Playback,
        guard: Guard,
        *,
        pace: viser.GuiTabHandle,
    ) -> None:
        """Add the clock.

        Args:
            server: Where to.
            playback: The clock.
            guard: Wraps the callbacks.
            pace: Where step, speed and loop are, which are needed less often.
        """
        self._playback = playback
        self._loop_of_events = server.get_event_loop()
        self._settling: asyncio.TimerHandle | None = None
        gui = server.gui
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY, hint="Space")
        self._frame = gui.add_slider(
            "Frame", 0, max(playback.frame_count - 1, 1), 1, 0, hint="Arrow keys step by one frame"
        )
        with pace:
            step = gui.add_button_group("Step", ("◀ 1", "1 ▶"), hint="Left and right arrow keys")
            speed = gui.add_slider("Speed", *_SPEEDS, 0.1, 1.0, hint="Sequence seconds per second")
            loop = gui.add_checkbox("Loop", initial_value=True)
            last = max(playback.frame_count - 1, 1)
            self._part = gui.add_multi_slider(
                "Part",
                0,
                last,
                1,
                (0, last),
                min_range=1,
                hint="Frames that are played; keys I and O set its ends to the frame that is shown",
            )
        self._speed, self._loop = speed, loop

        self._play.on_click(guard(lambda _: playback.toggle()))
        self._frame.on_update(self._scrub)
        step.on_click(guard(lambda event: playback.step(1 if event.target.value == "1 ▶" else -1)))
        speed.on_update(guard.by_user(lambda _: playback.set_speed(speed.value)))
        loop.on_update(guard.by_user(lambda _: playback.set_loop(on=loop.value)))
        self._part.on_update(guard.by_user(lambda _: playback.set_part(*self._part.value)))
        actions: dict[Action, Callable[[], None]] = {
            "play": playback.toggle,
            "next": lambda: playback.step(1),
            "previous": lambda: playback.step(-1),
            "ten_on": lambda: playback.step(10),
            "ten_back": lambda: playback.step(-10),
            "first": lambda: self.go(0),
            "last": lambda: self.go(playback.frame_count - 1),
            "slower": lambda: self._hurry(-1),
            "pause": lambda: playback.play(on=False),
            "faster": lambda: self._hurry(1),
            "part_begin": lambda: self._cut(begins=True),
            "part_end": lambda: self._cut(begins=False),
        }
        for action, act in actions.items():
            bind(server, guard, action, lambda _, __, act=act: act())

    @property
    def behind_slider(self) -> float:
        """Order of what stands directly below the frame slider."""
        return self._frame.order + 0.1

    def show(self, *, is_playing: bool) -> None:
        """Follow the clock."""
        self._loop_of_events.call_soon_threadsafe(self._follow)
        label = "Pause" if is_playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if is_playing else viser.Icon.PLAYER_PLAY

    def replace(self, frame_count: int) -> None:
        """Fit the slider to another sequence."""
        self._frame.value = 0
        self._frame.max = self._part.max = max(frame_count - 1, 1)
        self._show_part()

    def restore(self, speed: float, *, does_loop: bool, part: tuple[int, int] | None) -> None:
        """Run the clock as it ran in another session."""
        self._speed.value, self._loop.value = speed, does_loop
        self._playback.set_speed(speed)
        self._playback.set_loop(on=does_loop)
        if part is not None:
            self._playback.set_part(*part)
            self._show_part()

    def go(self, frame: int) -> None:
        """Stop at a frame."""
        self._playback.play(on=False)
        self._playback.seek(frame)

    def _cut(self, *, begins: bool) -> None:
        """Let the part that is played begin or end at this frame, two frames long at least."""
        frame, last = self._playback.frame, self._playback.frame_count - 1
        first, end = self._playback.part or (0, last)
        if begins:
            first = min(frame, last - 1)
            end = end if end > first else last
        else:
            end = max(frame, 1)
            first = first if first < end else 0
        self._playback.set_part(first, end)
        self._show_part()

    def _show_part(self) -> None:
        """Show what is played."""
        self._part.value = self._playback.part or (0, max(self._playback.frame_count - 1, 1))

    def _follow(self) -> None:
        """Move the slider to where the clock is.

        Runs in viser's own thread, between two messages of users: written from another one, a frame
        could take the place of the value that a user has just chosen and nobody has heard of yet.
        """
        self._frame.value = self._playback.frame

    def _hurry(self, steps: int) -> None:
        """Play slower or faster, and start if the clock stands."""
        now = self._playback.speed
        index = int(np.argmin([abs(now - speed) for speed in _PACES])) + steps
        speed = _PACES[min(max(index, 0), len(_PACES) - 1)]
        self._playback.set_speed(speed)
        self._playback.play()
        self._speed.value = speed

    async def _scrub(self, event: Any) -> None:
        # At once, in viser's own thread, so that the running clock has no time to interfere.
        frame = event.target.value
        if event.client is not None:
            was_playing = self._playback.is_playing
            self._playback.play(on=False)
            self._playback.seek(frame)
            if self._settling is not None:
                self._settling.cancel()
            if was_playing or self._settling is not None:
                self._settling = self._loop_of_events.call_later(_SETTLED, self._settle)

    def _settle(self) -> None:
        """Send the slider its value again after a scrub that stopped the clock.

        A frame of the running clock may have met the user's choice on its way, and moved the slider
        away from it after it was sent. Viser sends no value that it believes to be there already:
        another one comes first, which it does not send in the end.
        """
        self._settling = None
        frame = self._playback.frame
        self._frame.value = frame - 1 if frame > 0 else 1
        self._frame.value = frame
