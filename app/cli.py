"""The `physhandi` command: parses, calls, prints; the only module that prints."""

import json
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from tyro.conf import Positional, arg, subcommand

from app import commands
from physhandi.errors import PhysHandiError, UsageError
from physhandi.progress import Progress

Result = TypeVar("Result")
DataDir = Annotated[
    Path | None,
    arg(help="Folder with `sequences/` and `runs/` (PHYSHANDI_DATA_DIR, else `data`)."),
]


@dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve the application and print the address to open."""

    host: str | None = None
    """Address to listen on; others reach anything but loopback (PHYSHANDI_HOST, else 127.0.0.1)."""
    port: int | None = None
    """Port to listen on; 0 takes a free one (PHYSHANDI_PORT, else 8080)."""
    data_dir: DataDir = None
    device: str | None = None
    """Warp device: auto, cpu or cuda:0 (PHYSHANDI_DEVICE, else auto)."""
    demo: bool = False
    """Also queue a quick fit of the bundled sequence."""


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Fit hands and object of one or several sequences of the same object."""

    sequences: Positional[tuple[str, ...]]
    """Folders or names of sequences."""
    out: Path
    """Run folder to fill; an interrupted run goes on after its last finished stage."""
    profile: str = "default"
    """Settings: quick, default, paper or phystwin."""
    device: str = "auto"
    """Warp device: auto, cpu or cuda:0."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Simulate a fitted object again, with other parameters or in another sequence."""

    run: Positional[str]
    """Folder or id of a finished run."""
    out: Path
    """Run folder to fill."""
    sequence: str | None = None
    """Another sequence of the same object; none takes the run's first one."""
    connection_radius: float | None = None
    """δ of object springs [m]."""
    max_neighbors: int | None = None
    """d_max of object springs."""
    virtual_connection_radius: float | None = None
    """δ of virtual springs [m]."""
    virtual_max_neighbors: int | None = None
    """d_max of virtual springs."""
    stiffness_scale: float | None = None
    """Multiplies every stiffness."""
    damping: float | None = None
    """Dashpot of new springs; fitted ones keep their ratio to the global value [N·s/m]."""
    drag: float | None = None
    """Decay rate of velocity [1/s]."""
    restitution: float | None = None
    """Ground restitution."""
    friction: float | None = None
    """Ground friction."""
    substeps_per_frame: int | None = None
    """Integration steps in one frame."""
    device: str = "auto"
    """Warp device: auto, cpu or cuda:0."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class EvaluateRun:
    """Measure a run against its sequences."""

    run: Positional[str]
    """Folder or id of a finished run."""
    json: bool = False
    """Print JSON instead of a table."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class EvaluateHands:
    """Measure only the hands of a run: reprojection error of every view [px]."""

    run: Positional[str]
    """Folder or id of a finished run."""
    json: bool = False
    """Print JSON instead of a table."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure results."""

    what: (
        Annotated[EvaluateRun, subcommand("run", prefix_name=False)]
        | Annotated[EvaluateHands, subcommand("hands", prefix_name=False)]
    )
    """What to measure."""


@dataclass(frozen=True, kw_only=True)
class ImportStereo:
    """Two calibrated videos of a hand (cam0_test.mp4, c0.dat, rot_trans_c0.dat, …)."""

    source: Positional[Path]
    """Folder of the recording."""
    out: Path
    """Sequence folder to write."""


