"""What of the viewer can be measured on its own."""

from typing import Literal, get_args

Part = Literal[
    "paint",
    "open",
    "scrub",
    "slider",
    "browser",
    "start",
    "bytes",
    "sessions",
    "runs",
    "live",
    "splats",
]
"""One thing that can be measured on its own."""
PARTS: tuple[Part, ...] = get_args(Part)
