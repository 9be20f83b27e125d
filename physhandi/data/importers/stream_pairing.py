"""Which images of several streams belong to the same moment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.data.importers.recorded_stream import RecordedStream, StreamKind
from physhandi.errors import ImportFailedError, UsageError

DEFAULT_RATE = 30.0
"""Frame rate of recordings that say nothing about time [Hz]."""
NEAREST = 0.75
"""An image this far from its moment, in frames, is taken for another one's."""
MOST_MISSING = 0.1
"""A stream that lacks more than this part of the frames is refused."""
_NAMED = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class PairedFrames:
    """For every frame the image of each stream, at even steps of time."""

    frame_rate: float
    """Frames per second [Hz]."""
    index: tuple[Int[ndarray, " frame"], ...]
    """For each stream the number of its image, from 0 on; -1 where it has none."""
    error: tuple[Float[ndarray, " frame"] | None, ...]
    """For each stream how far its image is from the frame's moment [s]; None without times."""
    notes: tuple[str, ...]
    """Repairs and assumptions, as sentences."""

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.index[0])


def pair_streams(
    names: Sequence[str], streams: Sequence[RecordedStream], frame_rate: float | None
) -> PairedFrames:
    """Pair the images of all streams by time, else by number, else by order.

    A frame for which a color stream has no image repeats its neighbour; for one without depth
    there is no depth. Both are said.

    Args:
        names: What messages call each stream.
        streams: The streams.
        frame_rate: Frames per second of recordings without times; None if nothing is known [Hz].

    Raises:
        ImportFailedError: If the streams do not overlap, or one lacks more than a tenth.
    """
    timed = [stream.time is not None for stream in streams]
    if all(timed):
        return _by_time(names, streams)
    if any(timed):
        has, lacks = names[timed.index(True)], names[timed.index(False)]
        raise ImportFailedError(
            f"{lacks} has no timestamps, but {has} has (from "
            f"{streams[timed.index(True)].time_source}). Give them for all, or remove them."
        )
    notes: list[str] = []
    if frame_rate is None:
        frame_rate = next((s.frame_rate for s in streams if s.frame_rate is not None), None)
    if frame_rate is None:
        frame_rate = DEFAULT_RATE
        notes.append(f"Nothing tells the frame rate, so it is taken for {DEFAULT_RATE:g} Hz.")
    numbers = [
        stream.number or (tuple(range(stream.count)) if not stream.files else None)
        for stream in streams
    ]
    numbered = [number for number in numbers if number is not None]
    if len(numbered) == len(streams) and not _is_counted_apart(numbered):
        return _by_number(names, streams, numbered, frame_rate, notes)
    return _by_order(names, streams, frame_rate, notes)


def cut(paired: PairedFrames, start: int, stop: int | None, every: int) -> PairedFrames:
    """Keep every n-th frame from `start` on and before `stop`.

    Raises:
        UsageError: If fewer than two frames are left, or `stop` is beyond the end.
    """
    count = paired.count
    last = count if stop is None else stop
    if start < 0 or every < 1 or last > count:
        raise UsageError(
            f"--start {start} --stop {last} --every {every}: the recording has frames 0 to "
            f"{count - 1}, so stop is at most {count}, start at least 0, and every at least 1."
        )
    frames = range(start, last, every)
    if len(frames) < 2:
        chosen = "" if count < 2 else f", and --start {start} --stop {last} --every {every} leave"
        raise UsageError(
            f"The recording has {count} common frame{'' if count == 1 else 's'}{chosen}"
            f"{f' {len(frames)}' if chosen else ''}; a motion needs at least 2."
        )
    return replace(
        paired,
        frame_rate=paired.frame_rate / every,
        index=tuple(index[start:last:every] for index in paired.index),
        error=tuple(None if e is None else e[start:last:every] for e in paired.error),
    )


def _by_time(names: Sequence[str], streams: Sequence[RecordedStream]) -> PairedFrames:
    times = [stream.time for stream in streams if stream.time is not None]
    start, end = max(time[0] for time in times), min(time[-1] for time in times)
    if start > end:
        late = names[int(np.argmax([time[0] for time in times]))]
        early = names[int(np.argmin([time[-1] for time in times]))]
        raise ImportFailedError(
            f"{late} begins {start - end:.3g} s after {early} has ended, so no moment is in both. "
            "Their clocks differ: correct the timestamps, or remove them to pair by number."
        )
    steps = [float(np.median(np.diff(time))) if len(time) > 1 else np.inf for time in times]
    finite = [step for step in steps if np.isfinite(step)]
    if not finite:
        return PairedFrames(
            frame_rate=DEFAULT_RATE,
            index=tuple(np.zeros(1, np.int64) for _ in times),
            error=tuple(np.zeros(1) for _ in times),
            notes=(),
        )
    # The slowest stream leads: faster ones have an image for each of its moments.
    leader = next(number for number, step in enumerate(steps) if step >= 0.95 * max(finite))
    period, moments = _grid(times[leader], steps[leader], float(start), float(end))
    notes: list[str] = []
    index: list[ndarray] = []
    error: list[ndarray] = []
    for name, stream, time in zip(names, streams, times, strict=True):
        nearest = _nearest(time, moments)
        away = np.subtract(time[nearest], moments)
        chosen, remarks = _mended(name, stream.kind, nearest, np.abs(away) > NEAREST * period)
        away[chosen < 0] = np.nan
        index.append(chosen)
        error.append(away)
        notes.extend(remarks)
    return PairedFrames(
        frame_rate=1.0 / period, index=tuple(index), error=tuple(error), notes=tuple(notes)
    )


