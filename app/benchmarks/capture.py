"""Benchmark of an import: made scenes as raw captures, imported again by one click, and fitted.

Each step of a scene has a process of its own, so that its memory is its own and what fails takes
nothing along: ``python -m app.benchmarks.capture STEP`` is such a process.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np

from app.benchmarks.parts import CaptureSize, FitProfile
from physhandi.child import Channel, Child, run_child
from physhandi.data.files import write_json, write_yaml
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE
from physhandi.data.truth import read_truth
from physhandi.data.view import View
from physhandi.devices import processor_name
from physhandi.errors import CancelledError, PhysHandiError, RunError, UsageError, describe
from physhandi.progress import PrintedProgress, Progress, ToldProgress

CAPTURE_GOALS: Mapping[str, float] = {
    "object_iou": 0.85,
    "hand_iou": 0.80,
    "track_median_mm": 5.0,
    "tracks_alive": 150,
    "tracks_alive_in_each_view": 150,
    "camera_shift_mm": 3.0,
    "camera_turn_deg": 0.3,
    "chamfer_ratio": 1.25,
}
"""Goals of an import: at least for overlaps and living tracks, at most for everything else."""
_AT_LEAST = ("object_iou", "hand_iou", "tracks_alive", "tracks_alive_in_each_view")
_MODULE = "app.benchmarks.capture"
_RESULT = "capture.json"
_SAME_HANDS = "exact_same_hands"
_INPUTS = ("import", "exact", _SAME_HANDS)
_METRICS = ("chamfer_l1", "track_error")
_SPLITS = {"fitted": "reconstruction", "predicted": "future"}
_TELL_EVERY_S = 0.5
_MILLIMETRES = 1e3


@dataclass(frozen=True, kw_only=True)
class CaptureOrder:
    """Options of the measurement of a scene."""

    image_size: CaptureSize = "half"
    """Size of the pictures."""
    seed: int = 0
    """Seed of the scenes."""
    frames: int = 60
    """Frames of each."""
    fit: FitProfile = "quick"
    """Profile of the fits."""
    search_seeds: tuple[int, ...] = (42, 1)
    """Seeds of the searches of each fit."""
    device: str = "cpu"
    """Warp device of the fits; pictures are drawn there, too, if Warp has no CPU device."""
    resolution: Literal["fine", "tiny"] = "fine"
    """Size of the bodies in nodes; ``tiny`` is for tests."""


def benchmark_capture(
    scenes: tuple[str, ...], out: Path, order: CaptureOrder, *, jobs: int = 1
) -> dict[str, Any]:
    """Measure what one click makes of made scenes that are given as raw captures.

    A scene is made as the suite `dev_rgbd` makes it and written as a raw capture: color, depth,
    intrinsics, times and pictures of a board, which stands where the recording's calibration says
    that it does, so that all errors of the calibration are in all that is compared. It is imported
    with the board's cameras, the included networks' keypoints and one click, on the pixel of the
    object nearest to the middle of the recording's mask in frame 0 of the first view.

    Masks are compared with the recording's, whose outlines err on purpose, and with exact ones:
    mean over frames and views of intersection over union. Tracks are lifted by measured depth where
    a fit would lift them, and compared with where the true surface point that they began on is in
    every later frame; those of the recording are measured beside them. Cameras: the worst of all
    pairs, as the one sees the other. Fits are of the import, of the recording with exact masks and
    tracks and its own depth and keypoints, and of the latter with the import's keypoints
    (``exact_same_hands``), which tells what masks and tracks cost apart from what hands cost. All
    are scored against the cloud of exact masks and the recording's true paths, in its world, to
    which the import is moved along the table.

    Args:
        scenes: Objects and actions, like ``cloth/lift``; none takes all of `dev_rgbd`.
        out: Folder to fill with a folder for each scene, and ``capture.json``.
        order: What is measured.
        jobs: Scenes at a time.

    Returns:
        The machine, the order, for each scene its figures and which `CAPTURE_GOALS` are `reached`,
        and why others `failed`.

    Raises:
        UsageError: If a scene is unknown, named twice, or the folder is not empty.
    """
    from physhandi.benchmarks.timing import describe_machine

    chosen = _chosen(scenes)
    if jobs < 1:
        raise UsageError(f"jobs is {jobs}; expected 1 or more.")
    out = out.resolve()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UsageError(f"{out} holds something already. Choose another folder.")
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {
        "benchmark": "capture",
        **describe_machine(order.device),
        "processor": processor_name(),
        "jobs": jobs,
        **asdict(order),
        "goals": dict(CAPTURE_GOALS),
        "scenes": {},
        "failed": {},
    }
    steps = _Steps(_shared_threads(jobs))
    begin = time.monotonic()
    with ThreadPoolExecutor(jobs, thread_name_prefix="capture") as pool:
        try:
            works = {
                scene: pool.submit(_measured, scene, out / scene.replace("/", "_"), order, steps)
                for scene in chosen
            }
            for scene, work in works.items():
                try:
                    result["scenes"][scene] = work.result()
                except (PhysHandiError, OSError) as error:
                    result["failed"][scene] = describe(error)
                    PrintedProgress(has_bar=False).report(
                        f"{scene}: failed: {describe(error)}", 0, 0
                    )
        except BaseException:
            steps.end()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    result["seconds"] = time.monotonic() - begin
    write_json(out / _RESULT, result)
    return result


def _chosen(scenes: tuple[str, ...]) -> tuple[str, ...]:
    from physhandi.synthetic.suite.suite import find_suite

    offered = [f"{one.object_}/{one.action}" for one in find_suite("dev_rgbd").scenes]
    for scene in scenes:
        if scene not in offered:
            raise UsageError(f"There is no scene '{scene}'. Choose from: {', '.join(offered)}.")
        if scenes.count(scene) > 1:
            raise UsageError(f"Scene '{scene}' is named twice.")
    return scenes or tuple(offered)


def _shared_threads(jobs: int) -> int:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (count or 1) // jobs)


class ScenePlace:
    """Paths of a scene's files; sequences have one name, by which runs are compared."""

    def __init__(self, folder: Path, scene: str, seed: int) -> None:
        self.name = f"{scene.replace('/', '_')}_{seed}"
        self.recording = folder / "recording" / self.name
        self.raw = folder / "raw"
        self.imported = folder / "import" / self.name
        self.variants = folder / "variants"
        self.same_hands = folder / "same_hands" / self.name
        self._runs = folder / "runs"

    def run(self, given: str, search_seed: int) -> Path:
        """Name the folder of a fit."""
        return self._runs / f"{given}_{search_seed}"


