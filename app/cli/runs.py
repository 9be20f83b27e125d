"""Commands that fill, measure and export runs."""

import sys
from collections.abc import Mapping
from dataclasses import make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from app.cli.lookup import (
    cluster_settings,
    find_result,
    find_sequence,
    open_catalog,
    read_settings,
)
from app.cli.output import (
    AsJson,
    DataDir,
    Device,
    Devices,
    EngineChoice,
    Several,
    Store,
    all_values,
    show,
)
from app.jobs.engines.following import FollowedRun, follow_to_end
from app.jobs.engines.ray_engine import reached_cluster
from app.jobs.order import default_name, fit_settings
from app.jobs.processes import WORKER
from app.settings import LOCAL
from physhandi.api import prepare_run
from physhandi.child import loading_modules
from physhandi.data.layout import LOSSES_FILE, METRICS_FILE, PARAMETERS_FILE, SPLATS_FILE
from physhandi.data.run import RunKind
from physhandi.data.run_folder import new_run_id
from physhandi.data.sequence import Sequence
from physhandi.devices import pick_device, pick_devices
from physhandi.errors import RunError, UsageError
from physhandi.fitting.checks.readiness import skipped_object
from physhandi.fitting.config import (
    load_profile,
    parse_override,
)
from physhandi.fitting.stored_edits import describe_edits, read_edits, store_edits
from physhandi.progress import watched
from physhandi.run import Run
from physhandi.run_store import RunStore
from physhandi.simulation.parameters import PARAMETERS, SimulationParameters, changed_parameters

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
    "hand_pushes",
    "push_stiffness",
    "hand_friction",
    "substeps_per_frame",
)
"""Parameters that `physhandi simulate` can change."""


def _change_option(name: str) -> tuple[str, Any, None]:
    """Make an option of `physhandi simulate` from a row of the table of parameters."""
    parameter = PARAMETERS[name]
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    kind: Any = {"number": float, "whole": int, "switch": bool}[parameter.kind]
    more = ""
    if name == "substeps_per_frame":
        kind, more = int | Literal["auto"], "; auto takes as few as are stable, and says how many"
    about = arg(help=f"{parameter.about.rstrip('.')}{more}{unit}.")
    return name, Annotated[kind | None, about], None


if TYPE_CHECKING:

    class Changes:
        """New values of parameters."""

else:
    Changes = make_dataclass("Changes", [_change_option(name) for name in OVERRIDES], frozen=True)


def reconstruct(
    sequences: Positional[tuple[str, ...]],
    *,
    out: Path | None = None,
    profile: str = "default",
    settings: UseAppendAction[
        Annotated[tuple[str, ...], arg(name="set", metavar="PATH=VALUE")]
    ] = (),
    device: Devices = "auto",
    engine: EngineChoice = None,
    store: Store = None,
    data_dir: DataDir = None,
) -> None:
    """Fit hands and object of one or several sequences of the same object.

    On a cluster, ctrl C ends the job, and the command returns when that is sure. If it is killed,
    the job goes on, and the same command with --out follows it again.

    Args:
        sequences: Folders or names of sequences.
        out: Run folder to fill; an interrupted run goes on where it was. None
            makes one in `runs/` of the data folder, and prints it.
        profile: Settings: quick, default, paper, phystwin, or a YAML file with what differs from
            one of them.
        settings: A setting that differs from the profile's, like object_.search.generations=12;
            may be given several times.
    """
    if not sequences:
        raise UsageError("Name at least one sequence to reconstruct.")
    recordings = [find_sequence(name, data_dir) for name in sequences]
    for recording in recordings:
        recording.validate(reads_color=False)  # Tells wrong data before a run is made.
    warning = skipped_object(recordings)
    if warning is not None:
        print(f"physhandi: warning: {warning}", file=sys.stderr)
    base = load_profile(profile)
    stored = fit_settings(base, dict(parse_override(text) for text in settings))
    server = read_settings(data_dir=data_dir, engine=engine, store=store)
    run_store = RunStore(server.store) if server.store else None
    if server.engine == LOCAL:
        cluster, devices = None, pick_devices(device)
    else:
        cluster, devices = reached_cluster(cluster_settings(server, device), WORKER), ()
    if out is None:
        name = default_name(recordings[0].name, stored)
        run = _run_at(_new_folder(data_dir), "reconstruction", recordings, stored, name)
    else:
        run = _run_at(out, "reconstruction", recordings, stored)
    if cluster is None:
        show(_execute(run, *devices, store=run_store))
        return
    print(f"physhandi: {run.folder} is fitted on {cluster.name}", file=sys.stderr)
    with watched(True) as progress, FollowedRun(run.folder, cluster) as followed:
        follow_to_end(followed, cluster, progress, server.cancel_grace_s)
    run.verify()
    show(_result(run.folder))


