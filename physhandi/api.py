"""What `import physhandi` offers: load recordings, fit them, simulate what was fitted."""

from collections.abc import Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physhandi.data.run import RunFolder, RunKind
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.progress import Watcher, watched
from physhandi.run import Run

if TYPE_CHECKING:
    from physhandi.fitting.checks.recording_check import RecordingCheck
    from physhandi.fitting.config import PipelineConfig
    from physhandi.simulation.edits import Edit, Edits


def load(folder: Path | str) -> Sequence:
    """Open a recording.

    Args:
        folder: Folder with ``sequence.yaml`` (docs/formats.md).

    Raises:
        SequenceError: If something in it is wrong; names file, frame and field.
    """
    return Sequence.load(folder)


def check(recording: Sequence | Path | str, *, progress: Watcher = None) -> "RecordingCheck":
    """Read a whole recording: what each stage of a fit can do with it, and every problem.

    Args:
        recording: A recording, or its folder, which may be damaged.
        progress: True shows a bar, a callable is given stage, iteration, total, loss and message.

    Returns:
        ``stages`` by their names, each with ``is_ready``, ``missing``, ``why`` and ``remedy``, and
        ``problems``, each with ``level``, ``file``, ``frame``, ``field``, ``message``, ``remedy``.
    """
    from physhandi.fitting.checks.recording_check import check_recording

    with watched(progress) as watch:
        return check_recording(recording, watch)


def open_run(folder: Path | str) -> Run:
    """Open a run that was made before, finished or not.

    Args:
        folder: Folder with ``run.yaml``.

    Raises:
        RunError: If it is no run, or is damaged; names the file.
    """
    return Run.open(folder)


def reconstruct(
    sequences: Sequence | Many[Sequence],
    *,
    profile: "str | Path | PipelineConfig" = "default",
    overrides: Mapping[str, Any] | None = None,
    out: Path | str | None = None,
    progress: Watcher = None,
    device: str = "cpu",
) -> Run:
    """Reconstruct hands and object of one or several recordings of the same object.

    A run that was interrupted goes on from its latest checkpoint and ends with the same bits; one
    that is finished and was asked for the same is opened as it is.

    Args:
        sequences: The recordings; the first one defines the object's nodes.
        profile: Name of a profile (``quick``, ``default``, ``paper``, ``phystwin``), a profile
            file, or all settings.
        overrides: New values of settings by their paths, such as
            ``{"object_.search.generations": 12}``.
        out: Folder of the run; ``runs/<sequence>_<profile>`` if left out.
        progress: True shows a bar, a callable is given stage, iteration, total, loss and message.
        device: Warp device, such as ``"cuda:0"``.

    Raises:
        UsageError: If a setting is unknown or out of bounds, or `out` holds something else.
        SequenceError: If a recording is damaged.
        MissingInputError: If a recording has nothing to fit.
        FitError: If an optimisation has no usable result.
        RunError: If another process works on the run.
    """
    from physhandi.fitting.config import (
        PipelineConfig,
        apply_overrides,
        load_profile,
        overrides_of,
    )

    recordings = _listed(sequences)
    base = profile if isinstance(profile, PipelineConfig) else load_profile(profile)
    config = apply_overrides(base, overrides or {})
    changed = overrides_of(config, base)
    folder = out or Path("runs") / f"{recordings[0].name}_{config.profile}"
    settings = {"profile": config.to_dict()} | ({"overrides": changed} if changed else {})
    return _execute(
        folder, "reconstruction", recordings, settings, progress=progress, device=device
    )