class _Steps:
    """Does steps in processes of their own, which can all be ended at once."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._lock = threading.Lock()
        self._children: set[Child] = set()
        self._is_ended = False

    def do(self, scene: str, step: str, **about: Any) -> dict[str, Any]:
        """Do a step of a scene and return what it found; its reports become lines.

        Raises:
            PhysHandiError: If it failed; says of which scene and step.
        """
        lines = PrintedProgress(has_bar=False)
        label = " ".join(str(about[name]) for name in ("given", "search_seed") if name in about)
        label = f"{step} {label}".rstrip()
        lines.report(f"{scene}: {label}", 0, 0)
        begin = time.monotonic()
        with self._lock:
            if self._is_ended:
                raise CancelledError("The benchmark was ended.")
            child = Child(
                _MODULE, json.dumps({"step": step, "scene": scene, **about}), threads=self._threads
            )
            self._children.add(child)
        result: dict[str, Any] | None = None
        try:
            for message in child.messages():
                if "found" in message:
                    result = message["found"]
                else:
                    stage = f"{scene}: {label}: {message['stage']}"
                    lines.report(stage, message["iteration"], message["total"])
        except PhysHandiError as error:
            raise RunError(f"{label}: {error}") from error
        finally:
            with self._lock:
                self._children.discard(child)
            child.close()
        if result is None:
            raise RunError(f"{label}: its process ended without a result.")
        return result | {"step_seconds": time.monotonic() - begin}

    def end(self) -> None:
        """Kill what runs, and start nothing more."""
        with self._lock:
            self._is_ended = True
            for child in self._children:
                child.kill()


def _measured(scene: str, folder: Path, order: CaptureOrder, steps: _Steps) -> dict[str, Any]:
    """Measure a scene, step by step."""
    do = partial(steps.do, scene, folder=str(folder), order=asdict(order))
    seconds: dict[str, float] = {}
    result: dict[str, Any] = {}
    for step in ("make", "import", "score"):
        of_step = do(step)
        seconds[step] = of_step.pop("step_seconds")
        result |= of_step
    result |= {"seconds": seconds, "reached": reached(result)}
    write_json(folder / _RESULT, result)  # Fits take longest, and may be the last that is tried.
    if order.fit != "none":
        result |= _fitted(do, order, seconds)
        result["reached"] = reached(result)
        write_json(folder / _RESULT, result)
    return result


def _fitted(
    do: Callable[..., dict[str, Any]], order: CaptureOrder, seconds: dict[str, float]
) -> dict[str, Any]:
    """Fit every input from every seed, then score them; a fit that failed is told as such."""
    failed: dict[tuple[str, int], str] = {}
    every = [(given, seed) for given in _INPUTS for seed in order.search_seeds]
    for given, seed in every:
        try:
            of_step = do("fit", given=given, search_seed=seed)
            seconds[f"fit {given} {seed}"] = of_step["step_seconds"]
        except RunError as error:
            failed[given, seed] = str(error)
    fits: dict[str, list[dict[str, Any]]] = {given: [] for given in _INPUTS}
    observed = [seed for seed in order.search_seeds if ("exact", seed) not in failed]
    for given, seed in every:
        about: dict[str, Any] = {"search_seed": seed}
        if (given, seed) in failed:
            about["error"] = failed[given, seed]
        elif not observed:
            about["error"] = "No fit of exact masks succeeded whose cloud it is scored against."
        else:
            try:
                scores = do("score_fit", given=given, search_seed=seed, reference_seed=observed[0])
                about |= {name: v for name, v in scores.items() if name != "step_seconds"}
            except RunError as error:
                about["error"] = str(error)
        fits[given].append(about)
    return {
        "fits": fits,
        "ratio": ratios(fits, "exact"),
        "ratio_same_hands": ratios(fits, _SAME_HANDS),
    }


def ratios(
    fits: Mapping[str, Many[Mapping[str, Any]]], reference: str
) -> dict[str, dict[str, float | None]]:
    """Divide the mean error of the import's fits by that of the fits of another input.

    Args:
        fits: Scores of each input's fits, in `fitted` and `predicted` frames; those with an `error`
            have none.
        reference: The other input.

    Returns:
        For both kinds of frames each metric's ratio; None if an input has no scored fit.
    """
    by_split: dict[str, dict[str, float | None]] = {}
    for split in _SPLITS:
        by_split[split] = {}
        for metric in _METRICS:
            name = f"{metric}_mm"
            values = [
                [one[split][name] for one in fits[given] if "error" not in one]
                for given in ("import", reference)
            ]
            is_known = all(of_input and None not in of_input for of_input in values)
            by_split[split][metric] = fmean(values[0]) / fmean(values[1]) if is_known else None
    return by_split


def reached(result: Mapping[str, Any]) -> dict[str, bool]:
    """Tell which of `CAPTURE_GOALS` a scene's figures reach; without fits, not that of fits."""
    values: dict[str, float | None] = {
        "object_iou": result["masks"]["against_exact"]["object"],
        "hand_iou": result["masks"]["against_exact"]["hand"],
        "track_median_mm": result["tracks"]["median_mm"],
        "tracks_alive": result["tracks"]["least"],
        "tracks_alive_in_each_view": min(result["tracks"]["least_by_view"], default=0),
        "camera_shift_mm": result["cameras"]["shift_mm"],
        "camera_turn_deg": result["cameras"]["turn_deg"],
    }
    if "ratio" in result:
        values["chamfer_ratio"] = result["ratio"]["fitted"]["chamfer_l1"]
    return {
        name: value is not None
        and (value >= CAPTURE_GOALS[name] if name in _AT_LEAST else value <= CAPTURE_GOALS[name])
        for name, value in values.items()
    }


