"""The process that looks at recordings, imports them and writes the example."""

from pathlib import Path
from typing import Any

from app.jobs.recordings.ordered import work_on_order
from physhandi.data.importers.board_calibration import parse_board
from physhandi.data.importers.capture import CaptureOptions, import_capture, survey_capture
from physhandi.progress import Progress


def import_order(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Do what the order names."""
    match order["work"]:
        case "survey":
            return survey_capture(order["source"], _options(order["options"])).to_dict()
        case "import":
            sequence = import_capture(
                order["source"],
                order["out"],
                progress,
                options=_options(order["options"]),
                overwrite=order["overwrite"],
            )
            return {"sequence": sequence.folder.name, "notes": sequence.provenance["notes"]}
        case _:
            from physhandi.synthetic.raw_capture import write_example_capture

            return {"capture": write_example_capture(order["out"], progress).name}


def _options(plain: dict[str, Any]) -> CaptureOptions:
    fields = dict(plain)
    board = parse_board(fields.pop("charuco", ""), fields.pop("april_grid", ""))
    intrinsics: str | None = fields.pop("intrinsics")
    if "hands" in fields:
        fields["hands"] = tuple(fields["hands"])
    return CaptureOptions(
        **fields, board=board, intrinsics=None if intrinsics is None else Path(intrinsics)
    )


if __name__ == "__main__":
    work_on_order(import_order)