def _grid(
    clock: ndarray, step: float, start: float, end: float
) -> tuple[float, Float[ndarray, " frame"]]:
    """Lay even moments through a clock that may lack images: their distance, and those in between.

    Args:
        clock: Times of the stream that leads [s].
        step: Its median step [s].
        start: Where the last stream begins [s].
        end: Where the first stream ends [s].
    """
    passed = np.concatenate([[0], np.maximum(1, np.round(np.diff(clock) / step)).cumsum()])
    period = float((clock[-1] - clock[0]) / passed[-1]) if passed[-1] else step
    phase = float(np.median(clock - period * passed))
    first = int(np.ceil((start - phase) / period - 0.5))
    last = int(np.floor((end - phase) / period + 0.5))
    return period, phase + period * np.array(range(first, last + 1), dtype=np.float64)


def _nearest(time: ndarray, moments: ndarray) -> Int[ndarray, " frame"]:
    """Number of the image that is nearest to each moment."""
    right = np.minimum(np.maximum(np.searchsorted(time, moments), 1), len(time) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(time[left] - moments) <= np.abs(time[right] - moments)
    return np.where(is_left, left, right)


def _is_counted_apart(numbers: Sequence[tuple[int, ...]]) -> bool:
    """Tell whether streams of one length number their images from different starts."""
    is_equal = len({len(number) for number in numbers}) == 1
    is_whole = all(max(one) - min(one) + 1 == len(one) for one in numbers)
    return is_equal and is_whole and len({min(number) for number in numbers}) > 1


def _by_number(
    names: Sequence[str],
    streams: Sequence[RecordedStream],
    numbers: Sequence[tuple[int, ...]],
    frame_rate: float,
    notes: list[str],
) -> PairedFrames:
    first = max(min(number) for number in numbers)
    last = min(max(number) for number in numbers)
    if first > last:
        ranges = "; ".join(
            f"{name} has {min(number)} to {max(number)}"
            for name, number in zip(names, numbers, strict=True)
        )
        raise ImportFailedError(f"No frame number is in all streams: {ranges}. Number them alike.")
    steps = [
        step for number in numbers for step in np.diff(np.sort(np.array(number))).tolist()
    ] or [1]
    frames = np.arange(first, last + 1, max(1, round(float(np.median(steps)))))
    index: list[ndarray] = []
    for name, stream, number in zip(names, streams, numbers, strict=True):
        place = {value: at for at, value in enumerate(number)}
        available = np.array(number)
        nearest = np.array(
            [place.get(f, int(np.abs(available - f).argmin())) for f in frames.tolist()]
        )
        lost = np.array([f not in place for f in frames.tolist()])
        chosen, remarks = _mended(name, stream.kind, nearest, lost, frames)
        index.append(chosen)
        notes.extend(remarks)
        spare = [value for value in number if not first <= value <= last]
        if spare:
            notes.append(
                f"{name}: {len(spare)} images ({min(spare)} to {max(spare)}) are left out, because "
                "another stream does not have them."
            )
    return PairedFrames(
        frame_rate=frame_rate,
        index=tuple(index),
        error=(None,) * len(streams),
        notes=tuple(notes),
    )


def _by_order(
    names: Sequence[str],
    streams: Sequence[RecordedStream],
    frame_rate: float,
    notes: list[str],
) -> PairedFrames:
    counts = [stream.count for stream in streams]
    count = min(counts)
    if count < (1 - MOST_MISSING) * max(counts):
        text = ", ".join(f"{name} {n}" for name, n in zip(names, counts, strict=True))
        raise ImportFailedError(
            f"The streams have different numbers of images ({text}), and neither times nor numbers "
            "tell which belong together. Add timestamps, or number the images alike."
        )
    if count < max(counts):
        shortest = names[counts.index(count)]
        notes.append(f"All streams are cut to the {count} images of {shortest}, by their order.")
    else:
        notes.append("Images are paired by their order: neither times nor numbers are common.")
    return PairedFrames(
        frame_rate=frame_rate,
        index=tuple(np.arange(count) for _ in streams),
        error=(None,) * len(streams),
        notes=tuple(notes),
    )


def _mended(
    name: str,
    kind: StreamKind,
    nearest: ndarray,
    lost: ndarray,
    number: ndarray | None = None,
) -> tuple[ndarray, list[str]]:
    """Fill frames that a stream lacks, and say which."""
    places = np.flatnonzero(lost)
    if not len(places):
        return nearest, []
    shown = ", ".join(str(int(p if number is None else number[p])) for p in places[:_NAMED])
    more = f" and {len(places) - _NAMED} more" if len(places) > _NAMED else ""
    if len(places) > MOST_MISSING * len(lost):
        raise ImportFailedError(
            f"{name} lacks {len(places)} of {len(lost)} frames (frame {shown}{more}). Record it "
            "again, or cut the others with --start and --stop to what it has."
        )
    if kind == "depth":
        return np.where(lost, -1, nearest), [f"{name} has no image for frame {shown}{more}."]
    return nearest, [f"{name} has no image for frame {shown}{more}; its neighbour is repeated."]
