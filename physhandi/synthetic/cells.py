"""Cells of a suite: one method on one sequence, a run folder that is filled once and kept.

A cell's folder is named by a hash of its sequence, method and code, so that a suite that is run
again goes on where it stopped, and anything that changed is computed anew.
"""

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import physhandi
from physhandi.data.atomic import write_array, write_json
from physhandi.data.run import Run
from physhandi.data.run_files import EXIT, artefacts, read_json, read_mapping
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import (
    FitError,
    MissingInputError,
    PhysHandiError,
    SimulationDivergedError,
    SimulationError,
    UsageError,
)
from physhandi.metrics.photometric import photometric_curves
from physhandi.metrics.report import measure_run
from physhandi.progress import Progress
from physhandi.synthetic.baselines import (
    METHODS,
    Method,
    correct,
    execute,
    settings_of,
    shared_stages,
    simulate_in,
)
from physhandi.synthetic.hand_noise import HAND_NOISE
from physhandi.synthetic.variants import DISTURBED_HAND, make_variant

FAILURES = (FitError, MissingInputError, SimulationDivergedError, SimulationError, UsageError)
"""What a method may fail with; its output then counts as missing. Anything else stops the suite.
A fitted radius that reaches nothing in another sequence is told as a wrong use."""
_FITTING = (
    *("pipeline.py", "data", "hand", "perception", "simulation", "fitting"),
    *("synthetic/baselines.py", "synthetic/variants.py"),
)
_PACKAGES = ("torch", "warp-lang", "numpy", "scipy")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came out of a cell."""

    method: str
    """Name of the method."""
    case: str
    """Name of the sequence."""
    variant: str
    """What the method was given."""
    run: str
    """Name of the run folder below ``cells/``; empty if the method could not even begin."""
    error: str = ""
    """Why there is no output, so that the static object stands in; empty if there is one."""
    seconds: Mapping[str, float] = field(default_factory=dict[str, float])
    """Time of each stage [s]."""
    report: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What `physhandi.metrics.report.score_run` says of it, against the whole recording."""
    curves: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Its errors frame by frame."""

    def to_dict(self) -> dict[str, Any]:
        """Describe it in plain data."""
        return asdict(self)


class Bench:
    """Fills the cells of one suite folder."""

    def __init__(
        self, out: Path, *, common: Mapping[str, Any], device: str, progress: Progress
    ) -> None:
        """Prepare; nothing is written yet.

        Args:
            out: Folder of the suite.
            common: Settings that all methods share.
            device: Warp device.
            progress: Told about every iteration.
        """
        self.out = out
        self.common = dict(common)
        self.device = device
        self.progress = progress
        self._settings: dict[str, dict[str, Any]] = {}
        self._finished: dict[Path, Run] = {}

    def reference(self, recording: Sequence) -> Run:
        """Give the run of the static object on a recording: its observations are scored against.

        Raises:
            PhysHandiError: If hands or observations cannot be found; then nothing can be scored.
        """
        return self._run(METHODS["static"], recording, "recording")

    def outcome(self, method: Method, recording: Sequence, variant: str = "recording") -> Outcome:
        """Run a method on a recording, or find what it gave before, and score it.

        Args:
            method: The method.
            recording: The whole recording, which it is scored against.
            variant: What it is given; an oracle gets what its nature asks for.
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

    def lacks(self, method: Method, recording: Sequence, variant: str = "recording") -> str:
        """Say what a recording lacks for a variant of it to be given; empty if nothing."""
        try:
            make_variant(recording, _given(method, variant), self.out / "inputs")
        except MissingInputError as error:
            return str(error)
        return ""

    def unseen(self, method: Method, fitted: Sequence, recording: Sequence) -> Outcome:
        """Simulate the object that was fitted in one recording in another one.

        The object is laid into the new first frame, keeps its rest lengths, and is joined to the
        hands anew; no frame after the first one is fitted. A rule needs no fit.

        Args:
            method: The method, not corrected.
            fitted: Where its object is fitted.
            recording: Where it is simulated and scored, over all frames.
        """
        whole = _as_one_split(recording)
        reference = self.reference(recording)
        if method.rule is not None:
            run = self._run(method, recording, "recording")
            report, curves = self.score(run, reference, whole)
            return Outcome(
                method=method.name,
                case=recording.name,
                variant="unseen",
                run=run.folder.name,
                report=report,
                curves=curves,
            )
        given = "true_hand" if method.gets == "true_hand" else "recording"
        name, error = "", ""
        run: Run | None = None
        try:
            source = self._run(method, fitted, method.gets)
            target = make_variant(recording, given, self.out / "inputs")
            folder = self._cell(
                recording.name, f"{method.name}_unseen", [source.folder.name, given], recording
            )
            name = folder.name
            _raise_again(folder)
            run = simulate_in(
                source,
                target,
                folder,
                title=f"{method.name}, fitted on {fitted.name}, on {recording.name}",
                device=self.device,
                progress=self.progress,
            )
        except FAILURES as failure:
            error = str(failure)
        report, curves = self.score(run, reference, whole)
        return Outcome(
            method=method.name,
            case=recording.name,
            variant="unseen",
            run=name,
            error=error,
            report=report,
            curves=curves,
        )

    def score(
        self, run: Run | None, reference: Run, recording: Sequence
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Measure what a run predicted against what the whole recording shows.

        The run brings its motion, hands and springs; observations are the reference's, whatever
        the run itself was given. Without a run the static object stands in.

        Returns:
            The report and the errors frame by frame.
        """
        parts = [reference.folder.name, "" if run is None else run.folder.name]
        parts += [str(len(recording.reconstruction_frames)), _code_version("metrics")]
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
        path = self.out / "scores" / f"{key}.json"
        if not path.is_file():
            with tempfile.TemporaryDirectory() as folder:
                _assemble(Path(folder), run, reference, recording)
                report, frames = measure_run(Path(folder), recording)
            _add_photometric(report, frames, run, reference, recording)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, {"report": report, "curves": frames.get("rollout", {})})
        known = read_json(path)
        return known["report"], known["curves"]

    def _run(self, method: Method, recording: Sequence, variant: str) -> Run:
        folder = self._folder(method, recording, variant)
        if folder not in self._finished:
            self._finished[folder] = self._filled(method, recording, variant, folder)
        return self._finished[folder]

    def _filled(self, method: Method, recording: Sequence, variant: str, folder: Path) -> Run:
        _raise_again(folder)
        given = make_variant(recording, variant, self.out / "inputs")
        title = f"{method.name} on {recording.name}"
        if method.is_corrected:
            base = self._run(method.base, recording, variant)
            return correct(base, given, folder, title=title, method=method)
        static, disturbance = METHODS["static"], None
        hands = None
        if method.name != static.name:
            hands = self._run(static, recording, variant)
        elif variant == DISTURBED_HAND:
            hands, disturbance = self._run(static, recording, "recording"), HAND_NOISE
        return execute(
            method,
            given,
            folder,
            title=title,
            common=self.common,
            hands=hands,
            disturbance=disturbance,
            device=self.device,
            progress=self.progress,
        )

    def _seconds(
        self, method: Method, recording: Sequence, variant: str, run: Run
    ) -> dict[str, float]:
        """Give the time of each stage; one that was taken over took as long as where it was run."""
        seconds = {s["name"]: float(s.get("seconds", 0.0)) for s in run.stages()}
        base = method.base
        if method.is_corrected:
            before = self._run(base, recording, variant)
            return {**self._seconds(base, recording, variant, before), **seconds}
        if base.name != "static":
            first = self._run(METHODS["static"], recording, variant)
            shared = shared_stages(first.config["profile"], self._settings_of(base))
            for stage in first.stages():
                if stage["name"] in shared:
                    seconds[stage["name"]] = float(stage.get("seconds", 0.0))
        return seconds

    def _settings_of(self, method: Method) -> dict[str, Any]:
        key = json.dumps([method.profile, dict(method.overrides)], sort_keys=True)
        if key not in self._settings:
            self._settings[key] = settings_of(method, self.common)
        return self._settings[key]

    def _folder(self, method: Method, recording: Sequence, variant: str) -> Path:
        about = [variant, method.rule, method.is_corrected, self._settings_of(method)]
        return self._cell(recording.name, method.name, about, recording)

    def _cell(self, case: str, method: str, about: Any, recording: Sequence) -> Path:
        parts = [recording.fingerprint(), method, about, self.device, code_version()]
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]
        name = "".join(c if c.isalnum() else "_" for c in method)
        return self.out / "cells" / f"{case[:28]}-{name[:20]}-{key}"


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash the code that a fit depends on, and the versions of what it computes with."""
    return "-".join(
        [_code_version(part) for part in _FITTING] + [version(package) for package in _PACKAGES]
    )


@lru_cache(maxsize=32)
def _code_version(part: str) -> str:
    path = Path(physhandi.__file__).parent / part
    digest = hashlib.sha256()
    files = [(part, path)] if path.is_file() else list(artefacts(path)) if path.is_dir() else []
    for rel, file in files:
        if file.suffix in {".py", ".yaml", ".npz", ".tflite", ".glb"}:
            digest.update(f"{rel}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def _raise_again(folder: Path) -> None:
    """Repeat how a cell failed before, rather than failing again for as long."""
    found = read_mapping(folder / EXIT) if (folder / EXIT).is_file() else {}
    kinds: dict[str, type[PhysHandiError]] = {kind.__name__: kind for kind in FAILURES}
    kind = kinds.get(str(found.get("error_type", "")))
    if found.get("state") == "failed" and kind is not None:
        raise FitError(str(found.get("error")))


def _add_photometric(
    report: dict[str, Any],
    frames: dict[str, Any],
    run: Run | None,
    reference: Run,
    recording: Sequence,
) -> None:
    """Put IoU and PSNR beside the other figures of the rollout; where it is missing, it stands."""
    name = f"sequences/{recording.name}/rollout.npy"
    rollout = reference.array(name).copy()  # The reference is the static object.
    if run is not None and run.array(name).shape == rollout.shape:
        found = run.array(name)
        is_usable = np.isfinite(found).all(axis=(1, 2))
        rollout[is_usable] = found[is_usable]
    curves = photometric_curves(recording.views, rollout[:, : recording.surface_node_count])
    splits = {
        "reconstruction": recording.reconstruction_frames,
        "future": recording.future_frames,
    }
    for metric, curve in curves.items():
        frames.setdefault("rollout", {})[metric] = [
            float(value) if np.isfinite(value) else None for value in curve
        ]
        for split, scored in splits.items():
            known = [float(curve[f]) for f in scored if f > 0 and np.isfinite(curve[f])]
            if known and split in report:
                report[split]["rollout"][metric] = sum(known) / len(known)


def _given(method: Method, variant: str) -> str:
    return method.gets if variant == "recording" else variant


def _as_one_split(recording: Sequence) -> Sequence:
    meta = replace(recording.meta, reconstruction=recording.frame_count)
    return Sequence(recording.folder, meta)


def _assemble(folder: Path, run: Run | None, reference: Run, recording: Sequence) -> None:
    """Lay out what is scored: the run's motion beside the reference's observations."""
    inside = f"sequences/{recording.name}"
    observed = (f"{inside}/observation/", f"{inside}/keypoint.npy")
    left_out = ("rollout.npy", "control.npy") if run is None else ()
    chosen = {r: path for r, path in artefacts(reference.out) if r.startswith(observed)} | {
        rel: path
        for rel, path in artefacts((reference if run is None else run).out)
        if not rel.startswith(observed) and not rel.endswith(left_out)
    }
    for rel, path in chosen.items():
        target = folder / rel
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())
    truth = read_truth(recording.folder).hand_vertex
    if run is not None and not any("_vertex.npy" in rel for rel in chosen):
        for side in recording.hands:  # An oracle moves the object with the true hand itself.
            if side in truth:
                write_array(folder / inside / f"hand_{side}_vertex.npy", truth[side])
