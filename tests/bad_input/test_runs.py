"""Damaged runs, each given to the commands that read it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile.bad_input_world import (
    Bad,
    Terminal,
    array,
    bad,
    put,
    removed,
    table,
    text,
    truncated,
)
from support.inputs.sheet_sequence import write_sheet

from physhandi.data.run_folder import artefacts, file_record
from physhandi.run import Run

OUT = "attempts/1/out"
SHEET = f"{OUT}/sequences/sheet"
MODEL, MATERIAL = f"{SHEET}/model.safetensors", f"{OUT}/object/material.safetensors"


def parameters(**changes: Any) -> Callable[[Path], Any]:
    import yaml

    return text(
        f"{OUT}/object/parameters.yaml",
        lambda content: yaml.safe_dump(yaml.safe_load(content) | changes),
    )


def sealed(damage: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """Damage, and forge the manifest so that every hash is right."""

    def do(folder: Path) -> None:
        damage(folder)
        path = folder / "attempts/1/MANIFEST.json"
        manifest = json.loads(path.read_text())
        manifest["files"] = {rel: file_record(path) for rel, path in artefacts(folder / OUT)}
        path.write_text(json.dumps(manifest))

    return do


def tensors(rel: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Callable[[Path], Any]:
    def rewrite(folder: Path) -> None:
        from safetensors.numpy import load_file, save_file

        save_file(change(load_file(folder / rel)), folder / rel)

    return rewrite


RUNS = {
    "no run.yaml": bad(removed("run.yaml"), "run"),
    "no job.yaml": bad(removed("job.yaml"), "job.yaml"),
    "torn job.yaml": bad(truncated("job.yaml", 100), "job.yaml"),
    "a field twice": bad(text("run.yaml", lambda t: t + "name: b\n"), "run.yaml", "twice"),
    "another format": bad(
        text("run.yaml", lambda t: t.replace("physhandi-run/1", "other/9")), "run.yaml", "format"
    ),
    "another kind": bad(
        text("job.yaml", lambda t: t.replace("kind: reconstruction", "kind: dream")),
        "job.yaml",
        "dream",
    ),
    "no manifest": bad(removed("attempts/1/MANIFEST.json"), "not whole", "MANIFEST.json"),
    "half-written attempt": bad(removed("current"), "not whole", "'current'"),
    "nothing of the attempt": bad(
        lambda folder: shutil.rmtree(folder / "attempts"), "not whole", "Run it again"
    ),
    "no model": bad(removed(MODEL), "model.safetensors"),
    "torn model": bad(truncated(MODEL), "model.safetensors"),
    "no material": bad(removed(MATERIAL), "material.safetensors"),
    "torn material": bad(truncated(MATERIAL), "material.safetensors"),
    "a spring too few": bad(
        tensors(MODEL, lambda t: t | {"stiffness": t["stiffness"][:-1].copy()}),
        "model.safetensors",
        "instead of",
    ),
    "another content of the same size": bad(
        tensors(MODEL, lambda t: t | {"stiffness": 2 * t["stiffness"]}),
        "model.safetensors",
        "SHA-256",
    ),
    "another parameter": bad(parameters(drag=0.5), "parameters.yaml", "run it again"),
    "no control": bad(removed(f"{SHEET}/control.npy"), "control.npy"),
    "torn control": bad(truncated(f"{SHEET}/control.npy"), "control.npy"),
    # Nonsense that the manifest vouches for
    "no rest_node": bad(
        sealed(tensors(MATERIAL, lambda t: {k: v for k, v in t.items() if k != "rest_node"})),
        "material.safetensors",
        "'rest_node'",
    ),
    "no stiffness": bad(
        sealed(tensors(MODEL, lambda t: {k: v for k, v in t.items() if k != "stiffness"})),
        "model.safetensors",
        "stiffness",
    ),
    "NaN in a stiffness": bad(
        sealed(tensors(MODEL, lambda t: t | {"stiffness": t["stiffness"] * np.float32(np.nan)})),
        "model.safetensors",
        "stiffness",
        "finite",
    ),
    "a spring to nowhere": bad(
        sealed(tensors(MODEL, lambda t: t | {"spring_nodes": t["spring_nodes"] + np.int32(9000)})),
        "model.safetensors",
        "outside 0…26",
    ),
    "no tensors at all": bad(sealed(truncated(MODEL)), "model.safetensors", "damaged"),
    "torn parameters": bad(
        sealed(truncated(f"{OUT}/object/parameters.yaml", 40)), "parameters.yaml", "line 2"
    ),
    "parameters of another kind": bad(
        sealed(lambda folder: (folder / OUT / "object/parameters.yaml").write_text("- 1\n")),
        "parameters.yaml",
    ),
    "a negative parameter": bad(
        sealed(parameters(connection_radius=-1.0)), "parameters.yaml", "connection_radius is -1.0"
    ),
    "an unknown parameter": bad(sealed(parameters(colour="red")), "parameters.yaml", "'colour'"),
    "NaN in the control": bad(
        sealed(put(f"{SHEET}/control.npy", (3, 0, 0), np.nan)),
        "control.npy",
        "frame 3",
        "control 0",
    ),
    "an array for another": bad(
        sealed(lambda folder: (folder / SHEET / "control.npy").write_bytes(b"PK")), "control.npy"
    ),
}


@table(RUNS)
def test_a_damaged_run_is_not_simulated(terminal: Terminal, fitted: Path, case: Bad) -> None:
    case.damage(fitted)
    order = ("simulate", fitted, "--out", "out", "--drag", 1, "--device", "cpu")
    terminal.refused(case.code, case.words, *order)


MEASURED = {
    "no rollout": bad(removed(f"{SHEET}/rollout.npy"), "rollout.npy"),
    "torn rollout": bad(truncated(f"{SHEET}/rollout.npy"), "rollout.npy"),
    "rollout of another length": bad(array(f"{SHEET}/rollout.npy", lambda r: r[:5]), "rollout.npy"),
    "no observation": bad(removed(f"{SHEET}/observation/point.npy"), "point.npy"),
    "torn observation": bad(truncated(f"{SHEET}/observation/is_visible.npy"), "is_visible.npy"),
    "torn meta": bad(truncated(f"{SHEET}/meta.yaml", 12), "meta.yaml"),
    "another content than the manifest says": bad(
        put(f"{SHEET}/rollout.npy", (3, 3, 0), 7.0), "rollout.npy", "SHA-256"
    ),
    "a manifest that is no JSON": bad(truncated("attempts/1/MANIFEST.json", 50), "MANIFEST.json"),
    "a manifest of another kind": bad(
        lambda folder: (folder / "attempts/1/MANIFEST.json").write_text(json.dumps([1])),
        "MANIFEST.json",
    ),
}


@table(MEASURED)
def test_a_damaged_run_is_neither_measured_nor_exported(
    terminal: Terminal, fitted: Path, case: Bad
) -> None:
    case.damage(fitted)
    terminal.refused(case.code, case.words, "evaluate", "run", fitted)
    terminal.refused(case.code, case.words, "export", fitted, "--format", "npz", "--out", "x.npz")


def test_two_objects_are_not_fitted_as_one(terminal: Terminal, sheet: Path, tmp_path: Path) -> None:
    other = write_sheet(tmp_path / "other").folder
    for file in ("object_node.npy", "rest_node.npy"):
        np.save(other / file, np.load(other / file)[:20])
    np.save(other / "marker_node.npy", np.arange(25, dtype=np.int32) % 20)
    words = ("'other'", "20 object nodes", "25", "another object")
    order = ("reconstruct", sheet, other, "--out", "out", "--device", "cpu")
    terminal.refused(1, words, *order)


def test_two_recordings_of_one_name_are_not_fitted_together(
    terminal: Terminal, sheet: Path, tmp_path: Path
) -> None:
    again = shutil.copytree(sheet, tmp_path / "elsewhere" / "sheet")
    words = ("'sheet'", "Rename")
    terminal.refused(1, words, "reconstruct", sheet, again, "--out", "out", "--device", "cpu")


def test_a_run_is_not_simulated_in_another_objects_recording(
    terminal: Terminal, fitted: Path, tmp_path: Path
) -> None:
    other = write_sheet(tmp_path / "other").folder
    for file in ("object_node.npy", "rest_node.npy"):
        np.save(other / file, np.load(other / file)[:20])
    np.save(other / "marker_node.npy", np.arange(25, dtype=np.int32) % 20)
    order = ("simulate", fitted, "--sequence", other, "--out", "out", "--device", "cpu")
    terminal.refused(1, ("'other'", "20 object nodes", "25"), *order)


def test_a_run_whose_recording_is_gone_says_which(
    terminal: Terminal, fitted: Path, sheet: Path
) -> None:
    job = fitted / "job.yaml"
    job.write_text(job.read_text().replace(Run.open(fitted).sequences[0], "/nowhere/sheet"))
    order = ("evaluate", "run", fitted)
    terminal.refused(1, ("'fitted'", "'sheet'", "cannot be opened"), *order)


@pytest.mark.parametrize("command", ["simulate", "evaluate", "export"])
def test_an_unfinished_run_has_nothing_to_give(
    terminal: Terminal, sheet: Path, tmp_path: Path, command: str
) -> None:
    run = Run.create(
        tmp_path / "new", name="new", kind="reconstruction", sequences=[str(sheet)], config={}
    )
    orders = {
        "simulate": ("simulate", run.folder, "--out", "out"),
        "evaluate": ("evaluate", "run", run.folder),
        "export": ("export", run.folder, "--format", "npz", "--out", "x.npz"),
    }
    terminal.refused(1, ("'new'", "queued"), *orders[command])
