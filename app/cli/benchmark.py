"""Commands that measure speed; see docs/benchmarks."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from app.benchmarks.parts import PARTS, CaptureSize, FitProfile, Part
from app.cli.lookup import find_result, sequence_of
from app.cli.output import AsJson, DataDir, Device, Devices, Several, all_values, show
from physhandi.data.layout import SequenceFiles
from physhandi.devices import pick_device, pick_devices
from physhandi.errors import RunError

NodeCount = Annotated[int, arg(name="nodes", help="Object nodes of a made-up block.")]
Topology = Annotated[
    Path | None,
    arg(
        help="An .npz with position, spring_nodes, rest_length and stiffness to measure instead.",
    ),
]
FrameCount = Annotated[int, arg(name="frames", help="Frames of a rollout.")]
RunName = Positional[Annotated[str, arg(help="Folder or id of a finished run with an object.")]]
OfRun = Annotated[str | None, arg(help="One of its sequences; none takes the first one.")]


def rollout(
    *,
    device: Device = "auto",
    node_count: NodeCount = 1000,
    topology: Topology = None,
    frame_count: FrameCount = 10,
    as_json: AsJson = False,
) -> None:
    """Time simulated frames, beside a simulator built as PhysTwin's is."""
    from physhandi.benchmarks.rollout import benchmark_rollout

    result = benchmark_rollout(
        device=pick_device(device),
        node_count=node_count,
        topology=topology,
        frame_count=frame_count,
    )
    show(result, as_json=as_json)


def gradient(
    *,
    device: Device = "auto",
    node_count: NodeCount = 1000,
    topology: Topology = None,
    frame_count: FrameCount = 10,
    as_json: AsJson = False,
) -> None:
    """Time simulated frames and their gradient, beside PhysTwin's way."""
    from physhandi.benchmarks.gradient import benchmark_gradient

    result = benchmark_gradient(
        device=pick_device(device),
        node_count=node_count,
        topology=topology,
        frame_count=frame_count,
    )
    show(result, as_json=as_json)


def batch(
    *,
    device: Devices = "auto",
    node_count: NodeCount = 1000,
    topology: Topology = None,
    frame_count: FrameCount = 10,
    candidates: int = 64,
    as_json: AsJson = False,
) -> None:
    """Time many candidates at once, beside one by one; on several GPUs also shared among them.

    Args:
        candidates: Candidates of the batch.
    """
    from physhandi.benchmarks.batch import benchmark_batch

    first, *others = pick_devices(device)
    result = benchmark_batch(
        device=first,
        more_devices=others,
        node_count=node_count,
        topology=topology,
        frame_count=frame_count,
        candidate_count=candidates,
    )
    show(result, as_json=as_json)


def scaling(
    *,
    device: Device = "auto",
    nodes: Annotated[
        Several[int], arg(help_behavior_hint="(default: 500 1000 3000 10000 50000)")
    ] = (),
    springs_at_node: Annotated[Several[int], arg(help_behavior_hint="(default: 9 18 57)")] = (),
    frame_count: Annotated[int, arg(name="frames", help="Frames of a rollout.")] = 3,
    time_limit_s: float = 300.0,
    as_json: AsJson = False,
) -> None:
    """Time blocks of many sizes, and fit how the time grows.

    Args:
        nodes: Object nodes of the blocks.
        springs_at_node: Springs that end at a node on average.
        time_limit_s: Blocks that would take longer than this in all are left out [s].
    """
    from physhandi.benchmarks.scaling import (
        NODE_COUNTS,
        SCALED_SPRINGS_AT_NODE,
        benchmark_scaling,
    )

    result = benchmark_scaling(
        device=pick_device(device),
        node_counts=all_values(nodes, NODE_COUNTS),
        springs_at_node=all_values(springs_at_node, SCALED_SPRINGS_AT_NODE),
        frame_count=frame_count,
        time_limit_s=time_limit_s,
    )
    show(result, as_json=as_json)


def splats(
    *,
    device: Device = "auto",
    iterations: int | None = None,
    as_json: AsJson = False,
) -> None:
    """Time pictures of splats and a fit of them, beside a loop over splats in NumPy.

    Args:
        iterations: Updates of a fit; none takes those of a default fit.
    """
    from physhandi.benchmarks.splats import benchmark_splats

    show(benchmark_splats(device=pick_device(device), iterations=iterations), as_json=as_json)


