"""Readers of small files, which are damaged by types and structure as fast as they can be read."""

import json
import logging
import shutil
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml
from damaged_files import damage_file
from server_world import fit_sheet
from sheet_sequence import write_sheet

from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.uploads import Uploads
from app.jobs.ticket import QUEUED, Ticket, read_ticket
from app.settings import ServerSettings
from physhandi.data.sequence import Sequence
from physhandi.errors import PhysHandiError
from physhandi.run import Run
from reliability import Case, Report

logger = logging.getLogger(__name__)


def _readers(folder: Path) -> dict[str, tuple[Path, Callable[[], object]]]:
    """Make a folder of each kind; gives for each reader its file, and what reads it."""
    settings = ServerSettings(data_dir=folder)
    sheet = write_sheet(settings.sequence_dir / "sheet").folder
    run = fit_sheet(settings.run_dir / "run", sheet).folder
    (run / QUEUED).write_text(json.dumps(asdict(Ticket(time=1.0, who="somebody"))))
    sent = Uploads(settings, BackgroundTasks()).begin("take", [("a/0.png", 3), ("b.csv", 7)])
    about = next((folder / "incoming").rglob("upload.json"))
    return {
        "run.yaml": (run / "run.yaml", lambda: Run.open(run)),
        "job.yaml": (run / "job.yaml", lambda: Run.open(run).sequence_names),
        "sequence.yaml": (sheet / "sequence.yaml", lambda: Sequence.load(sheet)),
        "progress.json": (run / "progress.json", lambda: Run.open(run).progress),
        "queued.json": (run / QUEUED, lambda: read_ticket(run / QUEUED)),
        "upload.json": (
            about,
            lambda: Uploads(settings, BackgroundTasks()).describe(sent["id"]),
        ),
    }


def _damage(path: Path, chance: np.random.Generator) -> None:
    """Damage a file in a place, or in two if it can be taken apart after the first."""
    for place in range(int(chance.integers(1, 3))):
        try:
            damage_file(path, lambda options: options[int(chance.integers(len(options)))])
        except (yaml.YAMLError, ValueError, TypeError, RecursionError):
            assert place  # The whole file can be taken apart.


def damage_for(seconds: float, folder: Path, *, most: int | None = None) -> Report:
    """Damage the file of each reader for some processor time [s], or so many times in all."""
    counts: Counter[str] = Counter(done=0, refused=0, wrong=0)
    readers = _readers(folder)
    for number, (name, (path, read)) in enumerate(readers.items()):
        chance = np.random.default_rng(number)
        original = shutil.copy(path, folder / f"{number}.original")
        share = None if most is None else most // len(readers) + (number < most % len(readers))
        begin, times = time.process_time(), 0
        while times < share if share is not None else time.process_time() - begin < seconds:
            _damage(path, chance)
            damaged = path.read_bytes()
            try:
                read()
            except PhysHandiError:
                counts["refused"] += 1
            except Exception:  # Whatever it is, nobody foresaw it.
                counts["wrong"] += 1
                logger.exception("%s cannot be read: %r", name, damaged[:2000])
            shutil.copy(original, path)
            times += 1
        counts["done"] += times
        counts[name] = times
    return counts if most is not None else {**counts, "processor time of each [s]": seconds}


def damage_files(count: int, folder: Path) -> Report:
    """Damage the files of all readers so many times."""
    return damage_for(0.0, folder, most=count)


CASES = {
    "R10b": Case(
        "Readers are given files that are damaged by types and structure",
        *(6000, 60, damage_files),
        last=damage_for,
        minutes=20.0,
    )
}
