"""Stores the substeps of a rollout for its backward pass, as far as memory allows.

As many of the last frames are stored as fit. The backward pass simulates the others again one by
one, each in the memory of a frame that is finished. The bits are the same either way, because the
same kernels record both.
"""

import math
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import numpy as np
import warp as wp

_CGROUP = Path("/sys/fs/cgroup")
_FILES = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    (
        "memory/memory.limit_in_bytes",
        "memory/memory.usage_in_bytes",
        "memory/memory.stat",
        "total_inactive_file",
    ),
)
"""Files of limit, use and statistics, and the field of reclaimable memory, of cgroups 2 and 1."""


def free_memory(device: Any) -> int:
    """Return the free memory of a Warp device [B], within the limit of a container if any."""
    if device.is_cuda:
        return int(device.free_memory)
    # Needed on CPUs only.
    import psutil

    free = int(psutil.virtual_memory().available)
    container = container_memory(_CGROUP)
    return free if container is None else min(free, container)


def container_memory(folder: Path) -> int | None:
    """Return the free memory of a container [B]; None without a limit.

    Args:
        folder: Root of the control groups.
    """
    for limit, used, statistics, droppable in _FILES:
        try:
            limit_text = (folder / limit).read_text().strip()
            if limit_text == "max":
                return None
            fields = dict(line.split() for line in (folder / statistics).read_text().splitlines())
            use = int((folder / used).read_text()) - int(fields.get(droppable, 0))
            return max(0, int(limit_text) - use)
        except FileNotFoundError:
            continue
    return None


CUDA_SHARE, CPU_SHARE = 0.5, 0.25
"""Share of a device's free memory that one trajectory may use."""

TapeLayout = tuple[tuple[tuple[int, ...], Any], ...]
"""Shape and type (a vector of floats) of each array of a tape."""
Tape = tuple[wp.array, ...]
"""Arrays with the substeps of one frame."""


class Recorder(Protocol):
    """The adjoint of a frame, as a trajectory sees it."""

    @property
    def layout(self) -> TapeLayout:
        """Layout of the tape of a frame."""
        ...

    def record(self, tape: Tape) -> None:
        """Advance the simulator by one frame and record its substeps."""
        ...


def frame_bytes(layout: TapeLayout) -> int:
    """Return the memory of the tape of one frame [B]."""
    return sum(math.prod(shape) * wp.types.type_size_in_bytes(dtype) for shape, dtype in layout)


def stored_frames(layout: TapeLayout, frame_count: int, memory: int) -> int:
    """Return the number of stored frames: as many as fit, but at least one.

    Args:
        layout: Layout of a tape.
        frame_count: Frames of the rollout, frame 0 not counted.
        memory: Memory that the trajectory may use [B].
    """
    return min(frame_count, max(1, memory // max(1, frame_bytes(layout))))


def memory_budget(device: Any) -> int:
    """Return how much memory a trajectory may use on a Warp device now [B]."""
    device = wp.get_device(device)
    with _lock:
        layout, tapes = _spare.get(device.alias, ((), []))
        free = free_memory(device) + len(tapes) * frame_bytes(layout)
    return int((CUDA_SHARE if device.is_cuda else CPU_SHARE) * free)


class Trajectory:
    """Substeps of the frames of one rollout; frames are counted from 1."""

    def __init__(
        self, recorder: Recorder, device: Any, frame_count: int, memory: int | None = None
    ) -> None:
        """Decide how many frames to store; memory is allocated at the first recording.

        Args:
            recorder: Simulates and records frames.
            device: Warp device of the tapes.
            frame_count: Frames of the rollout, frame 0 not counted.
            memory: Memory that may be used [B], but always one frame's; None for `memory_budget`.
        """
        self._recorder = recorder
        self._device = device
        self._frame_count = frame_count
        memory = memory_budget(device) if memory is None else memory
        self._count = stored_frames(recorder.layout, frame_count, memory)
        self._tapes: list[Tape] = []
        self._held: dict[int, int] = {}

    def keeps(self, frame: int) -> bool:
        """Whether a frame is to be recorded in the forward pass."""
        return frame > self._frame_count - self._count

    def holds(self, frame: int) -> bool:
        """Whether a frame's substeps are stored."""
        return self._held.get(frame % self._count) == frame

    def record(self, frame: int) -> None:
        """Advance the simulator by a frame and store its substeps, replacing a later frame's."""
        if not self._tapes:
            self._tapes = _take(self._device, self._recorder.layout, self._count)
        place = frame % self._count
        self._held[place] = 0
        self._recorder.record(self._tapes[place])
        self._held[place] = frame

    def tape(self, frame: int) -> Tape:
        """Return the substeps of a stored frame."""
        if not self.holds(frame):
            raise KeyError(f"frame {frame} is not held")
        return self._tapes[frame % self._count]

    def release(self) -> None:
        """Release the memory for the next trajectory; this one can continue with one frame's."""
        _give_back(self._device, self._recorder.layout, self._tapes)
        self._tapes, self._count = [], min(1, self._count)
        self._held.clear()


# Writing to fresh memory can cost a CPU as much as simulating the frame, so released tapes are
# reused.
_spare: dict[str, tuple[TapeLayout, list[Tape]]] = {}
_lock = Lock()


def _take(device: Any, layout: TapeLayout, count: int) -> list[Tape]:
    """Allocate tapes, released ones first."""
    with _lock:
        spare_layout, spare = _spare.pop(device.alias, (layout, []))
        tapes = spare[:count] if spare_layout == layout else []
        if spare_layout == layout and spare[count:]:
            _spare[device.alias] = layout, spare[count:]
    del spare
    for _ in range(count - len(tapes)):
        tapes.append(tuple(_room(device, shape, dtype) for shape, dtype in layout))
    return tapes


def _room(device: Any, shape: tuple[int, ...], dtype: Any) -> wp.array:
    if device.is_cuda:
        return wp.empty(shape, dtype=dtype, device=device)
    # NumPy asks the system for large pages, which cost a tenth when they are written to first.
    room = np.empty((*shape, wp.types.type_size_in_bytes(dtype) // 4), dtype=np.float32)
    return wp.array(room, dtype=dtype, device=device, copy=False)


def _give_back(device: Any, layout: TapeLayout, tapes: list[Tape]) -> None:
    """Keep released tapes for the next trajectory; drop those of another layout."""
    with _lock:
        spare_layout, spare = _spare.pop(device.alias, (layout, []))
        _spare[device.alias] = layout, (spare if spare_layout == layout else []) + tapes
