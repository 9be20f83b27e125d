"""What each command does; returns plain data and never prints."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

from pydantic import ValidationError

from app.cli.arguments import ImportMano, ImportMocap, ImportPhystwin, ImportStereo
from app.jobs.catalog import Catalog
from app.settings import Settings
from physhandi.data.files import plain, without_non_finite
from physhandi.data.run import RunKind
from physhandi.data.sequence import Sequence
from physhandi.devices import pick_device
from physhandi.errors import RunError, UsageError
from physhandi.fitting.config import load_profile
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters, changed_parameters

OVERRIDES = (
    "connection_radius",
    "max_neighbors",
    "virtual_connection_radius",
    "virtual_max_neighbors",
    "stiffness_scale",
    "damping",
    "drag",
    "restitution",
    "friction",
    "self_collision",
    "collision_distance",
    "self_restitution",
    "self_friction",
    "substeps_per_frame",
)


def read_settings(**given: Any) -> Settings:
    """Read the settings; where an argument is None, the environment speaks, then the default.

    Raises:
        UsageError: If a value is out of range; names it.
    """
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "settings"
        raise UsageError(f"{where}: {first['msg']}.") from None


def open_catalog(data_dir: Path | None) -> Catalog:
    """Find sequences and runs in a data folder and among the bundled ones."""
    return Catalog(read_settings(data_dir=data_dir))


def find_sequence(name: str, data_dir: Path | None) -> Sequence:
    """Open a sequence by folder or by name.

    Raises:
        UsageError: If there is no such sequence.
        SequenceError: If it breaks the format.
    """
    if (Path(name) / "sequence.yaml").is_file():
        return Sequence.load(Path(name))
    catalog = open_catalog(data_dir)
    known = [entry.id for entry in catalog.sequences()]
    if name not in known:
        raise UsageError(
            f"'{name}' is neither a folder with a sequence.yaml nor a known sequence. "
            f"Known are: {', '.join(known) or 'none'}."
        )
    return catalog.sequence(name)


def find_run(name: str, data_dir: Path | None) -> Run:
    """Open a run by folder or by id.

    Raises:
        RunError: If there is no such run.
    """
    if (Path(name) / "run.yaml").is_file():
        return Run.open(Path(name))
    catalog = open_catalog(data_dir)
    known = [entry.id for entry in catalog.runs()]
    if name not in known:
        raise RunError(
            f"'{name}' is neither a run folder nor a known run. "
            f"Known are: {', '.join(known) or 'none'}."
        )
    return catalog.run(name)


def find_result(name: str, data_dir: Path | None) -> Run:
    """Open a finished run whose files are all as they were published.

    Raises:
        RunError: If there is no such run, it is not finished, or a file is missing or changed.
    """
    run = find_run(name, data_dir)
    run.verify(allows_more=True)
    return run


def reconstruct(command: Any, progress: Progress) -> dict[str, Any]:
    """Fit sequences into a run folder; an existing unfinished one of the same kind goes on."""
    if not command.sequences:
        raise UsageError("Name at least one sequence to reconstruct.")
    sequences = [find_sequence(name, command.data_dir) for name in command.sequences]
    for sequence in sequences:
        sequence.validate(reads_color=False)  # Tells wrong data before a run is made.
    device = pick_device(command.device)
    config = {"profile": load_profile(command.profile).to_dict()}
    paths = [str(sequence.folder) for sequence in sequences]
    return _execute(_run_at(command.out, "reconstruction", paths, config), device, progress)


def simulate(command: Any, progress: Progress) -> dict[str, Any]:
    """Simulate a fitted object again into a run folder of its own."""
    source = find_result(command.run, command.data_dir)
    device = pick_device(command.device)
    changes = {n: v for n in OVERRIDES if (v := getattr(command, n)) is not None}
    changed_parameters(SimulationParameters(), changes)  # Tells a wrong value before a run is made.
    if command.sequence is not None:
        sequence = find_sequence(command.sequence, command.data_dir)
    else:
        sequence = open_catalog(command.data_dir).sequences_of(source)[0]
    config = {"source": str(source.folder.resolve()), "parameters": changes}
    paths = [str(sequence.folder)]
    run = _run_at(command.out, "simulation", paths, config)
    result = _execute(run, device, progress)
    chosen = Run.open(run.folder).yaml("object/parameters.yaml")
    return {"substeps_per_frame": chosen["substeps_per_frame"], **result}


def _run_at(folder: Path, kind: RunKind, sequences: list[str], config: dict[str, Any]) -> Run:
    if not (folder / "run.yaml").is_file():
        name = folder.resolve().name
        return Run.create(folder, name=name, kind=kind, sequences=sequences, config=config)
    run = Run.open(folder)
    if run.kind != kind or run.config != config or list(run.sequences) != sequences:
        raise UsageError(
            f"{folder} already holds another run. Choose a new --out, or delete that folder first."
        )
    if run.is_published:
        raise UsageError(f"{folder} already holds this run, finished. Choose a new --out.")
    return run


def _execute(run: Run, device: str, progress: Progress) -> dict[str, Any]:
    from physhandi import pipeline

    pipeline.run_job(run, progress, device=device)
    return summary(Run.open(run.folder))


def summary(run: Run) -> dict[str, Any]:
    """What a finished run found: losses of each stage, and metrics."""
    result: dict[str, Any] = {"run": str(run.folder)}
    if run.has("losses.json"):
        losses = run.json("losses.json")
        result["losses"] = {
            stage: {key: value[key] for key in ("before", "after")}
            for stage, value in losses.items()
            if "before" in value
        }
    if run.has("metrics.json"):
        result["metrics"] = run.json("metrics.json")
    return result


def evaluate_run(command: Any) -> dict[str, Any]:
    """Measure a run again from its stored motion."""
    from physhandi import pipeline

    run = find_result(command.run, command.data_dir)
    catalog = open_catalog(command.data_dir)
    return pipeline.evaluate(run, catalog.sequences_of(run))


def evaluate_hands(command: Any) -> dict[str, Any]:
    """Measure only the hands of a run.

    Raises:
        RunError: If the run has no hands.
    """
    hands = {
        name: scores["hands"]
        for name, scores in evaluate_run(command).items()
        if scores.get("hands")
    }
    if not hands:
        raise RunError(f"Run '{command.run}' has no hands to measure.")
    return hands


def make_sequence(command: Any, progress: Progress) -> dict[str, Any]:
    """Simulate and film a sequence with another physics engine; returns where it is.

    Raises:
        UsageError: If what is asked for makes no sense, or MuJoCo is not installed.
    """
    from physhandi.synthetic.synthesize import synthesize

    named = ("action", "out", "seed", "preset", "cameras", "frames", "hold", "images")
    sequence = synthesize(
        command.object,
        **{name: getattr(command, name) for name in (*named, "resolution", "overwrite")},
        changes=dict(_level(text) for text in command.change),
        progress=progress,
    )
    return {"sequence": str(sequence.folder), "description": sequence.description}


def _level(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        return name.strip(), float(value if equals else "")
    except ValueError:
        raise UsageError(
            f"--change {text!r} does not set a level; write it like depth_noise=0.1."
        ) from None


def import_foreign(source: Any, progress: Progress) -> dict[str, Any]:
    """Convert what other programs wrote; returns what was written, and what was noticed."""
    match source:
        case ImportStereo():
            from physhandi.data.importers.stereo import import_stereo

            options = {f.name: getattr(source, f.name) for f in fields(source)}
            folder, out = options.pop("source"), options.pop("out")
            return {"sequence": str(import_stereo(folder, out, progress, **options).folder)}
        case ImportMocap():
            from physhandi.data.importers.mocap import import_mocap

            options = {f.name: getattr(source, f.name) for f in fields(source)}
            recordings, out = options.pop("source"), options.pop("out")
            sequences = import_mocap(recordings, out, progress, **options)
            return {"sequences": [str(sequence.folder) for sequence in sequences]}
        case ImportMano():
            from physhandi.data.importers.mano import import_mano
            from physhandi.hand.mano import hands_folder

            out = source.out or hands_folder()
            return {"hands": [str(import_mano(path, out)) for path in source.sources]}
        case _:
            return _import_phystwin(source, progress)


def _import_phystwin(source: ImportPhystwin, progress: Progress) -> dict[str, Any]:
    from physhandi.data.importers.phystwin import import_phystwin
    from physhandi.fitting.phystwin_run import import_phystwin_run

    wants_run = source.optimal_params is not None
    if not wants_run and (source.checkpoint or source.inference or source.run):
        raise UsageError(
            "--checkpoint, --inference and --run need --optimal-params: a checkpoint holds no "
            "topology, which is built again from optimal_params.pkl."
        )
    folder = import_phystwin(source.source, source.out, progress)
    if source.optimal_params is None:
        return {"sequence": str(folder)}
    try:
        run = import_phystwin_run(
            Sequence.load(folder),
            source.optimal_params,
            source.checkpoint,
            source.run or folder.with_name(f"{folder.name}_phystwin"),
            device=pick_device(source.device),
            inference=source.inference,
            truncates_damping=False if source.keep_decimals else None,
            progress=progress,
        )
    except BaseException:
        shutil.rmtree(folder)  # All or nothing, so that the same command can be given again.
        raise
    return {"sequence": str(folder), "run": str(run.folder), **run.json("import.json")}


def export(command: Any) -> Path:
    """Write a run as files of another format; returns what was written."""
    from app.exports.shell import ExportOptions
    from app.exports.shell import export as export_file

    run = find_result(command.run, command.data_dir)
    own = ("format", "out", "link", "sequence", "frame", "width", "height", "overwrite")
    device = pick_device(command.device) if command.link else "cpu"
    options = ExportOptions(**{name: getattr(command, name) for name in own}, device=device)
    return export_file(run, options, open_catalog(command.data_dir))


def serve(command: Any, on_ready: Callable[[str], None]) -> None:
    """Serve until interrupted."""
    from app.server import serve as serve_application

    settings = read_settings(
        host=command.host, port=command.port, data_dir=command.data_dir, device=command.device
    )
    named = settings.device if "device" in settings.model_fields_set else "auto"
    settings = settings.model_copy(update={"device": pick_device(named)})
    serve_application(settings, on_ready=on_ready, queue_demo=command.demo)


def as_json_data(result: Any) -> Any:
    """Turn results into what JSON knows; NaN and infinity become null."""
    return without_non_finite(plain(result))


def lines(result: Any, indent: int = 0) -> Iterator[str]:
    """Lay nested results out for reading."""
    for key, value in result.items():
        if isinstance(value, dict):
            yield f"{'  ' * indent}{key}:"
            yield from lines(value, indent + 1)
        elif isinstance(value, list):
            yield f"{'  ' * indent}{key}:"
            items = cast("list[object]", value)
            yield from (f"{'  ' * (indent + 1)}{item}" for item in items)
        else:
            shown = f"{value:.6g}" if isinstance(value, float) else value
            yield f"{'  ' * indent}{key}: {shown}"
