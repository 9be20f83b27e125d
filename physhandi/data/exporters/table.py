"""Motion, parameters and metrics as NPZ, CSV and YAML."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.files import (
    json_line,
    named_fields,
    plain,
    write_atomically,
    write_bytes,
    write_yaml,
)
from physhandi.data.layout import LOSSES_FILE, METRICS_FILE, PARAMETERS_FILE
from physhandi.data.run import RunFolder

_FORMULA_START = ("=", "+", "-", "@", "\t", "\r")
_SHARED_FILES = (
    ("parameters", PARAMETERS_FILE),
    ("losses", LOSSES_FILE),
    ("metrics", METRICS_FILE),
)
TRAJECTORY_COLUMNS = ("sequence", "frame", "time_s", "kind", "index", "x", "y", "z")


def write_npz(path: Path, scene: SceneData) -> None:
    """Write the motion and the springs as one NPZ archive without pickles."""
    arrays: dict[str, Any] = {
        "sequence": np.array(scene.sequence),
        "frame_rate": np.array(scene.frame_rate),
        "length_unit": np.array(scene.length_unit),
        "rollout": scene.rollout,
        "control": scene.control,
    }
    for side, hand in scene.hands.items():
        arrays[f"hand_{side}_vertex"] = hand.vertex
        if hand.face is not None:
            arrays[f"hand_{side}_face"] = hand.face
    arrays |= scene.model
    write_atomically(path, lambda stream: np.savez(stream, allow_pickle=False, **arrays))


def write_trajectories(path: Path, scene: SceneData) -> None:
    """Write every node, and every joint of a hand, in every frame as one row of a CSV file."""
    write_csv(path, TRAJECTORY_COLUMNS, _trajectory_rows(scene))


def write_tables(folder: Path, run: RunFolder, scene: SceneData) -> None:
    """Write ``trajectories.csv``, ``parameters.csv`` and ``metrics.csv``."""
    write_trajectories(folder / "trajectories.csv", scene)
    for name, rel in (_SHARED_FILES[0], _SHARED_FILES[2]):
        if run.has(rel):
            content = run.yaml(rel) if rel.endswith(".yaml") else run.json(rel)
            write_csv(folder / f"{name}.csv", ("name", "value"), flat(content))


def write_summary(path: Path, run: RunFolder) -> None:
    """Write settings, fitted parameters, losses and metrics of a run as YAML."""
    content: dict[str, Any] = {
        "run": run.id,
        "name": run.name,
        "kind": run.kind,
        "state": run.state,
        "created": run.created,
        "sequences": run.sequence_names,
        "config": run.config,
    }
    for name, rel in _SHARED_FILES:
        if run.has(rel):
            content[name] = run.yaml(rel) if rel.endswith(".yaml") else run.json(rel)
    write_yaml(path, content)


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file; see `csv_bytes`."""
    write_bytes(path, csv_bytes(columns, rows))


def csv_bytes(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> bytes:
    """Encode a table as CSV that is safe to open in a spreadsheet; see `safe_cell`."""
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([safe_cell(column) for column in columns])
    writer.writerows([safe_cell(cell) for cell in row] for row in rows)
    return buffer.getvalue().encode()


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Encode arrays by their names as a compressed NPZ archive without pickles."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def safe_cell(value: Any) -> Any:
    """Prefix text that a spreadsheet would run as a formula with an apostrophe."""
    if isinstance(value, str) and value.lstrip(" ").startswith(_FORMULA_START):
        return "'" + value
    return "" if value is None else value


def flat(content: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Walk through nested named fields; names are joined by dots, lists are one text."""
    fields: Mapping[str, Any] | None = named_fields(content)
    if fields is None:
        is_list = isinstance(content, list | tuple | ndarray)
        yield prefix, json_line(content) if is_list else plain(content)
        return
    for name, value in fields.items():
        yield from flat(value, f"{prefix}.{name}" if prefix else name)


def _trajectory_rows(scene: SceneData) -> Iterator[tuple[Any, ...]]:
    kinds = [("object", scene.rollout), ("control", scene.control)]
    kinds += [(f"hand_{side}", joint) for side, joint in scene.joints.items()]
    for frame in range(scene.frame_count):
        time = round(frame / scene.frame_rate, 6)
        for kind, position in kinds:
            for index, (x, y, z) in enumerate(position[frame].tolist()):
                row = scene.sequence, frame, time, kind, index
                yield *row, *rounded((x, y, z))


def rounded(values: Iterable[Any]) -> list[float]:
    """Keep nine digits of numbers, which bring every 32-bit number back exactly."""
    return [float(f"{value:.9g}") for value in values]
