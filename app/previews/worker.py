"""The process that draws previews: reads what to draw from its input, writes files, ends."""

import logging
import math
import os
import resource
import time
from collections.abc import Mapping
from pathlib import Path

import cv2

from app.previews.files import MOVING, NONE, SECONDS_EACH, STILL
from physhandi.child import Channel, loading_modules, run_child
from physhandi.data.files import write_bytes
from physhandi.errors import describe

_POLITENESS = 10


def draw(order: Mapping[str, str], *, is_still: bool) -> None:
    """Draw one preview, or note why that cannot be done.

    Args:
        order: ``kind`` (``sequence`` or ``run``), ``folder`` to show, and ``target``, the path of
            the files without their endings.
        is_still: Whether to draw the still picture; else the moving one.
    """
    target = order["target"]
    if Path(f"{target}{NONE}").exists():
        return
    from app.previews.clip import clip_of_run, clip_of_sequence

    show = clip_of_run if order["kind"] == "run" else clip_of_sequence
    try:
        clip = show(Path(order["folder"]), is_still=is_still)
        if clip is None:
            reason = "There is nothing to show."
        else:
            if is_still:
                clip.write_still(Path(f"{target}{STILL}"))
            else:
                clip.write_moving(Path(f"{target}{MOVING}"))
            return
    except Exception as error:  # noqa: BLE001  # whatever is wrong with it, the next one is drawn
        reason = describe(error)
    write_bytes(Path(f"{target}{NONE}"), reason.encode())


def draw_all(channel: Channel) -> None:
    """Draw what the server asks for, out of its way."""
    os.nice(_POLITENESS)
    with loading_modules():
        import app.previews.clip  # noqa: F401  # before time counts
    cv2.setNumThreads(1)
    logging.getLogger("physhandi").setLevel(logging.ERROR)
    orders: list[dict[str, str]] = list(channel.requests())
    most = math.ceil(time.process_time() + SECONDS_EACH * len(orders))
    resource.setrlimit(resource.RLIMIT_CPU, (most, most))
    # A list is told apart by its still pictures, so all of those come first.
    for is_still in (True, False):
        for order in orders:
            draw(order, is_still=is_still)


if __name__ == "__main__":
    run_child(draw_all)
