"""A process in the place of the one that annotates, which does what its first click says."""

import json
from pathlib import Path
from typing import Any

from physhandi.child import Channel, run_child
from physhandi.errors import CancelledError, UsageError


def work(channel: Channel) -> None:
    requests = channel.requests()
    order: dict[str, Any] = next(requests)
    channel.tell(stage="segmentation", iteration=1, total=8, message="")
    if order["clicks"][0]["view"] == "waits":
        assert next(requests) == "cancel"
        raise CancelledError("Cancelled; nothing was changed.")
    if order["clicks"][0]["view"] == "dies":
        raise SystemExit(3)
    if not order["overwrite"]:
        raise UsageError("It has masks that were not made here.")
    (Path(order["folder"]) / "found.txt").write_text(str(order["clicks"]))
    (Path(order["folder"]) / "models.json").write_text(json.dumps(order["models"]))


if __name__ == "__main__":
    run_child(work)
