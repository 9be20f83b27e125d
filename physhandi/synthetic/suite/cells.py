"""Cells of a suite: one method on one sequence, a run folder that is computed once and reused.

A cell's folder is named by a hash of its sequence, method and code, so that a repeated suite
continues where it stopped and recomputes what has changed. Several processes may compute cells of
one folder; a process that needs a cell in progress waits for it.
"""

import hashlib
import json
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from safetensors.numpy import save

from physhandi.appearance.lpips import Lpips, user_lpips
from physhandi.appearance.scoring import (
    PHYSTWIN,
    PictureCurves,
    add_picture_scores,
    picture_curves,
    rebound,
)
from physhandi.appearance.splats import Splats
from physhandi.data.arrays import read_tensors, write_array
from physhandi.data.files import write_bytes, write_json
from physhandi.data.layout import SequenceFiles
from physhandi.data.lease import locked_file
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import (
    EXIT,
    artefacts,
    checked,
    read_json,
    read_mapping,
    read_record,
    reading,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SIDES
from physhandi.data.truth import read_truth
from physhandi.devices import describe_device
from physhandi.errors import (
    FitError,
    MissingInputError,
    PhysHandiError,
    RunError,
    SimulationDivergedError,
    SimulationError,
    UsageError,
)
from physhandi.metrics.photometric import Perceptual
from physhandi.metrics.report import measure_run
from physhandi.metrics.truth_metrics import true_surface
from physhandi.progress import Progress
from physhandi.synthetic.code_version import LOOKS, PREDICTIONS, SCORES, code_version
from physhandi.synthetic.suite.methods import (
    HAND_NOISE,
    METHODS,
    HandNoise,
    Method,
    correct,
    execute,
    fit_look,
    look_settings,
    method_settings,
    shared_stages,
    shows_look,
    simulate_in,
)
from physhandi.synthetic.suite.variants import DISTURBED_HAND, make_variant, noise_seed

FAILURES = (FitError, MissingInputError, SimulationDivergedError, SimulationError)
"""Errors after which a method's output counts as missing. Any other error stops the suite, also a
setting that only the fit finds invalid."""

UNSEEN = "unseen"
"""Variant of cells whose object was fitted on another recording."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a cell."""

    method: str
    """Name of the method."""
    case: str
    """Name of the sequence."""
    variant: str
    """Variant of the sequence that was the method's input."""
    run: str
    """Name of the run folder below ``cells/``; empty if the method could not start."""
    error: str = ""
    """Why there is no output and the static object is scored instead; empty if there is one."""
    seconds: Mapping[str, float] = field(default_factory=dict[str, float])
    """Time of each stage [s]."""
    report: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Scores against the whole recording, as `physhandi.metrics.report.score_run` returns them."""
    curves: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Errors frame by frame."""


class StoredScores(TypedDict):
    """A file of ``scores/``: how a run was scored."""

    report: dict[str, Any]
    curves: dict[str, Any]


class Bench:
    """Computes and scores the cells of one suite folder."""

    def __init__(
        self,
        out: Path,
        *,
        common: Mapping[str, Any],
        device: str,
        progress: Progress,
        device_name: str | None = None,
    ) -> None:
        """Prepare; nothing is written yet.

        Args:
            out: Folder of the suite.
            common: Settings that all methods share.
            device: Warp device.
            progress: Receives a report of every iteration.
            device_name: What the device calls itself, if it is another machine's whose finished
                cells are looked at here; None asks it.
        """
        self.out = out
        self.common = dict(common)
        self.device = device
        if device_name is None:
            device_name = describe_device(device)
        self.device_name = f"{device} {device_name}"
        self.progress = progress
        self._settings: dict[str, dict[str, Any]] = {}
        self._finished: dict[Path, RunFolder] = {}

    def reference(self, recording: Sequence) -> RunFolder:
        """Get the run of the static object on a recording, whose observations all scores use.

        Raises:
            PhysHandiError: If hands or observations cannot be reconstructed, so that nothing can be
                scored.
        """
        return self._run(METHODS["static"], recording, "recording")

    def outcome(self, method: Method, recording: Sequence, variant: str = "recording") -> Outcome:
        """Run a method on a recording, or reuse its finished run, and score it.

        Args:
            method: The method.
            recording: The whole recording, which it is scored against.
            variant: Input of the method; an oracle has an input of its own.

        Raises:
            UsageError: If the fit finds a setting invalid.
        """
        variant = _given(method, variant)
        reference = self.reference(recording)
        folder = self._folder(method, recording, variant)
        try:
            run = self._run(method, recording, variant)
        except FAILURES as error:
            report, curves = self.score(None, reference, recording)
            ran = folder.name if folder.is_dir() else ""
            return Outcome(
                method=method.name,
                case=recording.name,
                variant=variant,
                run=ran,
                error=str(error),
                report=report,
                curves=curves,
            )
        report, curves = self.score(run, reference, recording)
        return Outcome(
            method=method.name,
            case=recording.name,
            variant=variant,
            run=folder.name,
            seconds=self._seconds(method, recording, variant, run),
            report=report,
            curves=curves,
        )

    def without_output(
        self, method: Method, recording: Sequence, variant: str, why: str
    ) -> Outcome | None:
        """Score the static object in the place of a method whose output was lost.

        Args:
            method: The method.
            recording: What it is scored against.
            variant: Its input, or `UNSEEN`.
            why: What became of its output.

        Returns:
            None if the static object's run is not there either; nothing is computed here.
        """
        folder = self._folder(METHODS["static"], recording, "recording")
        if not (folder / "run.yaml").is_file():
            return None
        reference = RunFolder.open(folder)
        if not reference.is_published:
            return None
        is_unseen = variant == UNSEEN
        scored = _as_one_split(recording) if is_unseen else recording
        report, curves = self.score(None, reference, scored)
        return Outcome(
            method=method.name,
            case=recording.name,
            variant=variant if is_unseen else _given(method, variant),
            run="",
            error=why,
            report=report,
            curves=curves,
        )

    def lacks(self, method: Method, recording: Sequence, variant: str = "recording") -> str:
        """Explain what a recording lacks for a variant of it; empty if nothing."""
        if method.gets == "truth" and true_surface(read_truth(recording.folder)) is None:
            return (
                f"Sequence '{recording.name}' has no truth/object_point.npy with "
                "truth/object_face.npy, so its true motion is not known."
            )
        try:
            self._make_variant(recording, _given(method, variant))
        except MissingInputError as error:
            return str(error)
        return ""

    def unseen(self, method: Method, fitted: Sequence, recording: Sequence) -> Outcome:
        """Simulate the object fitted on one recording in another one.

        The object is aligned with the new first frame, keeps its rest lengths, and gets new virtual
        springs; no frame after the first one is fitted. A rule needs no fit.

        Args:
            method: The method, without correction.
            fitted: Recording on which the object is fitted.
            recording: Recording in which it is simulated and scored, over all frames.
        """
        whole = _as_one_split(recording)
        reference = self.reference(recording)
        if method.rule is not None:
            run = self._run(method, recording, "recording")
            report, curves = self.score(run, reference, whole)
            return Outcome(
                method=method.name,
                case=recording.name,
                variant=UNSEEN,
                run=run.folder.name,
                report=report,
                curves=curves,
            )
        variant = "true_hand" if method.gets == "true_hand" else "recording"
        name, error = "", ""
        run: RunFolder | None = None
        try:
            source = self._run(method, fitted, method.gets)
            target = self._make_variant(recording, variant)
            folder = self._cell(
                recording.name, f"{method.name}_unseen", [source.folder.name, variant], recording
            )
            name = folder.name
            run = self._simulated(
                source,
                target,
                folder,
                title=f"{method.name}, fitted on {fitted.name}, on {recording.name}",
            )
        except FAILURES as failure:
            error = str(failure)
        report, curves = self.score(run, reference, whole)
        return Outcome(
            method=method.name,
            case=recording.name,
            variant=UNSEEN,
            run=name,
            error=error,
            report=report,
            curves=curves,
        )

    def score(
        self, run: RunFolder | None, reference: RunFolder, recording: Sequence
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Score a run against the whole recording (`measure_cell`), or reuse stored scores."""
        look = self.look(recording)
        parts = [reference.folder.name, "" if run is None else run.folder.name]
        parts += ["" if look is None else look.name]
        parts += [str(len(recording.reconstruction_frames)), code_version(SCORES)]
        perceptual = None if look is None else self._perceptual
        parts += [] if perceptual is None else [perceptual.sha256]
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
        path = self.out / "scores" / f"{key}.json"
        try:
            stored = read_record(path, StoredScores)
        except RunError:
            stored = None  # Damaged: it is measured again.
        if stored is None:
            report, curves = measure_cell(
                run,
                reference,
                recording,
                splats=None if look is None else read_look(look),
                progress=self.progress,
                device=self.device,
                perceptual=perceptual,
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, {"report": report, "curves": curves})
            stored = checked(read_json(path), StoredScores, path)
        return stored["report"], stored["curves"]

    @cached_property
    def _perceptual(self) -> Lpips | None:
        return user_lpips(self.device)

    def look(self, recording: Sequence) -> Path | None:
        """Fit what the object of a recording looks like, once for all methods, or find it fitted.

        Returns:
            The splats' file; None if the order leaves them out, or no view has color and masks.
        """
        config = look_settings(self.common)
        reference = self.reference(recording)
        if not config.enabled or not shows_look(reference, recording):
            return None
        parts = [reference.folder.name, config.to_dict(), code_version(LOOKS)]
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]
        path = self.out / "looks" / f"{recording.name[:28]}-{key}.safetensors"
        with self._alone(path.stem):
            if not path.is_file():
                splats = fit_look(
                    reference, recording, config, device=self.device, progress=self.progress
                )
                path.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(path, save(splats.to_tensors()))
        return path

    def _run(self, method: Method, recording: Sequence, variant: str) -> RunFolder:
        folder = self._folder(method, recording, variant)
        if folder not in self._finished:
            with self._alone(folder.name):
                self._finished[folder] = self._filled(method, recording, variant, folder)
        return self._finished[folder]

    def _make_variant(self, recording: Sequence, variant: str) -> Sequence:
        with self._alone(f"{recording.name}-{variant}"):
            return make_variant(recording, variant, self.out / "inputs")

    @contextmanager
    def _alone(self, name: str) -> Generator[None]:
        """Hold a lock between processes while a cell or variant is computed.

        The holder waits only for locks of its own inputs, so there are no deadlocks.
        """
        folder = self.out / "locks"
        folder.mkdir(parents=True, exist_ok=True)
        with locked_file(folder / name, self._tell_holder):
            yield

    def _tell_holder(self, holder: str) -> None:
        """Say for whom this process waits, which may be one of another command."""
        self.progress.report(f"waits for {holder}", 0, 0)

    def _filled(self, method: Method, recording: Sequence, variant: str, folder: Path) -> RunFolder:
        _raise_again(folder)
        inputs = self._make_variant(recording, variant)
        title = f"{method.name} on {recording.name}"
        if method.correction is not None:
            return correct(
                self._run(method.base, recording, variant),
                inputs,
                folder,
                title=title,
                method=method,
                device=self.device,
                progress=self.progress,
            )
        still, hands, noise = self._still(method), None, None
        truth = true_surface(read_truth(recording.folder)) if method.gets == "truth" else None
        if method.name != still.name:
            hands = self._run(still, recording, variant)
        elif variant == DISTURBED_HAND:
            hands = self._run(still, recording, "recording")
            noise = HandNoise(error=HAND_NOISE, seed=noise_seed(recording, variant))
        try:
            return execute(
                method,
                inputs,
                folder,
                title=title,
                common=self.common,
                hands=hands,
                noise=noise,
                truth=truth,
                device=self.device,
                progress=self.progress,
            )
        except UsageError as error:
            message = f"Method '{method.name}' on sequence '{recording.name}': {error}"
            raise UsageError(message) from error

    def _simulated(
        self, source: RunFolder, target: Sequence, folder: Path, *, title: str
    ) -> RunFolder:
        """Simulate an object fitted elsewhere; springs that do not form count as a failed fit."""
        try:
            with self._alone(folder.name):
                _raise_again(folder, also=UsageError)
                return simulate_in(
                    source, target, folder, title=title, device=self.device, progress=self.progress
                )
        except UsageError as error:
            raise FitError(str(error)) from error

    def _still(self, method: Method) -> Method:
        """Get the method whose run provides a method's hands: the static one, if settings agree."""
        static, own = METHODS["static"], method.base
        if shared_stages(self._settings_of(static), self._settings_of(method)):
            return static
        if own.rule == "static":
            return own
        return replace(own, name=f"static for {own.name}", rule="static", gets="recording")

    def _seconds(
        self, method: Method, recording: Sequence, variant: str, run: RunFolder
    ) -> dict[str, float]:
        """Get the time of each stage [s]; a reused stage counts with the time of its own run.

        Empty for a run that was interrupted, whose times are unknown.
        """
        if run.attempt != 1:
            return {}
        seconds = {s["name"]: float(s.get("seconds", 0.0)) for s in run.stages()}
        base = method.base
        if method.correction is not None:
            before = self._seconds(base, recording, variant, self._run(base, recording, variant))
            return {**before, **seconds} if before else {}
        still = self._still(base)
        if base.name != still.name:
            first = self._run(still, recording, variant)
            first_seconds = self._seconds(still, recording, variant, first)
            shared = shared_stages(first.asked("profile", dict[str, Any]), self._settings_of(base))
            if not first_seconds:
                return {}
            seconds |= {name: first_seconds[name] for name in shared if name in first_seconds}
        return seconds

    def _settings_of(self, method: Method) -> dict[str, Any]:
        key = json.dumps([method.profile, dict(method.overrides)], sort_keys=True)
        if key not in self._settings:
            self._settings[key] = method_settings(method, self.common)
        return self._settings[key]

    def _folder(self, method: Method, recording: Sequence, variant: str) -> Path:
        about = [variant, method.rule, method.correction, self._settings_of(method)]
        return self._cell(recording.name, method.name, about, recording)

    def _cell(self, case: str, method: str, about: Any, recording: Sequence) -> Path:
        parts = [
            recording.fingerprint(),
            method,
            about,
            self.device_name,
            code_version(PREDICTIONS),
        ]
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]
        name = "".join(c if c.isalnum() else "_" for c in method)
        return self.out / "cells" / f"{case[:28]}-{name[:20]}-{key}"


def _raise_again(folder: Path, *, also: type[PhysHandiError] | None = None) -> None:
    """Raise the stored error of a cell that failed before, without running it again."""
    outcome = read_mapping(folder / EXIT) if (folder / EXIT).is_file() else {}
    kinds = {kind.__name__ for kind in (*FAILURES, also) if kind is not None}
    if outcome.get("state") == "failed" and str(outcome.get("error_type", "")) in kinds:
        raise FitError(str(outcome.get("error")))


def _given(method: Method, variant: str) -> str:
    """Name the input of a method; the truth is given beside the recording, not in it."""
    own = "recording" if method.gets == "truth" else method.gets
    return own if variant == "recording" else variant


def _as_one_split(recording: Sequence) -> Sequence:
    meta = replace(recording.meta, reconstruction=recording.frame_count)
    return Sequence(recording.folder, meta)


def read_look(path: Path) -> Splats:
    """Read what `Bench.look` fitted.

    Raises:
        RunError: If the file is damaged.
    """
    with reading(path):
        return Splats.from_tensors(read_tensors(path))


def measure_cell(
    run: RunFolder | None,
    reference: RunFolder,
    recording: Sequence,
    *,
    splats: Splats | None = None,
    progress: Progress | None = None,
    device: str = "cpu",
    perceptual: Perceptual | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Score a run's prediction.

    Motion, hands and springs are the run's; observations are the reference's, whatever the input of
    the run was. Without a run the static object is scored.

    Args:
        run: The run to score.
        reference: The static object on the same recording.
        recording: The whole recording, with its truth.
        splats: What its object looks like; None compares no pictures.
        progress: Told about every frame that is drawn.
        device: Warp device that draws.
        perceptual: Network for LPIPS of pictures; None leaves it out.

    Returns:
        The report and the errors of the rollout frame by frame.
    """
    with tempfile.TemporaryDirectory() as folder:
        assemble(Path(folder), run, reference, recording)
        report, frames = measure_run(Path(folder), recording, with_baselines=False)
    curves: dict[str, Any] = frames.get("rollout", {})
    if splats is not None:
        # Missing frames show the object of frame 0; the method's own nodes carry the splats.
        rollout = _complete(run or reference, recording)
        measured = picture_curves(
            recording,
            rollout,
            rebound(splats, rollout[0]),
            progress,
            stage="pictures",
            device=device,
            perceptual=perceptual,
        )
        add_photometric(report, curves, measured, recording)
    return report, curves


def assemble(
    folder: Path, run: RunFolder | None, reference: RunFolder, recording: Sequence
) -> None:
    """Link the files to score into a folder: the run's motion, the reference's observations."""
    files = SequenceFiles(recording.name)
    observed = (f"{files.folder}/observation/", files.keypoint)
    left_out = (files.rollout, files.control) if run is None else ()
    chosen = {r: path for r, path in artefacts(reference.out) if r.startswith(observed)} | {
        rel: path
        for rel, path in artefacts((reference if run is None else run).out)
        if not rel.startswith(observed) and rel not in left_out
    }
    for rel, path in chosen.items():
        target = folder / rel
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())
    truth = read_truth(recording.folder).hand_vertex
    if run is not None and not any(files.hand_vertex(side) in chosen for side in SIDES):
        for side in recording.hands:  # An oracle moves the object with the true hand itself.
            if side in truth:
                write_array(folder / files.hand_vertex(side), truth[side])


def add_photometric(
    report: dict[str, Any],
    curves: dict[str, Any],
    measured: PictureCurves,
    recording: Sequence,
) -> None:
    """Add what pictures of the rollout score to its other figures.

    By PhysTwin's definition figures are called ``psnr``, ``ssim``, ``iou`` and ``lpips``; those of
    proper scores end in ``_proper``, and in ``_held_out`` where they are of held-out views alone.
    """
    splits = {
        "reconstruction": recording.reconstruction_frames,
        "future": recording.future_frames,
    }
    add_picture_scores(report, measured, splits)
    for definition, by_score in measured.items():
        suffix = "" if definition == PHYSTWIN else f"_{definition}"
        for score, curve in by_score.items():
            metric = f"{score}{suffix}"
            curves[metric] = [float(value) if np.isfinite(value) else None for value in curve]
            for split in splits.keys() & report.keys():
                of_rollout = report[split]["rollout"]
                of_rollout[metric] = of_rollout["photometric"][definition][score]


def _complete(run: RunFolder, recording: Sequence) -> Float[ndarray, "frame node 3"]:
    """Complete a run's rollout: missing and non-finite frames show the object of frame 0 [m]."""
    files = SequenceFiles(recording.name)
    rollout = run.array(files.rollout)
    still = run.array(files.object_node) if run.has(files.object_node) else rollout[0]
    complete = np.repeat(still[None].astype(rollout.dtype), recording.frame_count, axis=0)
    count = min(len(rollout), recording.frame_count)
    is_usable = np.isfinite(rollout[:count]).all(axis=(1, 2))
    complete[:count][is_usable] = rollout[:count][is_usable]
    return complete