def capture(
    *,
    out: Path,
    scenes: Annotated[Several[str], arg(help_behavior_hint="(default: all of dev_rgbd)")] = (),
    image_size: CaptureSize = "half",
    seed: int = 0,
    frames: int = 60,
    fit: FitProfile = "quick",
    search_seeds: Annotated[Several[int], arg(help_behavior_hint="(default: 42 1)")] = (),
    jobs: int = 1,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Measure what one click makes of raw captures: masks, tracks, cameras, and fits from them.

    Made scenes are written as raw captures and imported again. The JSON says for each scene the
    overlap of masks with the recording's and with exact ones, errors of tracks against the true
    surface and how many live, errors of cameras, time and memory of the import, and what fits from
    it reach beside fits from exact masks and tracks (docs/benchmarks). A scene that fails is named
    and costs no other one.

    Args:
        out: Folder to fill; it must not be there yet, or be empty.
        scenes: Scenes of the suite dev_rgbd, like cloth/lift.
        image_size: Size of the pictures: half is 424x240, full is 848x480.
        seed: Seed of the scenes.
        frames: Frames of each.
        fit: Profile of the fits, or none.
        search_seeds: Seeds of the searches; each makes two fits.
        jobs: Scenes that are measured side by side, each in processes of its own.
    """
    from app.benchmarks.capture import CaptureOrder, benchmark_capture

    order = CaptureOrder(
        image_size=image_size,
        seed=seed,
        frames=frames,
        fit=fit,
        search_seeds=all_values(search_seeds, (42, 1)),
        device=pick_device(device),
    )
    result = benchmark_capture(all_values(scenes), out, order, jobs=jobs)
    show(result, as_json=as_json)
    if result["failed"]:
        raise RunError(f"{len(result['failed'])} scenes failed: {', '.join(result['failed'])}.")


def substeps(
    run: RunName = "towel_fold_quick",
    *,
    sequence: OfRun = None,
    substeps: Several[int] = (),
    device: Device = "auto",
    as_json: AsJson = False,
    data_dir: DataDir = None,
) -> None:
    """Compare a run's motion with automatic substeps with that of the reference's 667.

    Args:
        substeps: More numbers of substeps to compare.
    """
    from physhandi.benchmarks.substeps import benchmark_substeps
    from physhandi.fitting import artefacts

    device = pick_device(device)
    finished = find_result(run, data_dir)
    name = sequence_of(finished, sequence)
    result = benchmark_substeps(
        artefacts.load_model(finished.out, name),
        artefacts.load_parameters(finished.out),
        finished.array(SequenceFiles(name).control),
        name=f"{finished.id}: {name}",
        device=device,
        substeps=all_values(substeps),
    )
    show(result, as_json=as_json)


def live(
    run: RunName = "towel_fold_quick",
    *,
    sequence: OfRun = None,
    device: Device = "auto",
    as_json: AsJson = False,
    data_dir: DataDir = None,
) -> None:
    """Time from a slider to the first new frame, in the viewer's simulation process."""
    from app.benchmarks.latency import measure_latency

    device = pick_device(device)
    finished = find_result(run, data_dir)
    show(measure_latency(finished, sequence_of(finished, sequence), device=device), as_json=as_json)


def viewer(
    run: RunName = "towel_fold_quick",
    *,
    parts: Several[Part] = (),
    quick: bool = False,
    as_json: AsJson = False,
    data_dir: DataDir = None,
) -> None:
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
    live: frames simulated in a second with automatic substeps (frames_per_s), and while a hand is
    steered (steered);
    splats: pictures a second of the run's object as nodes, surface, and 1,000 to 20,000 made splats
    (pictures_per_s), bytes of a playing frame (frame_bytes), the server's work on it (server_ms).

    Args:
        parts: What to measure; none measures everything.
        quick: Repeat everything less often.
    """
    from app.benchmarks.viewer import measure_viewer

    finished = find_result(run, data_dir)
    name = finished.sequence_names[0]
    show(
        measure_viewer(finished, name, parts=all_values(parts) or PARTS, is_quick=quick),
        as_json=as_json,
    )
