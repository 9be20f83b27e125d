"""Fits that are stopped or killed inside a stage, and end with the bits of undisturbed ones."""

import multiprocessing
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
from support.inputs.sheet_sequence import sheet_config, write_sheet
from support.physics import hand_scene as scene
from support.physics.stopped_fits import Stopper
from support.waiting import until

from app.jobs.worker import fill_run
from physhandi import pipeline
from physhandi.data import checkpoint
from physhandi.data.run_folder import read_events
from physhandi.errors import CancelledError
from physhandi.fitting.config import PipelineConfig, load_profile
from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import results_of


def sheet_fit(folder: Path) -> Callable[[str], Run]:
    """Write a small sheet, and give what makes runs that search and fit its springs."""
    sequence = write_sheet(folder / "sheet").folder
    config = sheet_config(generations=4, population=4, iterations=6)
    return lambda name: _new_run(folder / name, sequence, config)


def hand_fit(folder: Path) -> Callable[[str], Run]:
    """Write a hand without an object, and give what makes runs that fit it."""
    cameras = [scene.looking_at_hand(angle) for angle in (0.0, 1.2)]
    truth = [scene.grasping(frames=3)]
    keypoint = scene.seen_keypoints(truth, cameras)
    sequence = scene.write_scene(folder / "hand", truth, cameras, keypoint).folder
    quick = load_profile("quick")
    config = quick.replace(hand=quick.hand.replace(iterations=100))
    return lambda name: _new_run(folder / name, sequence, config)


def _new_run(folder: Path, sequence: Path, config: PipelineConfig) -> Run:
    return Run.create(
        folder,
        name=folder.name,
        kind="reconstruction",
        sequences=[str(sequence)],
        config={"profile": config.to_dict()},
    )


def _always_written() -> None:
    """Let every state be written in this process."""
    checkpoint.CHECKPOINT_INTERVAL_S, checkpoint.CHECKPOINT_SHARE = 0.0, np.inf


def resume(count: int, folder: Path) -> Report:
    """Cancel fits at random reports, several times each, and compare what they publish."""
    chance = np.random.default_rng(7)
    with (
        patch.object(checkpoint, "CHECKPOINT_INTERVAL_S", 0.0),
        patch.object(checkpoint, "CHECKPOINT_SHARE", np.inf),
    ):
        kinds: list[tuple[Callable[[str], Run], dict[str, bytes], int]] = []
        for make in (sheet_fit(folder), hand_fit(folder)):
            whole, heard = make(f"whole{len(kinds)}"), Stopper()
            pipeline.run_job(whole, heard)
            kinds.append((make, results_of(whole), len(heard.reports)))
        done = runs = corrupt = lost = redone = 0
        while done < count:
            new_run, expected, reports = kinds[runs % 2]
            run, told = new_run(f"run{runs}"), 0
            while not run.is_published:
                stopper = Stopper(int(chance.integers(1, reports)) if done < count else None)
                with suppress(CancelledError):
                    pipeline.run_job(run, stopper)
                done += not run.is_published
                told += sum("Resumed" not in report[3] for report in stopper.reports)
            runs += 1
            lost += run.state != "succeeded"
            corrupt += results_of(run) != expected
            redone += told - reports
    return {"done": done, "runs": runs, "lost": lost, "corrupt": corrupt, "redone": redone}


def work(folder: Path) -> None:
    """Be the process of a fit."""
    _always_written()
    fill_run(folder, "cpu", lambda: None)


def kill_workers(count: int, folder: Path) -> Report:
    """Kill the process of fits after random reports, and start it again until they are through."""
    chance = np.random.default_rng(1)
    context = multiprocessing.get_context("spawn")
    new_run = sheet_fit(folder)

    def go_on(run: Run, reports: int | None) -> bool:
        """Let a process work on a run, and kill it after some reports; tell whether it was."""
        known = len(read_events(run.folder)[0])
        process = context.Process(target=work, args=(run.folder,))
        process.start()

        def is_over() -> bool:
            told = len(read_events(run.folder)[0]) - known
            return not process.is_alive() or (reports is not None and told >= reports)

        until(is_over, interval=0.001)
        if process.is_alive():
            process.kill()
        process.join()
        return process.exitcode == -signal.SIGKILL

    whole = new_run("whole")
    go_on(whole, None)
    expected = results_of(whole)
    done = runs = corrupt = lost = 0
    while done < count:
        run = new_run(f"run{runs}")
        while not run.is_published:
            done += go_on(run, int(chance.integers(1, 12)) if done < count else None)
        runs += 1
        lost += run.state != "succeeded"
        corrupt += results_of(run) != expected
    return {"done": done, "runs": runs, "lost": lost, "corrupt": corrupt}


CASES = {
    "R7": Case("A fit is stopped inside a stage and resumed", 50, 2, resume),
    "R7b": Case("The process of a fit is killed inside a stage", 50, 0, kill_workers),
}
