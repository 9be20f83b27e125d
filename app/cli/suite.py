"""`physhandi evaluate suite`: finds or makes sequences, and has methods compared."""

import hashlib
import shlex
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from app.cli.lookup import cluster_settings, find_sequence, read_settings
from app.cli.output import AsJson, DataDir, Devices, EngineChoice, Several, all_values, show
from app.jobs.engines.ray_engine import reached_cluster
from app.settings import LOCAL
from physhandi.child import loading_modules
from physhandi.data.sequence import Sequence
from physhandi.devices import ONLY_CARD, pick_devices
from physhandi.errors import UsageError
from physhandi.progress import watched

MOST_PROCESSES = 64
"""Processes on this machine at most."""
_MOST_JOBS = 1024
if TYPE_CHECKING:
    from physhandi.synthetic.suite.suite import Suite

_OF_SUITE = arg(help_behavior_hint="(default: the suite's)")


def evaluate_suite(
    *,
    suite: Annotated[
        Literal["tiny", "dev", "dev_rgbd", "dev_contact", "full"] | None,
        arg(help_behavior_hint="(default: tiny)"),
    ] = None,
    methods: Annotated[Several[str], _OF_SUITE] = (),
    seeds: Annotated[Several[int], _OF_SUITE] = (),
    search_seeds: Annotated[
        Several[int], arg(help_behavior_hint="(default: the profiles' own)")
    ] = (),
    protocols: Annotated[
        Several[Literal["main", "single_view", "unseen", "robustness", "sensitivity"]], _OF_SUITE
    ] = (),
    sequences: Annotated[
        Several[str], arg(help_behavior_hint="(default: the suite's scenes)")
    ] = (),
    splats: Annotated[
        int | None, arg(help_behavior_hint="(default: as many as a fit takes)")
    ] = None,
    out: Path | None = None,
    jobs: Annotated[int | None, arg(help_behavior_hint="(default: one each device)")] = None,
    device: Devices = "auto",
    engine: EngineChoice = None,
    as_json: AsJson = False,
    data_dir: DataDir = None,
) -> None:
    """Compare methods on a suite of sequences, and write its tables (docs/evaluation.md).

    Args:
        suite: Which suite; sequences that are not there yet are made. With `--sequences`, whose
            effort methods may take: without it their profiles' own.
        methods: Methods: static, rigid_follow, phystwin, paper, ours, quick, oracle_hand,
            oracle_parameters, true_motion, each also as NAME+last_residual, NAME+restart or
            NAME@SETTING=VALUE.
        seeds: Seeds of every scene. From 1000 on they are reserved for verification.
        search_seeds: Repeat every fit with these seeds of its search, and give means over them with
            their spread; a search is also luck.
        protocols: main is reconstruction and future prediction.
        sequences: Folders or names of sequences to evaluate in place of the suite's scenes.
        splats: Most splats that show what an object looks like, for PSNR, SSIM and IoU of pictures;
            they are fitted once a sequence that has color and masks. 0 compares no pictures.
        out: Folder to fill, and to go on with; none takes one of its own in `suites/` of the data
            folder, whose suites the server shows.
        jobs: How many sequences and cells are computed side by side, each in a process of its own;
            with several GPUs they take turns with them. Then the times in the table are those of a
            shared machine. On a cluster each is a job of its own, and there are as many as all live
            nodes take if this is left out.

    Raises:
        UsageError: If a method, seed or sequence makes no sense, or the folder holds other data.
    """
    with loading_modules():
        from app.cli.suite_jobs import SUITE_WORKER, SuiteJobs
        from app.cli.suite_processes import SuiteProcesses
        from physhandi.synthetic.suite import evaluation
        from physhandi.synthetic.suite.folder import check_folder
        from physhandi.synthetic.suite.suite import (
            NAMED_SETTINGS,
            check_seeds,
            find_suite,
            make_one_by_one,
            make_recordings,
        )

    start = time.monotonic()
    folders, fit_seeds = all_values(sequences), all_values(search_seeds)
    given = {
        "methods": all_values(methods),
        "seeds": all_values(seeds),
        "search-seeds": fit_seeds,
        "protocols": all_values(protocols),
        "splats": () if splats is None else (splats,),
    }
    chosen = find_suite(suite or "tiny")
    if folders and seeds:
        raise UsageError("--seeds belongs to a suite's scenes; leave it out with --sequences.")
    settings = _with_splats(chosen.settings if suite or not folders else NAMED_SETTINGS, splats)
    compared = all_values(methods) or chosen.methods
    _check_methods(compared, fit_seeds, settings)
    check_seeds(scene_seeds := all_values(seeds) or chosen.seeds)
    server = read_settings(data_dir=data_dir, engine=engine)
    is_here = server.engine == LOCAL
    devices = pick_devices(device) if is_here else (device,)
    named = [find_sequence(name, data_dir) for name in folders]
    title, cases, place = _table_of(chosen, scene_seeds, named)
    out = out or server.suite_dir / place
    check_folder(out, title, cases)
    cluster = None if is_here else reached_cluster(cluster_settings(server, device), SUITE_WORKER)
    jobs = _checked_jobs(jobs, len(devices) if cluster is None else cluster.slots, is_here=is_here)
    with watched(True) as progress, ExitStack() as stack:
        # Everything that a user may have got wrong is told before they are started.
        workers = None
        if cluster is not None:
            workers = SuiteJobs(cluster, out, progress, most=jobs, grace_s=server.cancel_grace_s)
        elif jobs > 1:
            workers = stack.enter_context(SuiteProcesses(jobs, progress, devices))
        make = partial(make_one_by_one, progress=progress) if workers is None else workers.make
        environment = workers.environment() if isinstance(workers, SuiteJobs) else {}
        alone = ONLY_CARD if workers and devices[0] != "cpu" else devices[0]
        order = evaluation.Order(
            title=title,
            recordings=tuple(named)
            or make_recordings(chosen, scene_seeds, out / "sequences", make),
            methods=compared,
            protocols=all_values(protocols) or chosen.protocols,
            settings=settings,
            search_seeds=fit_seeds,
            device=str(environment.get("device", alone)),
            command=_command(
                suite, {**given, "sequences": folders}, jobs, ",".join(devices), server.engine
            ),
            at_once=jobs,
            environment=environment,
        )
        for recording in order.recordings:
            recording.validate(reads_color=False)
        fill = None if workers is None else workers.fill(order, out)
        result = evaluation.evaluate_suite(order, out, progress, fill=fill)
    show(result | {"seconds": round(time.monotonic() - start, 1)}, as_json=as_json)


