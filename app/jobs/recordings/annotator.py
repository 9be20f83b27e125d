"""The process that finds masks and tracks of a recording."""

from typing import Any

from app.jobs.recordings.ordered import work_on_order
from physhandi.perception.annotation import annotate
from physhandi.perception.segmentation import Click
from physhandi.progress import Progress


def annotate_order(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Annotate the sequence that the order names."""
    clicks = [Click(**click) for click in order["clicks"]]
    annotate(order["folder"], clicks, progress, overwrite=order["overwrite"])
    return {}


if __name__ == "__main__":
    work_on_order(annotate_order)
