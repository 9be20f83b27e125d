"""`physhandi evaluate suite`: find or make sequences, and compare methods on them."""

import hashlib
import shlex
import time
from collections.abc import Iterable
from contextlib import ExitStack
from functools import partial
from typing import Any

from app.cli.commands import find_sequence, read_settings
from physhandi.data.sequence import Sequence
from physhandi.devices import pick_device
from physhandi.errors import UsageError
from physhandi.progress import Progress


def evaluate_suite(command: Any, progress: Progress) -> dict[str, Any]:
    """Compare methods on the sequences of a suite, or on named ones.

    Raises:
        UsageError: If a method, seed or sequence makes no sense, or the folder holds other data.
    """
    from app.cli.suite_workers import MOST_PROCESSES, SuiteWorkers
    from physhandi.synthetic.suite.evaluation import Order, evaluate_suite
    from physhandi.synthetic.suite.folder import check_folder
    from physhandi.synthetic.suite.methods import method_settings, parse_method
    from physhandi.synthetic.suite.suite import (
        NAMED_SETTINGS,
        check_seeds,
        find_suite,
        make_one_by_one,
        make_recordings,
    )

    start = time.monotonic()
    suite = find_suite(command.suite or "tiny")
    if command.sequences and command.seeds:
        raise UsageError("--seeds belongs to a suite's scenes; leave it out with --sequences.")
    settings = suite.settings if command.suite or not command.sequences else NAMED_SETTINGS
    methods = command.methods or suite.methods
    for method in methods:  # Tells a wrong one before a sequence is made, which takes long.
        method_settings(parse_method(method), settings)
    seeds = command.seeds or suite.seeds
    check_seeds(seeds)
    device = pick_device(command.device)
    named = [find_sequence(sequence, command.data_dir) for sequence in command.sequences]
    folders = read_settings(data_dir=command.data_dir).suite_dir
    if named:
        title, cases = "Named sequences", [sequence.name for sequence in named]
        out = command.out or folders / _name_for(named)
    else:
        title, cases = f"Suite {suite.name}", [s.name(n) for s in suite.scenes for n in seeds]
        of_seeds = "" if set(seeds) == set(suite.seeds) else f"-seeds-{_joined(seeds)}"
        out = command.out or folders / f"{suite.name}{of_seeds}"
    check_folder(out, title, cases)
    if not 1 <= command.jobs <= MOST_PROCESSES:
        raise UsageError(f"--jobs {command.jobs} makes no sense; choose 1 to {MOST_PROCESSES}.")
    with ExitStack() as stack:
        # Every mistake of the user is reported before they are started.
        make, workers = partial(make_one_by_one, progress=progress), None
        if command.jobs > 1:
            workers = stack.enter_context(SuiteWorkers(command.jobs, progress))
            make = workers.make
        order = Order(
            title=title,
            recordings=tuple(named) or make_recordings(suite, seeds, out / "sequences", make),
            methods=methods,
            protocols=command.protocols or suite.protocols,
            settings=settings,
            device=device,
            command=_suite_command(command, device),
            at_once=command.jobs,
        )
        for recording in order.recordings:
            recording.validate(reads_color=False)
        fill = None if workers is None else workers.fill(order, out)
        summary = evaluate_suite(order, out, progress, fill=fill)
    return summary | {"seconds": round(time.monotonic() - start, 1)}


def _name_for(sequences: list[Sequence]) -> str:
    """Name the folder of an evaluation by its sequences, so that others do not share it."""
    folders = sorted(str(sequence.folder.resolve()) for sequence in sequences)
    digest = hashlib.sha256("\0".join(folders).encode()).hexdigest()[:8]
    more = f"-and-{len(folders) - 1}-more" if len(folders) > 1 else ""
    return f"{sequences[0].name[:32]}{more}-{digest}"


def _joined(seeds: Iterable[int]) -> str:
    text = "-".join(str(seed) for seed in sorted(seeds))
    return text if len(text) <= 32 else hashlib.sha256(text.encode()).hexdigest()[:8]


def _suite_command(command: Any, device: str) -> str:
    """Write the command again, with all that decides the result."""
    parts = ["physhandi", "evaluate", "suite"]
    if command.suite or not command.sequences:
        parts += ["--suite", command.suite or "tiny"]
    for name in ("methods", "seeds", "protocols", "sequences"):
        given = getattr(command, name)
        parts += [f"--{name}", *(str(value) for value in given)] if given else []
    parts += ["--jobs", str(command.jobs)] if command.jobs > 1 else []
    return shlex.join([*parts, "--device", device])
