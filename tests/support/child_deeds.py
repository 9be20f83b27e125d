"""What child processes do in tests of them: their first argument names it."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from physhandi.child import Channel, run_child
from physhandi.errors import CancelledError, UsageError


def crash() -> None:
    os.write(1, b"the last words\n")
    os._exit(7)


def start_another(channel: Channel) -> None:
    other = subprocess.Popen(["sleep", "300"])
    channel.tell(pid=other.pid)
    signal.pause()


def fail(error: BaseException) -> None:
    raise error


DEEDS: dict[str, Callable[[Channel], None]] = {
    "echo": lambda channel: [channel.tell(heard=r) for r in channel.requests()] and None,
    "print": lambda channel: print("δ") or channel.tell(said=True),  # noqa: T201
    "about": lambda channel: channel.tell(
        folder=str(Path.cwd()),
        environment=dict(os.environ),
        session=os.getsid(0) == os.getpid(),
        arguments=channel.arguments,
    ),
    "usage": lambda _: fail(UsageError("width: 3 is too small.")),
    "defect": lambda _: fail(KeyError("node")),
    "disk": lambda _: fail(OSError(28, "No space left on device", "/there")),
    "cancelled": lambda _: fail(CancelledError("stopped")),
    "silent": lambda _: sys.exit(5),
    "crash": lambda _: crash(),
    "forever": lambda _: signal.pause(),
    "another": start_another,
}


if __name__ == "__main__":
    run_child(lambda channel: DEEDS[channel.arguments[0]](channel))
