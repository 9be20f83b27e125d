"""A viser server that only this machine reaches."""

from typing import Any

import rich
import viser
import viser._messages as messages


def start_viser(label: str) -> viser.ViserServer:
    """Start a viser server on a free loopback port.

    Args:
        label: Title of its panel; must be harmless as HTML.
    """
    rich.get_console().quiet = True  # viser would print its loopback address, which misleads.
    server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
    # Any client could ask for a public tunnel with this message.
    infrastructure: Any = server._websock_server  # pyright: ignore[reportPrivateUsage]  # no other way
    infrastructure.unregister_handler(messages.ShareUrlRequest)
    return server
