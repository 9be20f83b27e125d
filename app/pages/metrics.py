"""Scores as tables: units that people read, what is best, and what each rival is."""

from typing import Any, cast

from app.pages.render import short, words
from physhandi.data.files import named_fields
from physhandi.settings import flatten

METHOD_TEXTS = {
    "rollout": "The fitted object, simulated from frame 0 on with the motion of the hand.",
    "static": "Baseline: the object stays as it is in frame 0.",
    "rigid_follow": "Baseline: the object of frame 0 moves rigidly with the control nodes.",
    "last_residual": "Baseline: the rollout, shifted by what it missed in the last fitted frame.",
}
"""Explanations of the columns of a comparison."""
_HIGHER = {"accuracy", "iou", "precision", "recall", "f1", "psnr", "ssim"}
_SHARES = {"accuracy", "iou", "precision", "recall", "f1", "share"}
_LENGTHS = {"chamfer", "error", "mpjpe", "mpvpe", "distance", "spacing", "resolution", "radius"}
_COUNTS = {"frames", "count", "scored", "seed", "keypoints"}
_ABOUT = (
    ("phystwin_psnr", "As PhysTwin: first view, whole image with its black background."),
    ("phystwin_ssim", "As PhysTwin: first view, whole image with its black background."),
    ("phystwin_lpips", "As PhysTwin: first view, whole image with its black background."),
    ("phystwin_iou", "As PhysTwin: first view, any trace of the picture counts as covered."),
    ("psnr", "Pictures against the recording, only where the object or its picture is."),
    ("ssim", "Structural similarity of pictures, only where the object or its picture is."),
    ("lpips", "How different a network finds them, only where the object or its picture is."),
    ("proper_iou", "Silhouettes of picture and mask, without the hands, in all views."),
    ("held_out_iou", "Silhouettes of picture and mask, in views that no fit saw."),
    ("chamfer_dynamic", "Only over observed points that move more than 10 mm from frame 0."),
    ("chamfer_truth_to_nodes", "From each point of the true surface to the nearest node."),
    ("chamfer_nodes_to_truth", "From each node of the surface to the true surface."),
    ("chamfer_truth", "Mean of both ways between the object and the true surface."),
    ("chamfer_symmetric", "Mean of both ways between observed points and the object or hand."),
    ("chamfer_phystwin", "From observed points to the nearest node, as PhysTwin evaluates it."),
    ("chamfer_l1", "From each observed point to its nearest node, in the L1 norm."),
    ("chamfer_l2", "From each observed point to its nearest node, the straight distance."),
    ("chamfer_points_to_mesh", "From each observed point of the hand to the fitted hand."),
    ("chamfer_mesh_to_points", "From each vertex of the fitted hand to the observed points."),
    ("track_error_phystwin", "Track error as PhysTwin evaluates it: to the nearest node."),
    ("track_error", "From each tracked point to where the object has moved it."),
    ("marker_error", "From each marker to its node."),
    ("reprojection", "Joints of the hand against the detected keypoints, in the images."),
    ("rrd", "How far connection radius over resolution is from 3: |(δ/Δx)/3 - 1|."),
    ("resolution", "Δx: mean distance of the nodes to their four nearest neighbours."),
    ("mpjpe", "Mean distance of the hand's joints to the true ones."),
    ("accuracy_proximity", "As accuracy, against what is this near on true hand and surface."),
    ("f1_proximity", "As F1, against what is this near on true hand and true surface."),
    (
        "accuracy",
        "Share of nodes with rightly predicted contact, at this distance to the hand.",
    ),
    ("precision", "Of the nodes predicted to be in contact, the share that is."),
    ("recall", "Of the nodes in contact, the share that is predicted to be."),
    ("f1", "Harmonic mean of precision and recall of contact."),
    ("predicted_share", "Share of nodes that are predicted to be in contact."),
    ("label_share", "Share of nodes that are in contact by the labels."),
    ("known_share", "Share of nodes whose contact could be labelled."),
    ("iou", "Nodes in contact in both over nodes in contact in either."),
)


