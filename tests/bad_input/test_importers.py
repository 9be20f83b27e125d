"""Broken foreign recordings, each given to ``physhandi import``."""

import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile.bad_input_world import (
    Bad,
    Terminal,
    array,
    bad,
    both,
    film,
    put,
    removed,
    table,
    truncated,
)
from support.inputs.mano_file import write_mano
from support.inputs.phystwin_case import write_case
from support.inputs.phystwin_damage import final, image_file, metadata, moved, split, tracks
from support.inputs.phystwin_experiment import save_checkpoint, write_experiment

CANARY = "canary"
"""File that a hostile pickle makes if anything of it is executed."""


class _Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {CANARY}",)


def hostile(rel: str):
    return lambda folder: (folder / rel).write_bytes(pickle.dumps({"object_points": _Bomb()}))


def scaled(factor: float, *names: str):
    return both(*[final(name, lambda values: values * factor) for name in names])


PER_FRAME = (
    "object_points",
    "object_visibilities",
    "object_motions_valid",
    "controller_points",
)
POINTS = ("object_points", "controller_points", "surface_points", "interior_points")

PHYSTWIN = {
    "no case": bad(shutil.rmtree, "case", "not a folder", "final_data.pkl"),
    "no final_data.pkl and no metadata.json": bad(
        both(removed("final_data.pkl"), removed("metadata.json")),
        "no PhysTwin case",
        "final_data.pkl",
        "metadata.json",
    ),
    "no calibrate.pkl": bad(removed("calibrate.pkl"), "calibrate.pkl"),
    "hostile final_data.pkl": bad(hostile("final_data.pkl"), "final_data.pkl", "system", "refused"),
    "hostile calibrate.pkl": bad(hostile("calibrate.pkl"), "calibrate.pkl", "system", "refused"),
    "torn final_data.pkl": bad(truncated("final_data.pkl"), "final_data.pkl", "refused"),
    "torn cotracker archive": bad(truncated("cotracker/1.npz"), "cotracker/1.npz", ".npz"),
    "torn depth": bad(truncated("depth/2/3.npy"), "depth/2/3.npy", ".npy"),
    "torn color": bad(truncated("color/0/1.png"), "color/0/1.png", "decoded"),
    "torn metadata": bad(truncated("metadata.json", 20), "metadata.json", "JSON"),
    "frames with a gap": bad(moved("color/1/2.png", "color/1/9.png"), "color/1", "frame 9"),
    "frames with leading zeros": bad(
        moved("depth/0/1.npy", "depth/0/00001.npy"), "depth/0/1.npy", "missing", "no zeros"
    ),
    "fewer cameras than calibrated": bad(
        metadata(intrinsics=[np.eye(3).tolist()], serial_numbers=["a"]), "calibrate.pkl", "3", "1"
    ),
    "K of 2x2": bad(metadata(intrinsics=[[[1, 0], [0, 1]]] * 3), "metadata.json", "intrinsics"),
    "another number of frames": bad(metadata(frame_num=4), "final_data.pkl", "5 frames", "4"),
    "NaN in a visible point": bad(
        final("object_points", lambda p: np.where(np.arange(26)[:, None] == 3, np.nan, p)),
        "object_points",
        "point 3",
        "nan",
    ),
    "NaN in the controllers": bad(
        final("controller_points", lambda p: np.full_like(p, np.nan)),
        "controller_points",
        "frame 0",
    ),
    "zero frames": bad(
        both(*[final(name, lambda values: values[:0]) for name in PER_FRAME]),
        "final_data.pkl",
        "object_points (0, 26, 3)",
        "empty",
    ),
    "zero frames told": bad(metadata(frame_num=0), "metadata.json", "frame_num is 0"),
    "controllers of another length": bad(
        final("controller_points", lambda p: p[:3]), "controller_points", "(3, 2, 3)"
    ),
    "millimetres": bad(scaled(1000, *POINTS), "object_points", "millimetres", "frame 0"),
    "a thousandth": bad(scaled(1e-3, *POINTS), "object", "mm", "metres"),
    "split beyond the end": bad(split(train=[0, 9]), "split.json", "9"),
    "color in another size": bad(
        image_file("color/0/1.png", np.zeros((9, 9, 3), np.uint8)), "color/0/1.png", "9x9", "96x72"
    ),
    "tracks that are not finite": bad(
        tracks(tracks=np.full((5, 26, 2), np.nan)), "cotracker/1.npz", "frame 0"
    ),
}


@pytest.fixture(scope="session")
def case_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_case(tmp_path_factory.mktemp("cases") / "case").folder


@pytest.fixture
def phystwin(tmp_path: Path, case_folder: Path) -> Path:
    return shutil.copytree(case_folder, tmp_path / "case")


@table(PHYSTWIN)
def test_a_broken_phystwin_case_is_refused(terminal: Terminal, phystwin: Path, case: Bad) -> None:
    case.damage(phystwin)
    terminal.refused(case.code, case.words, "import", "phystwin", phystwin, "--out", "out")
    assert not list(terminal.folder.rglob(CANARY))