def simulate(
    run: Positional[str],
    changes: OmitArgPrefixes[Changes] = Changes(),  # noqa: B008  # frozen
    *,
    out: Path | None = None,
    sequence: Several[str] = (),
    edits: Path | None = None,
    device: Device = "auto",
    data_dir: DataDir = None,
) -> None:
    """Simulate a fitted object again, with other parameters or in other sequences.

    Args:
        run: Folder or id of a finished run.
        changes: Parameters that differ from the fitted ones.
        out: Run folder to fill. None makes one in `runs/` of the data folder, and prints it.
        sequence: Other sequences of the same object; none takes the run's first one. Substeps are
            chosen anew where the fitted ones would not be stable.
        edits: JSON file with what is done to single springs and nodes (docs/formats.md), in the
            place of the run's own edits; none for these.
    """
    source = find_result(run, data_dir)
    device = pick_device(device)
    changed = {name: value for name, value in vars(changes).items() if value is not None}
    changed_parameters(SimulationParameters(), changed)  # Tells a wrong value before a run is made.
    recordings = [find_sequence(name, data_dir) for name in all_values(sequence)]
    if not recordings:
        recordings = open_catalog(data_dir).sequences_of(source)[:1]
    config: dict[str, Any] = {"source": str(source.folder.resolve()), "parameters": changed}
    wanted = None if edits is None else read_edits(edits)
    if wanted is not None:
        config["edits"] = describe_edits(wanted)
    if out is None:
        name = f"{source.name}, simulated"
        target = _run_at(_new_folder(data_dir), "simulation", recordings, config, name)
    else:
        target = _run_at(out, "simulation", recordings, config)
    if wanted is not None:
        store_edits(target.folder, wanted)
    result = _execute(target, device)
    chosen = Run.open(target.folder).yaml(PARAMETERS_FILE)
    show({"substeps_per_frame": chosen["substeps_per_frame"], **result})


def import_run(
    address: Positional[str], *, out: Path | None = None, data_dir: DataDir = None
) -> None:
    """A published run from a store, whose files are all as their hashes say.

    Args:
        address: Address of the store, with the run's id as its last part: s3://BUCKET/FOLDER/RUN.
        out: Folder to make. None makes one of that id in `runs/` of the data folder.
    """
    url, _, run_id = address.rstrip("/").rpartition("/")
    store = RunStore(url)
    folder = out or read_settings(data_dir=data_dir).run_dir / run_id
    show({"run": str(store.fetch(run_id, folder.absolute()).folder)})


def evaluate_run(
    run: Positional[str],
    *,
    as_json: AsJson = False,
    device: Device = "auto",
    data_dir: DataDir = None,
) -> None:
    """Measure a run against its sequences; a run with splats is drawn in every view.

    Args:
        run: Folder or id of a finished run.
    """
    show(_measured(run, data_dir, draws=True, device=device), as_json=as_json)


def evaluate_hands(
    run: Positional[str], *, as_json: AsJson = False, data_dir: DataDir = None
) -> None:
    """Measure only the hands of a run: reprojection error of every view [px].

    Args:
        run: Folder or id of a finished run.
    """
    measured = _measured(run, data_dir, draws=False)
    hands = {name: scores["hands"] for name, scores in measured.items() if scores.get("hands")}
    if not hands:
        raise RunError(f"Run '{run}' has no hands to measure.")
    show(hands, as_json=as_json)


