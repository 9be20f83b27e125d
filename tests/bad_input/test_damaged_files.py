"""Files that the program wrote itself, damaged by type and structure: every reader says which one.

``PHYSHANDI_FUZZ=20000`` tries as many damages of each file, other ones each time.
"""

import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.hostile.damaged_files import damage_file
from support.property_tests import SAME_EVERYWHERE

from app.exports.shares import Shares, StoredShare
from app.jobs.catalog import RunIndex
from app.jobs.launch_keys import KeyedRequest, LaunchKeys
from app.jobs.ticket import read_ticket
from app.jobs.views import (
    describe_results,
    loss_curves,
    read_frame_errors,
    stages_of,
    summarize_run,
)
from app.pages import suites
from app.pages.metrics import tabulate
from app.pages.parameters import parameter_rows
from app.viewer.physics.edit_presets import EditPresetStore
from app.viewer.physics.presets import PresetStore
from physhandi.data.files import plain
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import read_events
from physhandi.data.sequence_meta import read_meta
from physhandi.errors import RunError, SequenceError, UsageError
from physhandi.metrics.suite_report import SUITE_COLUMNS
from physhandi.run import Run
from physhandi.synthetic.suite.folder import check_folder

_MANY = int(os.environ.get("PHYSHANDI_FUZZ", "0"))
_PATIENT = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
SOME = (
    settings(deadline=None, max_examples=_MANY, suppress_health_check=_PATIENT)
    if _MANY
    else settings(SAME_EVERYWHERE, max_examples=30)
)
OUT = "attempts/1/out"


def look_at_run(folder: Path) -> None:
    """Ask a run for all that lists, its page and the queue ask for."""
    run = Run.open(folder)
    assert all(isinstance(text, str) for text in (run.name, run.label, run.note, run.created))
    assert all(isinstance(text, str) for text in (*run.sequences, *run.sequence_names))
    for ask in (
        lambda: run.state,
        lambda: run.error,
        lambda: stages_of(run, "succeeded"),
        lambda: run.progress.get("stage", "").upper(),
        run.verify,
    ):
        with told(folder):
            ask()
    results = describe_results(run)
    for scores in results.get("metrics", {}).values():
        tabulate(scores)
    parameter_rows(run, results.get("parameters", {}))
    summarize_run(run)
    loss_curves(run)
    with told(folder):
        read_frame_errors(run)
    live_holder(folder)
    json.dumps([plain(results), run.config], allow_nan=False)


@contextmanager
def told(folder: Path) -> Iterator[None]:
    """Let an error of ours pass if it names the folder."""
    try:
        yield
    except RunError as error:
        assert folder.name in str(error)  # noqa: PT017


def look_at_ticket(folder: Path) -> None:
    ticket = read_ticket(folder / "queued.json")
    assert ticket is not None
    assert ticket.starts >= 0
    assert float(ticket.time) <= 1e308
    assert ticket.remark.strip() == ticket.remark or ticket.why


def look_at_keys(folder: Path) -> None:
    keys = LaunchKeys(folder / "launches.json")
    keys.run_of(KeyedRequest.of("another", {}))
    keys.note_deleted("x")


def look_at_shares(folder: Path) -> None:
    shares = Shares(folder / "shares")
    assert len(shares.all()) + len(shares.problems()) == 1


def look_at_index(folder: Path) -> None:
    status = (folder / "job.yaml").stat()
    run = RunIndex(folder / "index.json").open(folder, (status.st_mtime_ns, 1))
    assert isinstance(run.name, str)
    assert isinstance(run.config, dict)


def look_at_presets(folder: Path) -> None:
    presets, problems = PresetStore(folder / "presets").presets()
    assert len(presets) + len(problems) == 1


def look_at_edit_presets(folder: Path) -> None:
    presets, problems = EditPresetStore(folder / "presets").presets()
    assert len(presets) + len(problems) == 1


def look_at_suite(folder: Path) -> None:
    """Ask for what the page of a suite shows, and begin to go on with it."""
    assert suites._described(folder)["name"] == folder.name
    with told(folder):
        content = suites._read(folder)
        suites._tables(suites._rows(folder, content.about.seed_of), content.about.oracles)
        suites._matrix(content.cells, content.about.oracles, suites.CellQuery(split="main"))
        suites._choices(content.cells)
    with suppress(UsageError):
        assert check_folder(folder, "t", ["b"]) is not None