def test_phystwin_results_that_do_not_fit_the_case_are_refused(
    terminal: Terminal, tmp_path: Path
) -> None:
    case = write_case(tmp_path / "case", has_images=False)
    experiment = write_experiment(case, tmp_path / "experiment")
    order = ("import", "phystwin", case.folder, "--out", "out", "--run", "run")
    order = (*order, "--optimal-params", experiment.optimum, "--checkpoint", experiment.checkpoint)
    save_checkpoint(experiment, experiment.stiffness[:-1])
    terminal.refused(1, ("best_120.pth", "springs"), *order)


ROPE = {
    "not there": bad(Path.unlink, "rope.npy", "neither a file nor a folder"),
    "torn": bad(truncated("", 60), "rope.npy", "readable"),
    "table of two axes": bad(array("", lambda m: m[:, 0]), "rope.npy", "(frame, marker, 3)"),
    "whole numbers": bad(array("", lambda m: m.astype(int)), "rope.npy", "int64"),
    "no frames": bad(array("", lambda m: m[:0]), "rope.npy", "0 frames", "at least 8"),
    "too few markers": bad(array("", lambda m: m[:, :5]), "rope.npy", "5 markers"),
    "a marker lost": bad(put("", (17, 4), np.nan), "rope.npy", "frame 17", "marker 4", "nan"),
    "millimetres": bad(array("", lambda m: m * 1000), "rope.npy", "millimetres", "metres"),
    "a thousandth": bad(array("", lambda m: m * 1e-3), "rope.npy", "mm", "metres"),
    "two markers in one place": bad(
        array("", lambda m: np.concatenate([m[:, :7], m[:, 6:]], axis=1)), "rope.npy", "6 and 7"
    ),
}


@table(ROPE)
def test_a_broken_rope_is_refused(terminal: Terminal, tmp_path: Path, case: Bad) -> None:
    path = tmp_path / "rope.npy"
    time, along = np.meshgrid(np.arange(100) / 100, np.linspace(0, 1, 13), indexing="ij")
    np.save(path, np.stack([along, 0.1 * np.sin(3 * time), 1 + 0.05 * along * time], axis=-1))
    case.damage(path)
    terminal.refused(case.code, case.words, "import", "mocap", path, "--out", "out")


STEREO = {
    "not there": bad(shutil.rmtree, "recording", "not a folder"),
    "no calibration": bad(removed("c1.dat"), "c1.dat", "missing"),
    "no second video": bad(removed("cam1_test.mp4"), "cam1*.mp4", "found none"),
    "a video that ends early": bad(
        lambda folder: film(folder / "cam1_test.mp4", 2), "cam1_test.mp4", "2 frames", "3"
    ),
    "torn video": bad(truncated("cam0_test.mp4", 200), "cam0_test.mp4", "decoded"),
    "a word for a number": bad(
        lambda folder: (folder / "c0.dat").write_text("intrinsic:\nwide 0 0\n"), "c0.dat", "line 2"
    ),
    "no rotation": bad(
        lambda folder: (folder / "rot_trans_c0.dat").write_text(
            "R:\n1 0 0\n0 2 0\n0 0 1\nT:\n0\n0\n10\n"
        ),
        "rot_trans_c0.dat",
        "rotation",
    ),
}


@table(STEREO)
def test_a_broken_stereo_recording_is_refused(
    terminal: Terminal, tmp_path: Path, case: Bad
) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    for camera in (0, 1):
        film(folder / f"cam{camera}_test.mp4", 3)
        (folder / f"c{camera}.dat").write_text(
            "intrinsic:\n60 0 32\n0 61 24\n0 0 1\ndistortion:\n0 0 0 0 0\n"
        )
        (folder / f"rot_trans_c{camera}.dat").write_text("R:\n1 0 0\n0 1 0\n0 0 1\nT:\n0\n0\n10\n")
    case.damage(folder)
    terminal.refused(case.code, case.words, "import", "stereo", folder, "--out", "out")


MANO = {
    "not there": bad(Path.unlink, "MANO_RIGHT.pkl", "not a file"),
    "hostile": bad(
        lambda path: path.write_bytes(pickle.dumps(_Bomb())), "MANO_RIGHT.pkl", "system", "refused"
    ),
    "no MANO": bad(
        lambda path: path.write_bytes(pickle.dumps({"f": 3})), "MANO_RIGHT.pkl", "v_template"
    ),
    "torn": bad(truncated("", 500), "MANO_RIGHT.pkl", "refused"),
    "a name without a side": bad(
        lambda path: path.rename(path.with_name("hand.pkl")), "MANO_RIGHT.pkl", "not a file"
    ),
    "millimetres": bad(
        lambda path: write_mano(path.parent, v_template=_template() * 1000), "v_template", "metres"
    ),
}


def _template() -> np.ndarray:
    from support.inputs.mano_file import mano_arrays

    return mano_arrays("right")["v_template"]


@table(MANO)
def test_a_broken_mano_file_is_refused(
    terminal: Terminal, tmp_path: Path, mano_source: Path, case: Bad
) -> None:
    path = shutil.copy(mano_source, tmp_path)
    case.damage(Path(path))
    terminal.refused(case.code, case.words, "import", "mano", path, "--out", "hands")
    assert not (tmp_path / CANARY).exists()


@pytest.fixture(scope="session")
def mano_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mano(tmp_path_factory.mktemp("mano"))