@dataclass(frozen=True, kw_only=True)
class ImportMocap:
    """Motion capture of a rope held by two grippers (one .npy per trajectory)."""

    source: Positional[Path]
    """A trajectory, or a folder of them."""
    out: Path
    """Folder to write one sequence per trajectory into."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Turn a recording of another format into sequences."""

    source: (
        Annotated[ImportStereo, subcommand("stereo", prefix_name=False)]
        | Annotated[ImportMocap, subcommand("mocap", prefix_name=False)]
    )
    """What to import."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a run as files that other programs read."""

    run: Positional[str]
    """Folder or id of a finished run."""
    format: Literal["ply", "npz", "csv", "yaml"]
    """ply: meshes and points per frame; npz and csv: trajectories; yaml: parameters and metrics."""
    out: Path
    """File or folder to write."""
    sequence: str | None = None
    """Which sequence of the run; none takes the first one."""
    frame: int | None = None
    """Only this frame (ply)."""
    overwrite: bool = False
    """Replace what is there."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class BenchmarkRollout:
    """Time forward simulation against a plain baseline in the same run."""

    device: str = "auto"
    """Warp device: auto, cpu or cuda:0."""
    nodes: int = 400
    """Object nodes of the made-up object."""
    frames: int = 3
    """Frames to time."""
    model: Path | None = None
    """A PhysTwin-format .npz topology to time instead."""
    json: bool = False
    """Print JSON instead of lines."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkGradient(BenchmarkRollout):
    """Time forward simulation and its gradient against a plain baseline in the same run."""


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Measure speed."""

    what: (
        Annotated[BenchmarkRollout, subcommand("rollout", prefix_name=False)]
        | Annotated[BenchmarkGradient, subcommand("gradient", prefix_name=False)]
    )
    """What to measure."""


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check that this machine can run the demo; exit code 0 when it can."""

    data_dir: DataDir = None


Command = (
    Annotated[Serve, subcommand("serve")]
    | Annotated[Reconstruct, subcommand("reconstruct")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Import, subcommand("import")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Benchmark, subcommand("benchmark")]
    | Annotated[Doctor, subcommand("doctor")]
)


@dataclass
class PrintedProgress(Progress):
    """Shows the running stage on one line of standard error."""

    stage: str = field(default="", init=False)

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        """Redraw the line; a new stage begins a new one."""
        if self.stage not in {"", stage}:
            print(file=sys.stderr)
        self.stage = stage
        done = round(24 * iteration / max(1, total))
        shown = "" if loss is None else f"  loss {loss:.6g}"
        bar = "█" * done + "░" * (24 - done)
        line = f"\r{stage:<20} {bar} {iteration}/{total}{shown}  {message}"
        print(f"{line:<100}", end="", file=sys.stderr, flush=True)

    def finish(self) -> None:
        """End the line, if there is one, so that what follows stands on its own."""
        if self.stage:
            print(file=sys.stderr)
            self.stage = ""


def _watched(work: Callable[[Progress], Result]) -> Result:
    progress = PrintedProgress()
    try:
        return work(progress)
    finally:
        progress.finish()


def _show(result: Any, *, as_json: bool = False) -> None:
    if as_json:
        print(json.dumps(commands.as_json_data(result), indent=2, ensure_ascii=False))
        return
    for line in commands.lines(result):
        print(line)


def _dispatch(command: Any) -> int:
    match command:
        case Serve():
            commands.serve(command, on_ready=lambda url: print(url, flush=True))
        case Reconstruct():
            _show(_watched(lambda progress: commands.reconstruct(command, progress)))
        case Simulate():
            _show(_watched(lambda progress: commands.simulate(command, progress)))
        case Evaluate(what=EvaluateHands() as what):
            _show(commands.evaluate_hands(what), as_json=what.json)
        case Evaluate(what=what):
            _show(commands.evaluate_run(what), as_json=what.json)
        case Import(source=source):
            for folder in _watched(lambda progress: commands.import_recording(source, progress)):
                print(folder)
        case Export():
            print(commands.export(command))
        case Benchmark(what=what):
            with_gradient = isinstance(what, BenchmarkGradient)
            result = commands.benchmark_rollout(what, with_gradient=with_gradient)
            _show(result, as_json=what.json)
        case _:
            healthy, lines = commands.doctor(command.data_dir)
            print("\n".join(lines))
            return 0 if healthy else 1
    return 0


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed with one clear line, 2 bad usage."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    command = tyro.cli(Command, prog="physhandi", args=argv, config=(tyro.conf.OmitArgPrefixes,))  # type: ignore[call-overload]  # tyro types a union of subcommands loosely
    try:
        code = _dispatch(command)
    except UsageError as error:
        print(f"physhandi: {error}", file=sys.stderr)
        code = 2
    except (PhysHandiError, OSError) as error:
        print(f"physhandi: {error}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("physhandi: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)
