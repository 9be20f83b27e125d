"""Binds the keys of a live scene to functions."""

from collections.abc import Callable
from typing import Any

import viser

from app.keys import LAYER_KEYS, Action, key_of
from app.viewer.ui.guard import Guard


def bind(
    server: viser.ViserServer, guard: Guard, action: Action, act: Callable[[Any, int], None]
) -> list[viser.CommandHandle]:
    """Let the keys of an action, as `app.keys` lists them, call a function.

    Args:
        server: Where keys are pressed; its command palette lists them too.
        guard: Wraps the callback.
        action: Which keys.
        act: Gets the event and, if the action has several keys, which of them it was.

    Returns:
        The commands, for one who takes them away before the server stops.
    """
    key = key_of(action)
    commands: list[viser.CommandHandle] = []
    for number, hotkey in enumerate(key.hotkeys):
        name: Any = hotkey
        label = key.about
        if action == "layer":
            label = f"show or hide {LAYER_KEYS[number][1]}"
        command = server.gui.add_command(
            label[0].upper() + label[1:], hotkey=name, modifier=key.modifier
        )
        command.on_trigger(guard(lambda event, number=number: act(event, number)))
        commands.append(command)
    return commands