def _table_of(
    chosen: "Suite", seeds: tuple[int, ...], named: list[Sequence]
) -> tuple[str, list[str], str]:
    """Give the title of a table, its cases, and the name of its folder."""
    if named:
        return "Named sequences", [sequence.name for sequence in named], _name_for(named)
    cases = [scene.name(seed) for scene in chosen.scenes for seed in seeds]
    of_seeds = "" if set(seeds) == set(chosen.seeds) else f"-seeds-{_joined(seeds)}"
    return f"Suite {chosen.name}", cases, f"{chosen.name}{of_seeds}"


def _checked_jobs(jobs: int | None, places: int, *, is_here: bool) -> int:
    """Choose how many pieces of work are done side by side; one in each place if none is named.

    Raises:
        UsageError: If the number makes no sense.
    """
    jobs = max(1, places) if jobs is None else jobs
    most = MOST_PROCESSES if is_here else _MOST_JOBS
    if not 1 <= jobs <= most:
        raise UsageError(f"--jobs {jobs} makes no sense; choose 1 to {most}.")
    return jobs


def _check_methods(
    methods: Iterable[str], search_seeds: tuple[int, ...], settings: Mapping[str, Any]
) -> None:
    """Tell a wrong method before a sequence is made, which takes long.

    Raises:
        UsageError: If one is unknown, or has a setting that there is not.
    """
    from physhandi.synthetic.suite.methods import method_settings, parse_method, searched_from

    for method in methods:
        for one in searched_from(parse_method(method), search_seeds):
            method_settings(one, settings)


def _with_splats(settings: Mapping[str, Any], count: int | None) -> dict[str, Any]:
    """Say how many splats show what an object looks like.

    Raises:
        UsageError: If there cannot be so many.
    """
    from physhandi.fitting.config import PipelineConfig, apply_overrides
    from physhandi.synthetic.suite.methods import LOOK

    if count is None:
        return dict(settings)
    asked = {f"{LOOK}splat_count": count} if count else {f"{LOOK}enabled": False}
    apply_overrides(PipelineConfig(), asked)
    return {**settings, **asked}


def _name_for(sequences: list[Sequence]) -> str:
    """Name the folder of an evaluation by its sequences, so that others do not share it."""
    folders = sorted(str(sequence.folder.resolve()) for sequence in sequences)
    digest = hashlib.sha256("\0".join(folders).encode()).hexdigest()[:8]
    more = f"-and-{len(folders) - 1}-more" if len(folders) > 1 else ""
    return f"{sequences[0].name[:32]}{more}-{digest}"


def _joined(seeds: Iterable[int]) -> str:
    text = "-".join(str(seed) for seed in sorted(seeds))
    return text if len(text) <= 32 else hashlib.sha256(text.encode()).hexdigest()[:8]


def _command(
    suite: str | None,
    given: Mapping[str, tuple[object, ...]],
    jobs: int,
    device: str,
    engine: str,
) -> str:
    """Write the command again, with all that decides the result."""
    parts = ["physhandi", "evaluate", "suite"]
    if suite or not given["sequences"]:
        parts += ["--suite", suite or "tiny"]
    for name, values in given.items():
        parts += [f"--{name}", *(str(value) for value in values)] if values else []
    parts += ["--jobs", str(jobs)] if jobs > 1 else []
    parts += [] if engine == LOCAL else ["--engine", engine]
    return shlex.join([*parts, "--device", device])
