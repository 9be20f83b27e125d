"""What can be said on the command line: one dataclass a command, the source of its help text."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from app.benchmarks.parts import Part


@dataclass(frozen=True, kw_only=True)
class Synthesize:
    """Make a sequence: hands handle a soft body in MuJoCo, and made-up cameras film it."""

    object: str
    """What is handled: cloth, towel, rope, plush or pouch."""
    action: str
    """What is done with it: lift, fold, stretch, squeeze, wipe or push."""
    out: Path
    """Sequence folder to write."""
    seed: int = 0
    """Decides size and material, motion, cameras and errors; from 1000 on for verification only."""
    preset: str = "default"
    """How imperfect sensors and detectors are: clean, default, hard or paper."""
    change: tuple[str, ...] = ()
    """Levels that differ from the preset's, like depth_noise=0.1 (docs/synthhdi.md lists them)."""
    cameras: int = 3
    """Number of cameras, 1 to 4."""
    frames: int = 90
    """Number of frames, 30 a second."""
    hold: Literal["friction", "attachment"] = "friction"
    """Hands hold by friction alone, or what they have touched for 0.1 s sticks to them."""
    images: Literal["all", "none"] = "all"
    """none writes lifted tracks instead of color, depth and masks: small, and made in seconds."""
    resolution: Literal["fine", "tiny"] = "fine"
    """How many nodes the simulated body has."""
    overwrite: bool = False
    """Replace a sequence that is there."""


@dataclass(frozen=True, kw_only=True)
class ImportStereo:
    """Two calibrated videos of a hand (cam0_test.mp4, c0.dat, rot_trans_c0.dat, …)."""

    source: Positional[Path]
    """Folder of the recording."""
    out: Path
    """Sequence folder to write."""
    hands: tuple[Literal["right", "left"], ...] = ("right",)
    """Hands that the recording shows: right, left or both."""
    origin: str = ""
    """Who recorded it and where it was published; kept with the sequence."""
    licence: str = ""
    """Licence of the recording; kept with the sequence."""
    overwrite: bool = False
    """Replace a sequence that is there."""


@dataclass(frozen=True, kw_only=True)
class ImportMocap:
    """Motion capture of a rope held by two grippers (one .npy per trajectory)."""

    source: Positional[Path]
    """A trajectory (frame, marker, 3), markers in order along the rope; or a folder of them."""
    out: Path
    """Folder to write one sequence per trajectory into."""
    controlled_markers: tuple[int, ...] = (0, 1, 11, 12)
    """Markers that sit on the grippers, counted from 0."""
    recording_rate: float = 100.0
    """Frames per second of the recording."""
    frame_rate: float = 30.0
    """Frames per second of the sequences."""
    nodes_per_segment: int = 4
    """Object nodes from one marker to the next."""
    node_spacing: float | None = None
    """Distance between nodes [m], in the place of --nodes-per-segment."""
    rest_shape: Literal["straight", "first_frame"] = "straight"
    """Shape without tension: straight with median segment lengths, or as in the first frame."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Axis of the recording that points up."""
    unit: Literal["m", "cm", "mm", "in"] = "m"
    """Length unit of the recording."""
    overwrite: bool = False
    """Replace sequences that are there."""


@dataclass(frozen=True, kw_only=True)
class ImportPhystwin:
    """A case of the PhysTwin data set, and what PhysTwin made of it."""

    source: Positional[Path]
    """Case folder (calibrate.pkl, metadata.json, final_data.pkl, color/, depth/, mask/, …)."""
    out: Path
    """Sequence folder to write."""
    optimal_params: Path | None = None
    """optimal_params.pkl of PhysTwin's search; makes a run of it."""
    checkpoint: Path | None = None
    """best_*.pth of PhysTwin's training, with per-spring stiffness; needs --optimal-params."""
    inference: Path | None = None
    """inference.pkl, PhysTwin's own rollout; the report says how far ours is from it."""
    keep_decimals: bool = False
    """Keep the decimals of dashpot and drag, which PhysTwin drops after its search."""
    run: Path | None = None
    """Run folder to write; none takes the sequence folder's name with _phystwin after it."""
    device: str = "auto"
    """Warp device that rolls the imported run out: auto, cpu or cuda:0."""