def look_at_sequence(folder: Path) -> None:
    assert read_meta(folder).frame_count > 0


READERS: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(
        (
            *("job.yaml", "run.yaml", "exit.json", "progress.json", "current", "events.jsonl"),
            *("lease.json", "attempts/1/stages.json", "attempts/1/MANIFEST.json"),
            *(f"{OUT}/{name}.json" for name in ("metrics", "losses", "environment")),
            *(f"{OUT}/object/parameters.yaml", f"{OUT}/sequences/sheet/frame_errors.json"),
        ),
        look_at_run,
    ),
    "queued.json": look_at_ticket,
    "launches.json": look_at_keys,
    "shares/a/share.json": look_at_shares,
    "index.json": look_at_index,
    "presets/wet.yaml": look_at_presets,
    "presets/edits/torn.json": look_at_edit_presets,
    "cells.json": look_at_suite,
    "table.csv": look_at_suite,
    "sequence.yaml": look_at_sequence,
}


@pytest.fixture
def folder(fitted: Path, sheet: Path) -> Path:
    """A finished run with whatever else the program keeps in files, each written by itself."""
    claim = {"nonce": "a", "pid": 1, "process": "b", "host": socket.gethostname(), "time": 1.0}
    (fitted / "lease.json").write_text(json.dumps(claim))
    (fitted / "progress.json").write_text(
        json.dumps(read_events(fitted)[0][-1] | {"eta_s": 1.0}), encoding="utf-8"
    )
    (fitted / "queued.json").write_text('{"time": 1.5, "starts": 1, "why": "It was lost."}')
    LaunchKeys(fitted / "launches.json").note(KeyedRequest.of("a", {"b": 1}), "run")
    (fitted / "shares/a").mkdir(parents=True)
    (fitted / "shares/a/page.html").write_text("<p>")
    about = StoredShare(run="fitted", name="a", created="2026-01-01")
    (fitted / "shares/a/share.json").write_text(about.model_dump_json())
    index = RunIndex(fitted / "index.json")
    index.open(fitted, ((fitted / "job.yaml").stat().st_mtime_ns, 1))
    index.save(lambda: {str(fitted)}, is_asked_for=True)
    preset = {"format": "physhandi-preset/1", "name": "Wet", "parameters": {"drag": 6.0}}
    (fitted / "presets").mkdir()
    (fitted / "presets/wet.yaml").write_text(json.dumps(preset))
    torn = {
        "format": "physhandi-edit-preset/1",
        "name": "Torn",
        "object": {"nodes": 9, "springs": 12, "sha256": "0" * 64},
        "recording": {"name": "sheet", "frames": 4, "controls": 2},
        "edits": [{"kind": "cut", "springs": [[0, 1]]}],
    }
    (fitted / "presets/edits").mkdir()
    (fitted / "presets/edits/torn.json").write_text(json.dumps(torn))
    figures = {"main": {"track_error": 0.01, "chamfer_l2": None}}
    cell = {
        "method": "a",
        "case": "b",
        "split": "main",
        "run": "c",
        "error": "",
        "figures": figures,
    }
    environment = {"started": "2026", "device": "cpu", "device_name": "x"}
    suite = {"title": "t", "cases": ["b"], "methods": {"a": ""}, "skipped": [], "protocols": []}
    (fitted / "table.csv").write_text(
        f"{','.join(SUITE_COLUMNS)}\na,main,track_error,0.01,0.009,0.011,3\n"
    )
    cells = {"about": suite | {"environment": environment}, "cells": [cell]}
    (fitted / "cells.json").write_text(json.dumps(cells))
    (sheet / "sequence.yaml").rename(fitted / "sequence.yaml")
    return fitted


@pytest.mark.parametrize("file", READERS)
@SOME
@given(data=st.data())
def test_a_damaged_file_is_told_by_name(folder: Path, file: str, data: st.DataObject) -> None:
    path = folder / file
    original = path.read_bytes()

    def choose(options: Any) -> Any:
        return options[data.draw(st.integers(0, len(options) - 1))]

    try:
        damage_file(path, choose)
        READERS[file](folder)
    except (RunError, SequenceError) as error:
        assert file.rpartition("/")[2] in str(error) or folder.name in str(error)  # noqa: PT017
    finally:
        path.write_bytes(original)


def test_what_is_not_damaged_passes_every_reader(folder: Path) -> None:
    for look in dict.fromkeys(READERS.values()):
        look(folder)
