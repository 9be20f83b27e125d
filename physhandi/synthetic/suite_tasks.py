"""What is to be evaluated: an order, and the cells that its protocols ask for."""

from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
from typing import Any

from physhandi.data.atomic import named_fields
from physhandi.data.sequence import Sequence
from physhandi.synthetic.baselines import Method
from physhandi.synthetic.generator_version import told_version
from physhandi.synthetic.suite import Protocol

SENSITIVITY = ((0.001, 3), (0.002, 3), (0.02, 3), (0.04, 3), (0.002, 1), (0.002, 10), (0.002, 50))
"""Start values of virtual δ [m] and d_max: the rows of the paper's sensitivity table."""
ROBUSTNESS = ("noisy_depth", "noisy_tracks", "noisy_hand")
"""The paper's three disturbances."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """What is to be evaluated."""

    title: str
    """What the report is called."""
    recordings: tuple[Sequence, ...]
    """Sequences that methods are scored on."""
    methods: tuple[str, ...]
    """Names of methods."""
    protocols: tuple[Protocol, ...] = ("main",)
    """Which protocols are run."""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings that all methods share."""
    device: str = "cpu"
    """Warp device."""
    command: str = ""
    """The command that asks for it, which the report repeats."""
    at_once: int = 1
    """How many cells are computed side by side, which share the machine."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One cell that a protocol asks for."""

    protocol: Protocol
    """What asks for it."""
    split: str
    """What the protocol calls it."""
    method: Method
    """Who is to fill it."""
    recording: Sequence
    """What it is scored against."""
    variant: str = "recording"
    """What the method is given."""
    fitted: Sequence | None = None
    """Where the object is fitted, if that is another recording."""


def list_tasks(order: Order, methods: Many[Method]) -> Iterator[Task]:
    """List the cells of an order, protocol by protocol and sequence by sequence.

    Args:
        order: What is to be evaluated.
        methods: Its methods, read.

    Yields:
        Cells; an unseen interaction without `fitted` lacks another recording of the same body.
    """
    for protocol in order.protocols:
        for recording in order.recordings:
            for method in methods:
                yield from _asked(protocol, order, method, recording)


def _asked(protocol: Protocol, order: Order, method: Method, recording: Sequence) -> Iterator[Task]:
    task = Task(protocol=protocol, split=protocol, method=method, recording=recording)
    is_plain = method.gets == "recording"
    if protocol == "main":
        yield task
    elif protocol == "single_view" and is_plain:
        yield replace(task, variant="one_view")
    elif protocol == "robustness" and is_plain:
        for variant in ROBUSTNESS:
            yield replace(task, variant=variant, split=variant)
    elif protocol == "unseen" and not method.is_corrected:
        yield replace(task, fitted=_other_of_same_object(recording, order.recordings))
    elif protocol == "sensitivity" and is_plain and recording is order.recordings[0]:
        starts = () if method.rule else SENSITIVITY
        yield from (_started(task, *start) for start in starts)


def _started(task: Task, radius: float, most: int) -> Task:
    """Start a method's search elsewhere; it keeps its name, and the split tells where."""
    start = {
        "simulation.virtual_connection_radius": radius,
        "simulation.virtual_max_neighbors": most,
    }
    method = replace(task.method, overrides={**task.method.overrides, **start})
    return replace(task, method=method, split=f"start δ={1000 * radius:g} mm d_max={most}")


def _other_of_same_object(recording: Sequence, others: Many[Sequence]) -> Sequence | None:
    """Find the next recording of the same body in another action; around the end of the list."""
    own, action = _body(recording)
    order = list(others)
    place = order.index(recording)
    if own is None or action is None:
        return None
    for other in order[place + 1 :] + order[:place]:
        body, done = _body(other)
        if body == own and done is not None and done != action:
            return other
    return None


def _body(recording: Sequence) -> tuple[tuple[Any, ...] | None, Any]:
    """Identify the made body of a recording, and what is done with it.

    Seed and object decide a body's size and material, for one version of the generator.
    """
    made = named_fields(recording.provenance.get("synthesize"))
    if made is None:
        return None, None
    body = tuple(made.get(name) for name in ("object", "seed", "resolution"))
    return (*body, told_version(recording)), made.get("action")
