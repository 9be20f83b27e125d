"""The file that shows a running fit: few frames, few points, replaced now and then.

``preview.safetensors`` in a run's folder holds for each kind of points an array of whole numbers
from 0 to 65,534 along each axis of a box, 65,535 where a point is not known; its metadata tell the
box and what is shown. 100 kB at most.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from physhandi.data.atomic import named_fields, write_atomically
from physhandi.data.checkpoint import packed
from physhandi.errors import RunError
from physhandi.progress import Preview

PREVIEW = "preview.safetensors"
MOST_FRAMES = 24
"""Frames of a preview; longer motions are shown with fewer frames a second."""
MOST_POINTS = {"object": 400, "control": 120, "seen": 120, "joints": 42}
"""Points of each kind in a frame."""
INTERVAL_S = 1.5
"""Least time between two previews."""
SHARE = 0.008
"""Most of a fit's time that previews may take; what is not used is saved up for dear ones."""
_UNKNOWN = 65535
_STEPS = 65534


class PreviewFile:
    """Writes previews of a run, so seldom that the fit does not feel it."""

    def __init__(self, run_folder: Path) -> None:
        """Prepare; the first preview is due at once, and what an earlier attempt showed goes."""
        self._path = run_folder / PREVIEW
        self._path.unlink(missing_ok=True)
        self._begin = time.monotonic()
        self._due = 0.0
        self._number = 0
        self.spent_s = 0.0
        """Time that all previews took together."""

    def is_due(self) -> bool:
        """Tell whether it is time for another preview."""
        return time.monotonic() >= self._due

    def write(self, make: Callable[[], Preview]) -> None:
        """Replace the file, and put the next one off until all took at most `SHARE` of the time."""
        begin = time.monotonic()
        self._number += 1
        content = encode(make(), self._number)
        write_atomically(self._path, lambda stream: stream.write(content), is_durable=False)
        self.spent_s += time.monotonic() - begin
        self._due = max(begin + INTERVAL_S, self._begin + self.spent_s / SHARE)


def encode(preview: Preview, number: int) -> bytes:
    """Make the content of the file.

    Args:
        preview: What to show.
        number: How many previews of the attempt there were, this one included.
    """
    picked: dict[str, ndarray] = {}
    known: dict[str, ndarray] = dict(preview.points)
    count = len(next(iter(known.values())))
    frames = _spread(count, min(count, MOST_FRAMES))
    for kind, points in known.items():
        most = min(points.shape[1], MOST_POINTS[kind])
        kept = _spread(points.shape[1], most)
        picked[kind] = np.asarray(points[frames][:, kept], np.float32)
    # What runs away must not shrink the rest to a dot: the box is that of the first frame, with
    # room for the motion of hands around it.
    low, side = _box(picked)
    arrays: dict[str, ndarray] = {}
    for kind, points in picked.items():
        unit = (points - low) / side
        is_known = np.isfinite(unit).all(axis=-1, keepdims=True)
        whole = np.round(np.clip(np.nan_to_num(unit), 0.0, 1.0) * _STEPS)
        arrays[kind] = np.where(is_known, whole, _UNKNOWN).astype(np.uint16)
    about = {
        "stage": preview.stage,
        "sequence": preview.sequence,
        "loss": preview.loss if np.isfinite(preview.loss) else None,
        "frame_rate": preview.frame_rate,
        "frames": frames.tolist(),
        "low": low.tolist(),
        "side": side,
        "number": number,
    }
    return save(packed(arrays), metadata={"about": json.dumps(about)})


def read_preview(run_folder: Path) -> tuple[dict[str, Any], dict[str, Float[ndarray, "f p 3"]]]:
    """Read a run's preview.

    Returns:
        What is shown (``stage sequence loss frame_rate frames low side number``), and the points
        of each kind, NaN where they are not known [m].

    Raises:
        RunError: If there is none, or it is damaged.
    """
    path = run_folder / PREVIEW
    try:
        opened: Any = safe_open(path, framework="numpy")
        with opened as stream:
            about = named_fields(json.loads(dict(stream.metadata() or {})["about"])) or {}
            arrays = {str(kind): np.asarray(stream.get_tensor(kind)) for kind in stream.keys()}  # noqa: SIM118
        points: dict[str, ndarray] = {}
        for kind, whole in arrays.items():
            metres = np.asarray(about["low"]) + whole / _STEPS * float(about["side"])
            points[kind] = np.where(whole == _UNKNOWN, np.nan, metres)
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {error}.") from error
    return about, points


def _spread(count: int, most: int) -> Int[ndarray, " kept"]:
    """Choose so many of the numbers from 0 to `count` - 1, evenly and with both ends."""
    return np.rint(np.linspace(0, count - 1, most)).astype(np.int64)


def _box(picked: dict[str, Float[ndarray, "frame point 3"]]) -> tuple[ndarray, float]:
    """Find a cube that holds what is shown; of simulated points only those of the first frame.

    Returns:
        Its lower corner and its side [m].
    """
    sure = [
        (points[:1] if kind == "object" else points).reshape(-1, 3)
        for kind, points in picked.items()
    ]
    everything = np.concatenate(sure)
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        return np.zeros(3), 1.0
    low, high = everything.min(axis=0), everything.max(axis=0)
    side = 1.3 * max(float((high - low).max()), 1e-3)
    return np.asarray((low + high) / 2 - side / 2, float), side