def make_scene(
    place: ScenePlace, scene: str, order: CaptureOrder, progress: Progress
) -> dict[str, Any]:
    """Make a scene with exact masks and tracks in its truth, and write it as a raw capture."""
    import warp as wp

    from physhandi.devices import start_warp
    from physhandi.synthetic.raw_capture import write_raw_capture
    from physhandi.synthetic.suite.suite import SuiteScene, find_suite, make_recording

    start_warp()
    object_, action = scene.split("/")
    making: dict[str, Any] = {
        **find_suite("dev_rgbd").recording,
        "object": object_,
        "action": action,
        "hold": SuiteScene(object_=object_, action=action).hold,
        "seed": order.seed,
        "frames": order.frames,
        "image_size": order.image_size,
        "resolution": order.resolution,
        "held_out_view": False,
        "exact_annotation": True,
        "device": "cpu" if wp.is_cpu_available() else order.device,
    }
    make_recording(making, place.recording, progress)
    write_raw_capture(Sequence.load(place.recording), place.raw, progress=progress)
    return {}


def import_scene(place: ScenePlace, progress: Progress) -> dict[str, Any]:
    """Import a raw capture as ``physhandi import capture --click`` does, and tell what it took.

    Memory is that of this process and of the largest that it started, at their peaks.
    """
    from physhandi.data.importers.capture import CaptureOptions, import_capture
    from physhandi.perception.annotation import annotate
    from physhandi.perception.segmentation import Click

    recording = Sequence.load(place.recording)
    view = recording.views[0]
    column, row = click_on(view)
    begin = time.monotonic()
    options = CaptureOptions(hands=recording.hands)
    imported = import_capture(place.raw, place.imported, progress, options=options)
    converted = time.monotonic()
    annotate(imported.folder, [Click(view.name, 0, column, row)], progress)
    end = time.monotonic()
    return {
        "click": f"{view.name},0,{column},{row}",
        "import": {
            "seconds": end - begin,
            "of_which_masks_and_tracks_s": end - converted,
            "peak_memory_mb": _peak_memory_mb(),
        },
    }


