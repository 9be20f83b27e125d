"""Which control nodes are near which object nodes, and when: what virtual springs are laid from."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32
from numpy import ndarray

NEVER = np.iinfo(np.int32).max
"""Frame in which a contact that lasts to the end of every motion lets go."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactIntervals:
    """Pairs of an object node and a control node that touch, each for an interval of frames."""

    node: Int32[ndarray, " pair"]
    """Object node."""
    control: Int32[ndarray, " pair"]
    """Control node, counted from 0."""
    distance: Float32[ndarray, " pair"]
    """How far they are from each other when the contact begins [m]."""
    rank: Int32[ndarray, " pair"]
    """Place among the control node's pairs at that time, the nearest first."""
    interval: Int32[ndarray, "pair 2"]
    """Frame in which the contact begins, and last frame in which it holds."""

    def __post_init__(self) -> None:
        count = len(self.node)
        for name in ("control", "distance", "rank"):
            if getattr(self, name).shape != (count,):
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}; expected ({count},)."
                )
        if self.interval.shape != (count, 2):
            raise ValueError(f"interval has shape {self.interval.shape}; expected ({count}, 2).")

    def chosen(self, radius: float, most: int) -> Bool[ndarray, " pair"]:
        """Mark pairs that are nearer than a radius and within a limit of a control node's pairs."""
        return (self.distance < radius) & (self.rank < most)

    def within(self, radius: float, most: int) -> "ContactIntervals":
        """Keep the pairs that are `chosen`, in the order of virtual springs: by object node."""
        rows = np.flatnonzero(self.chosen(radius, most))
        order = np.lexsort((self.interval[rows, 0], self.control[rows], self.node[rows]))
        return self._part(rows[order])

    def median_distance(self, frame_count: int) -> float:
        """Compute how far apart are, most of the time, what holds and what is held [m].

        That of the nearest pair that holds in a frame, when it began to, and the median over the
        first frames in which any does; 0 if none does.
        """
        first, last = self.interval.T
        frame = np.arange(frame_count)[:, None]
        nearest = np.where(
            (first <= frame) & (frame <= last), self.distance, np.float32(np.inf)
        ).min(axis=1, initial=np.inf)
        holding = nearest[np.isfinite(nearest)]
        return float(np.median(holding)) if len(holding) else 0.0

    def spring_nodes(self, node_count: int) -> Int32[ndarray, "pair 2"]:
        """Give the two nodes of each pair: object node, and `node_count` + control."""
        return np.stack([self.node, node_count + self.control], axis=1).astype(np.int32)

    def of_controls(self, numbers: Int[ndarray, " chosen"]) -> "ContactIntervals":
        """Keep the pairs of some control nodes, numbered anew in the order given."""
        place = np.full(int(max(self.control.max(initial=-1), np.max(numbers, initial=-1))) + 1, -1)
        place[numbers] = np.arange(len(numbers))
        part = self._part(np.flatnonzero(place[self.control] >= 0))
        return replace(part, control=place[part.control].astype(np.int32))

    def _part(self, index: Int[ndarray, " part"]) -> "ContactIntervals":
        return ContactIntervals(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def to_tensors(self) -> dict[str, ndarray]:
        """Return every field as an array, ready for safetensors."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "ContactIntervals":
        """Rebuild it from the arrays of `to_tensors`.

        Raises:
            ValueError: If an array is missing, unknown or inconsistent.
        """
        names = {field.name for field in fields(cls)}
        if set(tensors) != names:
            raise ValueError(
                f"Contacts need the arrays {', '.join(sorted(names))}; "
                f"got {', '.join(sorted(tensors))}."
            )
        return cls(**{name: np.asarray(tensors[name]) for name in names})


def always(count: int) -> Int32[ndarray, "item 2"]:
    """Give the frames of so many things that act in all frames."""
    return np.tile(np.array([[0, NEVER]], dtype=np.int32), (count, 1))


def acts_in(interval: Int32[ndarray, "item 2"], frame: int) -> Bool[ndarray, " item"]:
    """Mark what acts on the way to a frame; to frame 0, what does on the way to frame 1.

    Args:
        interval: Frame in whose state each is attached, and the last one before it lets go.
        frame: The frame.
    """
    first, last = interval.T
    step = max(frame, 1)
    return (first < step) & (step <= last)
