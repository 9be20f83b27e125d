"""The process that finds masks and tracks of a recording."""

from pathlib import Path
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
    models = order["models"]
    annotate(
        order["folder"],
        clicks,
        progress,
        overwrite=order["overwrite"],
        mask_model=_folder(models["mask_model"]),
        track_model=_folder(models["track_model"]),
        trusts_model_code=models["trusts_model_code"],
    )
    return {}


def _folder(path: str | None) -> Path | None:
    return None if path is None else Path(path)


def _correction(view: str, frame: int, width: int, runs: list[int]) -> Correction:
    label = np.repeat(np.array(runs[::2], np.uint8), runs[1::2])
    return Correction(view, frame, label.reshape(-1, width))


if __name__ == "__main__":
    work_on_order(annotate_order)