@dataclass(frozen=True, kw_only=True)
class ImportMano:
    """MANO hand models that you have downloaded under their own licence."""

    sources: Positional[tuple[Path, ...]]
    """MANO_LEFT.pkl, MANO_RIGHT.pkl or both."""
    out: Path | None = None
    """Folder of hand models (PHYSHANDI_HANDS, else ~/.local/share/physhandi/hands)."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Turn a recording, a result or a hand model of another format into ours."""

    source: (
        Annotated[ImportStereo, subcommand("stereo", prefix_name=False)]
        | Annotated[ImportMocap, subcommand("mocap", prefix_name=False)]
        | Annotated[ImportPhystwin, subcommand("phystwin", prefix_name=False)]
        | Annotated[ImportMano, subcommand("mano", prefix_name=False)]
    )
    """What to import."""


DataDir = Annotated[
    Path | None,
    arg(help="Folder with `sequences/` and `runs/` (PHYSHANDI_DATA_DIR, else `data`)."),
]
_OF_SUITE = arg(help_behavior_hint="(default: the suite's)")


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
    self_collision: bool | None = None
    """Whether object nodes collide with each other."""
    collision_distance: float | None = None
    """Object nodes nearer than this may collide; 1.25 to 2 node distances [m]."""
    self_restitution: float | None = None
    """Restitution between object nodes."""
    self_friction: float | None = None
    """Friction between object nodes."""
    substeps_per_frame: int | Literal["auto"] | None = None
    """Integration steps in one frame; auto takes as few as are stable, and prints how many."""
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
class EvaluateSuite:
    """Compare methods on a suite of sequences, and write its tables (docs/evaluation.md)."""

    suite: Annotated[
        Literal["tiny", "dev", "full"] | None, arg(help_behavior_hint="(default: tiny)")
    ] = None
    """Which suite; sequences that are not there yet are made. With `--sequences`, whose effort
    methods may take: without it their profiles' own."""
    methods: Annotated[tuple[str, ...], _OF_SUITE] = ()
    """Methods: static, rigid_follow, phystwin, paper, ours, quick, oracle_hand, oracle_parameters,
    each also as NAME+last_residual or NAME@SETTING=VALUE."""
    seeds: Annotated[tuple[int, ...], _OF_SUITE] = ()
    """Seeds of every scene. From 1000 on they are reserved for verification."""
    protocols: Annotated[
        tuple[Literal["main", "single_view", "unseen", "robustness", "sensitivity"], ...],
        _OF_SUITE,
    ] = ()
    """main is reconstruction and future prediction."""
    sequences: Annotated[
        tuple[str, ...], arg(help_behavior_hint="(default: the suite's scenes)")
    ] = ()
    """Folders or names of sequences to evaluate in place of the suite's scenes."""
    out: Path | None = None
    """Folder to fill, and to go on with; none takes one of its own in `suites/` of the data folder,
    whose suites the server shows."""
    jobs: int = 1
    """How many sequences and cells are computed side by side, each in a process of its own. Then
    the times in the table are those of a shared machine."""
    device: str = "auto"
    """Warp device: auto, cpu or cuda:0."""
    json: bool = False
    """Print JSON instead of lines."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure results."""

    what: (
        Annotated[EvaluateRun, subcommand("run", prefix_name=False)]
        | Annotated[EvaluateHands, subcommand("hands", prefix_name=False)]
        | Annotated[EvaluateSuite, subcommand("suite", prefix_name=False)]
    )
    """What to measure."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a run as files that other programs read."""

    run: Positional[str]
    """Folder or id of a finished run."""
    format: Literal["ply", "gltf", "npz", "csv", "yaml", "png", "zip", "viser", "html"]
    """ply: meshes and points per frame; gltf: one .glb that moves, hands skinned; npz and csv:
    trajectories; yaml: parameters and metrics; png: a picture; zip: a picture with all its data;
    viser: a recording for viser's player; html: one file that plays in any browser."""
    out: Path
    """File or folder to write."""
    sequence: str | None = None
    """Which sequence of the run; none takes the first one."""
    frame: int | None = None
    """Only this frame (ply), or which one (png, zip)."""
    link: str = ""
    """Link of the viewer, or its part after "?": camera, layers, colors; parameters of the
    simulation that it changes have the object simulated anew."""
    width: int = 1280
    """Width of a picture in pixels, 16 to 4096."""
    height: int = 720
    """Height of a picture in pixels, 16 to 4096."""
    overwrite: bool = False
    """Replace what is there."""
    device: str = "auto"
    """Warp device for simulating anew: auto, cpu, cuda or cuda:0."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class BenchmarkRollout:
    """Time simulated frames, beside a simulator built as PhysTwin's is."""

    device: str = "auto"
    """Warp device: auto, cpu, cuda or cuda:0."""
    nodes: int = 1000
    """Object nodes of a made-up block."""
    topology: Path | None = None
    """An .npz with position, spring_nodes, rest_length and stiffness to measure instead."""
    frames: int = 10
    """Frames of a rollout."""
    json: bool = False
    """Print JSON instead of lines."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkGradient(BenchmarkRollout):
    """Time simulated frames and their gradient, beside PhysTwin's way."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkBatch(BenchmarkRollout):
    """Time many candidates at once, beside one by one."""

    candidates: int = 64
    """Candidates of the batch."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkScaling:
    """Time blocks of many sizes, and fit how the time grows."""

    device: str = "auto"
    """Warp device: auto, cpu, cuda or cuda:0."""
    nodes: tuple[int, ...] = (500, 1000, 3000, 10_000, 50_000)
    """Object nodes of the blocks."""
    springs_at_node: tuple[int, ...] = (9, 18, 57)
    """Springs that end at a node on average."""
    frames: int = 3
    """Frames of a rollout."""
    time_limit_s: float = 300.0
    """Blocks that would take longer than this in all are left out [s]."""
    json: bool = False
    """Print JSON instead of lines."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkSubsteps:
    """Compare a run's motion with automatic substeps with that of the reference's 667."""

    run: Positional[str] = "towel_fold_quick"
    """Folder or id of a finished run."""
    sequence: str | None = None
    """One of its sequences; none takes the first one."""
    substeps: tuple[int, ...] = ()
    """More numbers of substeps to compare."""
    device: str = "auto"
    """Warp device: auto, cpu, cuda or cuda:0."""
    json: bool = False
    """Print JSON instead of lines."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class BenchmarkLive:
    """Time from a slider to the first new frame, in the viewer's simulation process."""

    run: Positional[str] = "towel_fold_quick"
    """Folder or id of a finished run."""
    sequence: str | None = None
    """One of its sequences; none takes the first one."""
    device: str = "auto"
    """Warp device: auto, cpu, cuda or cuda:0."""
    json: bool = False
    """Print JSON instead of lines."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class BenchmarkViewer:
    """Measure the real server, its pages and live scenes, with clients and a real browser.

    It starts a server of its own on a free loopback port, with a data folder of its own. The JSON
    says for each figure its `value`, its `goal` and whether it is `reached` (`figures`), beside
    `load_average` before and after, and what each part found:
    paint: first paint of the home page in new browser profiles (p50_ms, p95_ms, worst_ms);
    scrub: timeline slider to the message with that frame's nodes;
    slider: slider message to the first node positions of the new rollout, at a websocket client;
    browser: mouse press on a slider to the first new frame drawn (arrived_…: received);
    start: the first slider move after the server's start (first_move_ms), also with nothing
    compiled (nothing_compiled), and whether the panel said that it was starting (is_start_shown);
    bytes: size of a playing frame of 2 hands, 3,000 nodes and 300 arrows (frame_bytes);
    sessions: ten such scenes at once (worst_frames_per_s, worst_skipped_per_s, server_cpu_share);
    runs: home page and list of 1,000 runs;
    live: frames simulated in a second with automatic substeps (frames_per_s).
    """

    run: Positional[str] = "towel_fold_quick"
    """Folder or id of a finished run with an object."""
    parts: tuple[Part, ...] = ()
    """What to measure; none measures everything."""
    quick: bool = False
    """Repeat everything less often."""
    json: bool = False
    """Print JSON instead of lines."""
    data_dir: DataDir = None


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Measure speed."""

    what: (
        Annotated[BenchmarkRollout, subcommand("rollout", prefix_name=False)]
        | Annotated[BenchmarkGradient, subcommand("gradient", prefix_name=False)]
        | Annotated[BenchmarkBatch, subcommand("batch", prefix_name=False)]
        | Annotated[BenchmarkScaling, subcommand("scaling", prefix_name=False)]
        | Annotated[BenchmarkSubsteps, subcommand("substeps", prefix_name=False)]
        | Annotated[BenchmarkLive, subcommand("live", prefix_name=False)]
        | Annotated[BenchmarkViewer, subcommand("viewer", prefix_name=False)]
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
    | Annotated[Synthesize, subcommand("synthesize")]
    | Annotated[Import, subcommand("import")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Benchmark, subcommand("benchmark")]
    | Annotated[Doctor, subcommand("doctor")]
)