def click_on(view: View) -> tuple[int, int]:
    """Find the pixel of the object that is nearest to the middle of its mask in frame 0 (x, y).

    Raises:
        RunError: If the view does not show the object.
    """
    place = np.argwhere(view.mask(0) == 1)
    if not len(place):
        raise RunError(f"View '{view.name}' does not show the object in frame 0.")
    row, column = place[((place - place.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    return int(column), int(row)


def _peak_memory_mb() -> float | None:
    """Tell the peak memory [MiB]; None where the system does not tell it as Linux does."""
    if sys.platform != "linux":
        return None
    import resource

    # What getrusage tells of this process itself includes its parent's memory before the fork.
    lines = Path("/proc/self/status").read_text().splitlines()
    own = next(float(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return (own + resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 2**10


def score_import(place: ScenePlace) -> dict[str, Any]:
    """Compare masks, tracks and cameras, and move the import to the recording's world."""
    from physhandi.metrics.capture import camera_scores, mask_scores
    from physhandi.metrics.truth_metrics import true_surface
    from physhandi.synthetic.suite.variants import exact_view

    recording, imported = Sequence.load(place.recording), Sequence.load(place.imported)
    if imported.frame_count != recording.frame_count or len(imported.views) != len(recording.views):
        raise RunError(
            f"The import has {imported.frame_count} frames of {len(imported.views)} views in the "
            f"place of {recording.frame_count} of {len(recording.views)}."
        )
    poses = [[v.camera.T_world_camera for v in one.views] for one in (imported, recording)]
    cameras = camera_scores(*poses)
    imported = _placed(imported, recording)
    surface = true_surface(read_truth(recording.folder))
    if surface is None:
        raise RunError(f"Sequence '{recording.name}' has no true surface.")
    exact = [exact_view(recording, view) for view in recording.views]
    masks = [
        [view.mask(frame) for view in views for frame in range(recording.frame_count)]
        for views in (imported.views, recording.views, exact)
    ]
    own, given, true = masks
    return {
        "masks": {
            "against_recording": mask_scores(own, given),
            "against_exact": mask_scores(own, true),
            "recording_against_exact": mask_scores(given, true),
        },
        "tracks": _track_figures(imported, surface),
        "recording_tracks": _track_figures(recording, surface),
        "cameras": {
            "shift_mm": _MILLIMETRES * cameras["shift"],
            "turn_deg": cameras["turn"],
            "tilt_deg": cameras["tilt"],
        },
    }


def _placed(imported: Sequence, recording: Sequence) -> Sequence:
    """Give the import the recording's world and split; it keeps what it knows of itself."""
    from physhandi.metrics.capture import along_the_table

    ground = recording.ground_height or 0.0
    place = along_the_table(
        *[[view.camera.T_world_camera for view in one.views] for one in (imported, recording)],
        rise=ground - (imported.ground_height or 0.0),
    )
    views = tuple(
        replace(
            view,
            camera=replace(view.camera, T_world_camera=place @ view.camera.T_world_camera),
        )
        for view in imported.meta.views
    )
    meta = replace(
        imported.meta,
        views=views,
        ground_height=ground,
        reconstruction=recording.meta.reconstruction,
    )
    write_yaml(imported.folder / FILE, meta.to_dict())
    return Sequence.load(imported.folder)


def _track_figures(sequence: Sequence, surface: Any) -> dict[str, Any]:
    from physhandi.metrics.capture import track_scores, tracks_alive
    from physhandi.perception.lifting import lifted_tracks

    lifted = np.concatenate([lifted_tracks(view) for view in sequence.depth_views], axis=1)
    scores = track_scores(lifted, surface)
    none = np.zeros((sequence.frame_count, 0), np.bool_)
    alive = tracks_alive(
        [none if view.track_visible is None else view.track_visible for view in sequence.views]
    )
    return {
        "median_mm": _MILLIMETRES * scores["median"],
        "mean_mm": _MILLIMETRES * scores["mean"],
        "lost": scores["lost"],
        "points": scores["points"],
        **alive,
    }


def fit_scene(
    place: ScenePlace, given: str, search_seed: int, order: CaptureOrder, progress: Progress
) -> dict[str, Any]:
    """Fit the import, or the recording with exact masks and tracks and either's keypoints."""
    from physhandi.api import reconstruct
    from physhandi.synthetic.suite.methods import SEARCH_SEED
    from physhandi.synthetic.suite.variants import make_variant

    if given == "import":
        sequence = Sequence.load(place.imported)
    else:
        recording = Sequence.load(place.recording)
        sequence = make_variant(recording, "exact_annotation", place.variants)
    if given == _SAME_HANDS:
        sequence = _with_keypoints(sequence, Sequence.load(place.imported), place.same_hands)
    reconstruct(
        sequence,
        profile=order.fit,
        overrides={SEARCH_SEED: search_seed},
        out=place.run(given, search_seed),
        progress=progress,
        device=order.device,
    )
    return {}


def _with_keypoints(sequence: Sequence, other: Sequence, folder: Path) -> Sequence:
    """Write a sequence once more, with the hand keypoints of another of the same pictures."""
    from physhandi.synthetic.suite.variants import VariantChange, write_variant

    if folder.is_dir():
        return Sequence.load(folder)
    shown = {f"views/{view.name}/keypoint.npy": view.keypoint for view in other.views}
    arrays = {file: keypoint for file, keypoint in shown.items() if keypoint is not None}
    change = VariantChange(meta=sequence.meta, arrays=arrays, without=tuple(shown))
    return write_variant(sequence, change, folder)


def score_fit(
    place: ScenePlace, given: str, search_seed: int, reference_seed: int
) -> dict[str, Any]:
    """Score a fit against the cloud of exact masks, the true paths and the true hand [mm]."""
    from physhandi.data.run import RunFolder
    from physhandi.synthetic.suite.cells import measure_cell

    report, _ = measure_cell(
        RunFolder.open(place.run(given, search_seed)),
        RunFolder.open(place.run("exact", reference_seed)),
        Sequence.load(place.recording),
    )
    scores: dict[str, Any] = {}
    for name, split in _SPLITS.items():
        values = report.get(split, {}).get("rollout", {})
        scores[name] = {f"{metric}_mm": _in_mm(values.get(metric)) for metric in _METRICS}
    hands = [_in_mm(hand.get("mpjpe")) for hand in report.get("hands", {}).values()]
    errors = [error for error in hands if error is not None]
    return scores | {"hand_mpjpe_mm": fmean(errors) if errors else None}


def _in_mm(value: float | None) -> float | None:
    return None if value is None else _MILLIMETRES * value


def _work(channel: Channel) -> None:
    """Do one step of a scene."""
    about: dict[str, Any] = json.loads(channel.arguments[0])
    progress = ToldProgress(channel.tell, _TELL_EVERY_S)
    fields = about["order"] | {"search_seeds": tuple(about["order"]["search_seeds"])}
    order = CaptureOrder(**fields)
    scene = about["scene"]
    place = ScenePlace(Path(about["folder"]), scene, order.seed)
    of_fit = {name: about[name] for name in ("given", "search_seed") if name in about}
    steps: dict[str, Callable[[], dict[str, Any]]] = {
        "make": lambda: make_scene(place, scene, order, progress),
        "import": lambda: import_scene(place, progress),
        "score": lambda: score_import(place),
        "fit": lambda: fit_scene(place, order=order, progress=progress, **of_fit),
        "score_fit": lambda: score_fit(place, reference_seed=about["reference_seed"], **of_fit),
    }
    channel.tell(found=steps[about["step"]]())


if __name__ == "__main__":
    run_child(_work)