def tabulate(scores: Any) -> dict[str, Any]:
    """Arrange the scores of a sequence as tables; single facts become notes.

    Returns:
        ``tables``, each with ``name note columns rows``: a column has ``name about``, a row
        ``name about unit is_higher_better`` and ``cells`` of ``text is_best``. Only rivals that
        include the rollout are compared. Then ``notes``, pairs of a name and a text.
    """
    tables: list[dict[str, Any]] = []
    notes: list[tuple[str, str]] = []
    fields = named_fields(scores) or {}
    unit = str(fields.get("unit", "m"))
    for name, part in fields.items():
        inside = named_fields(part)
        if inside is None:
            if name not in {"unit", "warnings"}:
                notes.append((words(name), _fact(name, part)))
            continue
        columns = {
            key: inner for key, v in inside.items() if (inner := named_fields(v)) is not None
        }
        facts = {key: v for key, v in inside.items() if key not in columns and key != "unit"}
        if not columns:
            columns, facts = {"value": facts}, {}
        columns = {key: _in_one_row(column) for key, column in columns.items()}
        rows = _rows(columns, str(inside.get("unit", unit)))
        facts |= {
            key: value
            for column in columns.values()
            for key, value in column.items()
            if key != "unit" and not isinstance(value, int | float | None)
        }
        note = ", ".join(f"{words(key)} {_fact(key, v)}" for key, v in facts.items())
        heads = [{"name": key, "about": METHOD_TEXTS.get(key, "")} for key in columns]
        tables.append({"name": name, "note": note, "columns": heads, "rows": rows})
    return {"tables": tables, "notes": notes}


def _in_one_row(column: dict[str, Any]) -> dict[str, Any]:
    """Join the names of scores that belong together, such as those of pictures."""
    return {path.replace(".", "_"): value for path, value in flatten(column).items()}


def scaled(value: Any, unit: str) -> tuple[Any, str]:
    """Turn metres into millimetres and shares into percent; leave the rest."""
    factor, shown = {"m": (1000.0, "mm"), "share": (100.0, "%")}.get(unit, (1.0, unit))
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value * factor if is_number and factor != 1.0 else value), shown


def _rows(columns: dict[str, dict[str, Any]], unit: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for quantity in dict.fromkeys(key for column in columns.values() for key in column):
        values = [column.get(quantity) for column in columns.values()]
        numbers = [value for value in values if isinstance(value, int | float)]
        if not numbers:
            continue
        parts = set(quantity.split("_"))
        local = next((str(c["unit"]) for c in columns.values() if "unit" in c), unit)
        kind = unit_of_metric(parts, local)
        is_higher = is_better_when_higher(parts)
        is_contest = "rollout" in columns and len(numbers) > 1 and not parts & _COUNTS
        best = (max if is_higher else min)(numbers) if is_contest else None
        rows.append(
            {
                "name": quantity,
                "about": about_quantity(quantity),
                "unit": scaled(None, kind)[1],
                "is_higher_better": is_higher,
                "cells": [
                    {
                        "text": figure(scaled(value, kind)[0]),
                        "is_best": best is not None and value == best,
                    }
                    for value in values
                ],
            }
        )
    return rows


def about_quantity(name: str) -> str:
    """Tell what a quantity means; empty if its name says it all."""
    joined = name.replace(".", "_")
    return next((text for start, text in _ABOUT if start in joined), "")


def is_better_when_higher(parts: set[str]) -> bool:
    """Tell by the words of its name whether more of a quantity is better."""
    return bool(parts & _HIGHER)


def is_count(parts: set[str]) -> bool:
    """Tell by the words of its name whether a quantity counts what was measured."""
    return bool(parts & _COUNTS)


def figure(value: Any) -> str:
    """Show four digits, the last ones too if they are zero, so that columns compare."""
    if not isinstance(value, int | float):
        return "–"  # noqa: RUF001  # a dash, as tables have it
    is_plain = isinstance(value, float) and 1e-3 <= abs(value) < 1e3
    return f"{value:#.4g}" if is_plain else short(value)


def unit_of_metric(parts: set[str], unit: str) -> str:
    """Tell what a quantity is measured in by the words of its name; empty for a mere number."""
    if parts & _COUNTS:
        return ""
    if parts & _SHARES:
        return "share"
    if "reprojection" in parts:
        return "px"
    if "psnr" in parts:
        return "dB"
    return unit if parts & _LENGTHS else ""


def _fact(name: str, value: Any) -> str:
    match (name, cast("object", value)):
        case "frames", [int(first), int(end)]:
            return f"{first} to {end - 1}"
        case _:
            pass
    fields = named_fields(value)
    if fields is not None:
        return ", ".join(f"{words(key)} {_fact(key, inner)}" for key, inner in fields.items())
    kind = unit_of_metric(set(name.split("_")), "m")
    shown, unit = scaled(value, kind)
    return f"{short(shown)} {unit}".strip()
