"""What a new attempt takes over from the one before."""

import os
import shutil
from pathlib import Path
from typing import Any, cast

from physhandi.data.atomic import named_fields, write_json
from physhandi.data.run_files import (
    ATTEMPTS,
    CHECKPOINTS,
    CURRENT,
    OUT,
    STAGES,
    artefacts,
    attempt_numbers,
    find_damage,
    inside,
    read_json,
)
from physhandi.errors import RunError


def take_over(previous: Path, folder: Path) -> list[dict[str, Any]]:
    """Link the files of finished stages and the checkpoints of the attempt before.

    Args:
        previous: Folder of the attempt before.
        folder: Folder of the new attempt.

    Returns:
        The leading finished stages whose files are all still what they were.
    """
    stages = _whole_stages(previous) if (previous / STAGES).is_file() else []
    for stage in stages:
        for rel in stage["files"]:
            _link(inside(previous / OUT, rel), inside(folder / OUT, rel))
    for rel, path in artefacts(previous / CHECKPOINTS):
        _link(path, inside(folder / CHECKPOINTS, rel))
    if stages:
        write_json(folder / STAGES, stages)
    return stages


def prune(run_folder: Path, keep: set[int]) -> None:
    """Remove attempts that are neither to be kept nor published."""
    current = run_folder / CURRENT
    text = current.read_text().strip() if current.is_file() else ""
    published = {int(text)} if text.isdigit() else set[int]()
    for number in set(attempt_numbers(run_folder)) - keep - published:
        shutil.rmtree(run_folder / ATTEMPTS / str(number), ignore_errors=True)


def _whole_stages(previous: Path) -> list[dict[str, Any]]:
    """Give the leading finished stages whose files are all still what they were."""
    stages = _listed_stages(previous / STAGES)
    latest: dict[str, Any] = {}
    for stage in stages:
        latest |= stage["files"]
    for count, stage in enumerate(stages):
        files = {rel: latest[rel] for rel in stage["files"]}
        if find_damage(previous / OUT, files) is not None:
            return stages[:count]
    return stages


def _listed_stages(path: Path) -> list[dict[str, Any]]:
    """Read the list of finished stages; a damaged one proves nothing, so none is finished."""
    try:
        content = read_json(path)
    except RunError:
        return []
    entries: list[Any] = cast("list[Any]", content) if isinstance(content, list) else [None]
    stages = [named_fields(entry) or {} for entry in entries]
    is_whole = all(
        isinstance(stage.get("name"), str)
        and isinstance(stage.get("files"), dict)
        and isinstance(stage.get("summary"), dict)
        for stage in stages
    )
    return stages if is_whole else []


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:  # Some file systems have no hard links.
        shutil.copy2(source, target)