def export(
    run: Positional[str],
    *,
    format: Literal[  # noqa: A002  # the option's name
        "ply",
        "gltf",
        "npz",
        "csv",
        "yaml",
        "png",
        "mp4",
        "gif",
        "zip",
        "viser",
        "html",
        "usd",
        "mjcf",
        "newton",
        "rrd",
        "splat-ply",
    ],
    out: Path,
    sequence: str | None = None,
    frame: int | None = None,
    link: str = "",
    width: int = 1280,
    height: int = 720,
    turn: float = 0.0,
    camera_path: Path | None = None,
    view: str = "",
    beside: Literal["none", "recording", "difference"] | None = None,
    overwrite: bool = False,
    device: Device = "auto",
    data_dir: DataDir = None,
) -> None:
    """Write a run as files that other programs read.

    Args:
        run: Folder or id of a finished run.
        format: ply: meshes and points per frame; gltf and usd: one file that moves, hands skinned;
            npz and csv: trajectories; yaml: parameters and metrics; png: a picture; mp4 and gif: a
            film of all frames; zip: a picture with all its data; viser: a recording for viser's
            player; html: one file that plays in any browser; mjcf and newton: the object as a
            MuJoCo scene or a Newton model, with the hand's motion and a script that simulates it
            (ZIP); rrd: a recording for Rerun's viewer, with cameras and images; splat-ply: what the
            object looks like, for viewers of Gaussian splats.
        out: File or folder to write.
        sequence: Which sequence of the run; none takes the first one.
        frame: Only this frame (ply, splat-ply), or which one (png, zip).
        link: Link of the viewer, or its part after "?": camera, layers, colors; parameters of the
            simulation that it changes have the object simulated anew.
        width: Width of a picture or film in pixels, 16 to 4096.
        height: Height of a picture or film in pixels, 16 to 4096.
        turn: Angle in degrees by which the camera of a film goes round what it looks at.
        camera_path: JSON file with key frames that the camera of a film passes through
            (docs/formats.md).
        view: Camera of the recording from which a film is taken, in that camera's size: object,
            as splats where they were fitted, and hands. Without it, and with --beside, the camera
            that the link looks from, else the first one.
        beside: What is beside a film from a recorded camera: nothing, the recording, or that and
            how much both differ.
        overwrite: Replace what is there.
    """
    from app.exports.shell import ExportOptions
    from app.exports.shell import export as export_file

    finished = find_result(run, data_dir)
    options = ExportOptions(
        format=format,
        out=out,
        link=link,
        sequence=sequence,
        frame=frame,
        width=width,
        height=height,
        turn=turn,
        camera_path=camera_path,
        view=view,
        beside=beside,
        device=pick_device(device) if link else "cpu",
        overwrite=overwrite,
    )
    with watched(True) as progress:
        made = export_file(
            finished,
            options,
            open_catalog(data_dir),
            lambda done, of: progress.report(f"export as {format}", done, of),
        )
    print(made)


def gallery(
    runs: Positional[tuple[str, ...]],
    *,
    out: Path,
    title: str = "Results",
    link: str = "",
    overwrite: bool = False,
    data_dir: DataDir = None,
) -> None:
    """Write a folder of plain pages that shows runs without a server: an index, and replays.

    Args:
        runs: Folders or ids of finished runs, in the order in which they are shown.
        out: Folder to make.
        title: Heading of the index.
        link: Link of the viewer, or its part after "?": camera, layers, colors, theme of all pages.
        overwrite: Replace a gallery that is there.
    """
    from app.exports.gallery import write_gallery

    results = [find_result(name, data_dir) for name in runs]
    with watched(True) as progress:
        index = write_gallery(
            results,
            out,
            open_catalog(data_dir),
            title=title,
            link=link,
            overwrite=overwrite,
            report=lambda name, done, of: progress.report(f"page of {name}", done, of),
        )
    print(index)


def _measured(
    run: str, data_dir: Path | None, *, draws: bool, device: str = "cpu"
) -> dict[str, Any]:
    finished = find_result(run, data_dir)
    sequences = open_catalog(data_dir).sequences_of(finished)
    # What measures takes seconds to load, for which a wrong name need not wait.
    with loading_modules():
        from physhandi import pipeline

    with watched(True) as progress:
        return pipeline.evaluate(
            finished,
            sequences,
            progress,
            draws=draws,
            device=pick_device(device) if finished.has(SPLATS_FILE) else "cpu",
        )


def _new_folder(data_dir: Path | None) -> Path:
    return read_settings(data_dir=data_dir).run_dir / new_run_id()


def _run_at(
    folder: Path,
    kind: RunKind,
    recordings: list[Sequence],
    config: Mapping[str, Any],
    name: str = "",
) -> Run:
    """Make a run, or open the unfinished one of the same kind that its folder holds."""
    run = prepare_run(folder, kind, recordings, config, name=name)
    if run.is_published:
        raise UsageError(f"{folder} already holds this run, finished. Choose a new --out.")
    return run


def _execute(
    run: Run, device: str, *more_devices: str, store: RunStore | None = None
) -> dict[str, Any]:
    """Fill a run; see `_result`."""
    with loading_modules():
        from physhandi import pipeline

    with watched(True) as progress:
        pipeline.run_job(run, progress, device=device, more_devices=more_devices, store=store)
    return _result(run.folder)


def _result(folder: Path) -> dict[str, Any]:
    """Give a run's folder, the losses of its stages, its metrics and last its warnings."""
    finished = Run.open(folder)
    result: dict[str, Any] = {"run": str(finished.folder)}
    if finished.has(LOSSES_FILE):
        result["losses"] = {
            stage: {key: value[key] for key in ("before", "after")}
            for stage, value in finished.json(LOSSES_FILE).items()
            if "before" in value
        }
    if finished.has(METRICS_FILE):
        result["metrics"] = {
            name: {key: value for key, value in scores.items() if key != "warnings"}
            for name, scores in finished.metrics.items()
        }
        result["warnings"] = [
            f"{w['sequence']}: {w['message']} ({w['code']})" for w in finished.warnings
        ] or None
    return result