def simulate(
    run: RunFolder | Path | str,
    sequences: Sequence | Many[Sequence] | None = None,
    *,
    out: Path | str | None = None,
    progress: Watcher = None,
    device: str = "cpu",
    edits: "Many[Edit] | None" = None,
    **changes: Any,
) -> Run:
    """Simulate a fitted object with other parameters or in other recordings, and store a run.

    ``run.object.simulate`` does the same without storing or measuring anything.

    Args:
        run: The finished run, or its folder.
        sequences: Recordings of the same object; those of the run if left out.
        out: Folder of the new run; ``runs/<run>_simulated`` if left out.
        progress: True shows a bar, a callable is given stage, iteration, total, loss and message.
        device: Warp device, such as ``"cuda:0"``.
        edits: What is done to single springs and nodes (`physhandi.simulation.edits`), in the place
            of the run's own edits; left out, it is these.
        changes: New values of simulation parameters, such as ``stiffness_scale=0.3``.

    Raises:
        UsageError: If a parameter is unknown or out of bounds, leaves no spring, an edit cannot be
            made, or `out` holds something else.
        RunError: If the run is not finished or is damaged.
        SimulationDivergedError: If the motion runs away.
    """
    from physhandi.fitting.stored_edits import describe_edits
    from physhandi.simulation.edits import checked_edits
    from physhandi.simulation.parameters import SimulationParameters, changed_parameters

    source = run if isinstance(run, RunFolder) else RunFolder.open(run)
    changed_parameters(SimulationParameters(), changes)  # Refuses them before a run is made.
    source.verify(allows_more=True)
    recordings = (
        [Sequence.load(folder) for folder in source.sequences]
        if sequences is None
        else _listed(sequences)
    )
    folder = out or Path("runs") / f"{source.id}_simulated"
    settings: dict[str, Any] = {
        "source": str(source.folder.resolve()),
        "parameters": dict(changes),
    }
    checked = None if edits is None else checked_edits(edits)
    if checked is not None:
        settings["edits"] = describe_edits(checked)
    return _execute(
        folder,
        "simulation",
        recordings,
        settings,
        edits=checked,
        progress=progress,
        device=device,
    )


def prepare_run(
    folder: Path | str,
    kind: RunKind,
    recordings: Many[Sequence],
    settings: Mapping[str, Any],
    *,
    name: str = "",
) -> Run:
    """Make the run in a folder, or open it if it is there and was asked for the same.

    Args:
        folder: Where the run shall be.
        kind: What is to be done.
        recordings: What it is done with.
        settings: Its configuration, in plain data.
        name: What a new run is called; its folder's name if left out.

    Raises:
        UsageError: If the folder holds another run.
        RunError: If the folder cannot be used.
    """
    path = Path(folder)
    paths = [str(recording.folder) for recording in recordings]
    if not (path / "run.yaml").is_file():
        name = name or path.resolve().name
        return Run.create(path, name=name, kind=kind, sequences=paths, config=settings)
    run = Run.open(path)
    if run.kind != kind or run.config != _known_to(run, settings) or list(run.sequences) != paths:
        raise UsageError(
            f"{path} already holds another run. Choose another folder, or delete that one first."
        )
    return run


def _known_to(run: Run, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Drop settings that there were not yet when a run was made; it goes on as it began."""
    from physhandi.fitting.config import without_newer

    shared = dict(settings)
    if "profile" in settings and "profile" in run.config:
        shared["profile"] = without_newer(settings["profile"], run.asked("profile", dict[str, Any]))
    return shared


def _execute(
    folder: Path | str,
    kind: RunKind,
    recordings: Many[Sequence],
    settings: Mapping[str, Any],
    *,
    edits: "Edits | None" = None,
    progress: Watcher,
    device: str,
) -> Run:
    from physhandi import pipeline
    from physhandi.fitting.stored_edits import store_edits

    for recording in recordings:
        recording.validate(reads_color=False)  # Tells wrong data before a run is made.
    run = prepare_run(folder, kind, recordings, settings)
    if run.is_published:
        run.verify(allows_more=True)
        return run
    if edits is not None:
        store_edits(run.folder, edits)
    with watched(progress) as watch:
        pipeline.run_job(run, watch, device=device)
    return Run.open(run.folder)


def _listed(sequences: Sequence | Many[Sequence]) -> list[Sequence]:
    recordings = [sequences] if isinstance(sequences, Sequence) else list(sequences)
    if not recordings:
        raise UsageError("Name at least one sequence.")
    for recording in recordings:
        if not isinstance(recording, Sequence):
            raise UsageError(
                f"{recording!r} is no sequence; open its folder with physhandi.load first."
            )
    return recordings
