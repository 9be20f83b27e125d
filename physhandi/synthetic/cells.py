"""Cells of a suite: one method on one sequence, a run folder that is filled once and kept.

A cell's folder is named by a hash of its sequence, method and code, so that a suite that is run
again goes on where it stopped, and anything that changed is computed anew. Several processes may
fill cells of one folder: who needs a cell that another one is filling waits for it.
"""

import hashlib
import json
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import warp as wp

from physhandi.data.atomic import write_json
from physhandi.data.environment import processor_name
from physhandi.data.lease import locked_file
from physhandi.data.run import Run
from physhandi.data.run_files import EXIT, read_json, read_mapping
from physhandi.data.sequence import Sequence
from physhandi.errors import (
    FitError,
    MissingInputError,
    PhysHandiError,
    SimulationDivergedError,
    SimulationError,
    UsageError,
)
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
from physhandi.synthetic.cell_scores import measure_cell
from physhandi.synthetic.code_hash import PREDICTIONS, SCORES, code_version
from physhandi.synthetic.hand_noise import HAND_NOISE, HandNoise
from physhandi.synthetic.variants import DISTURBED_HAND, make_variant, noise_seed

FAILURES = (FitError, MissingInputError, SimulationDivergedError, SimulationError)
"""What a method may fail with; its output then counts as missing. Anything else stops the suite,
a setting that only a fit finds wrong too."""


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
        name = processor_name() if device == "cpu" else wp.get_device(device).name
        self.device_name = f"{device} {name}"
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

        Raises:
            UsageError: If the fit finds that a setting makes no sense.
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
            self._make_variant(recording, _given(method, variant))
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
            target = self._make_variant(recording, given)
            folder = self._cell(
                recording.name, f"{method.name}_unseen", [source.folder.name, given], recording
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
        parts += [str(len(recording.reconstruction_frames)), code_version(SCORES)]
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
        path = self.out / "scores" / f"{key}.json"
        if not path.is_file():
            report, curves = measure_cell(run, reference, recording)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, {"report": report, "curves": curves})
        known = read_json(path)
        return known["report"], known["curves"]

    def _run(self, method: Method, recording: Sequence, variant: str) -> Run:
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
        """Make sure that no other process works on something; wait until that one is finished.

        Who holds one only waits for what it is made from, so none waits for itself.
        """
        folder = self.out / "locks"
        folder.mkdir(parents=True, exist_ok=True)
        with locked_file(folder / name):
            yield

    def _filled(self, method: Method, recording: Sequence, variant: str, folder: Path) -> Run:
        _raise_again(folder)
        given = self._make_variant(recording, variant)
        title = f"{method.name} on {recording.name}"
        if method.is_corrected:
            base = self._run(method.base, recording, variant)
            return correct(base, given, folder, title=title, method=method)
        still, hands, noise = self._still(method), None, None
        if method.name != still.name:
            hands = self._run(still, recording, variant)
        elif variant == DISTURBED_HAND:
            hands = self._run(still, recording, "recording")
            noise = HandNoise(error=HAND_NOISE, seed=noise_seed(recording, variant))
        try:
            return execute(
                method,
                given,
                folder,
                title=title,
                common=self.common,
                hands=hands,
                noise=noise,
                device=self.device,
                progress=self.progress,
            )
        except UsageError as error:
            told = f"Method '{method.name}' on sequence '{recording.name}': {error}"
            raise UsageError(told) from error

    def _simulated(self, source: Run, target: Sequence, folder: Path, *, title: str) -> Run:
        """Simulate what was fitted elsewhere; a radius that reaches nothing there is no misuse."""
        try:
            with self._alone(folder.name):
                _raise_again(folder, also=UsageError)
                return simulate_in(
                    source, target, folder, title=title, device=self.device, progress=self.progress
                )
        except UsageError as error:
            raise FitError(str(error)) from error

    def _still(self, method: Method) -> Method:
        """Give the method whose run has the hands of a method: the static one, if they agree."""
        static, own = METHODS["static"], method.base
        if shared_stages(self._settings_of(static), self._settings_of(method)):
            return static
        if own.rule == "static":
            return own
        return replace(own, name=f"static for {own.name}", rule="static", gets="recording")

    def _seconds(
        self, method: Method, recording: Sequence, variant: str, run: Run
    ) -> dict[str, float]:
        """Give the time of each stage; one that was taken over took as long as where it was run.

        A run that was stopped and went on does not know how long it took, so it has no times.
        """
        if run.attempt != 1:
            return {}
        seconds = {s["name"]: float(s.get("seconds", 0.0)) for s in run.stages()}
        base = method.base
        if method.is_corrected:
            before = self._seconds(base, recording, variant, self._run(base, recording, variant))
            return {**before, **seconds} if before else {}
        still = self._still(base)
        if base.name != still.name:
            first = self._run(still, recording, variant)
            taken = self._seconds(still, recording, variant, first)
            shared = shared_stages(first.config["profile"], self._settings_of(base))
            if not taken:
                return {}
            seconds |= {name: taken[name] for name in shared if name in taken}
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
    """Repeat how a cell failed before, rather than failing again for as long."""
    found = read_mapping(folder / EXIT) if (folder / EXIT).is_file() else {}
    kinds = {kind.__name__ for kind in (*FAILURES, also) if kind is not None}
    if found.get("state") == "failed" and str(found.get("error_type", "")) in kinds:
        raise FitError(str(found.get("error")))


def _given(method: Method, variant: str) -> str:
    return method.gets if variant == "recording" else variant


def _as_one_split(recording: Sequence) -> Sequence:
    meta = replace(recording.meta, reconstruction=recording.frame_count)
    return Sequence(recording.folder, meta)
