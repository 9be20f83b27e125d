"""Parts of the benchmarks, and choices of their commands."""

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
CaptureSize = Literal["half", "full"]
"""Size of the pictures of a capture: 424x240 or 848x480."""
FitProfile = Literal["quick", "none"]
"""Profile of the fits of a capture, or none."""
PARTS: tuple[Part, ...] = get_args(Part)
