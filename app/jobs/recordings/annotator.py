"""The process that finds masks and tracks of a recording."""

from typing import Any

import numpy as np

from app.jobs.recordings.ordered import work_on_order
from physhandi.perception.annotation import Correction, annotate, correct_masks
from physhandi.perception.segmentation import Click
from physhandi.progress import Progress


def annotate_order(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Annotate the sequence that the order names, or correct its masks."""
    if "masks" in order:
        corrections = [_correction(**mask) for mask in order["masks"]]
        correct_masks(order["folder"], corrections, progress, carries_on=order["carries_on"])
        return {}
    clicks = [Click(**click) for click in order["clicks"]]
    annotate(order["folder"], clicks, progress, overwrite=order["overwrite"])
    return {}


def _correction(view: str, frame: int, width: int, runs: list[int]) -> Correction:
    label = np.repeat(np.array(runs[::2], np.uint8), runs[1::2])
    return Correction(view, frame, label.reshape(-1, width))


if __name__ == "__main__":
    work_on_order(annotate_order)
