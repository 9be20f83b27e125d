"""The motion of one sequence of a run, as the exporters read it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.layout import SequenceFiles
from physhandi.data.object_mass import ObjectMass
from physhandi.data.run import RunFolder
from physhandi.data.sequence_meta import SIDES
from physhandi.data.view import View
from physhandi.errors import RunError, UsageError


@dataclass(frozen=True, eq=False, kw_only=True)
class MovingSurface:
    """The moving surface of a hand or of the object."""

    vertex: Float[ndarray, "frame vertex 3"]
    """Vertex positions [m]."""
    face: Int[ndarray, "face 3"] | None
    """Triangles; None if the run does not hold them."""
    color: UInt8[ndarray, "vertex 3"] | None = None
    """Colors (sRGB); None if they are not known."""


@runtime_checkable
class BoundSurface(Protocol):
    """A surface whose vertices follow the nodes of the object."""

    @property
    def face(self) -> Int[ndarray, "face 3"]:
        """Triangles."""
        ...

    @property
    def color(self) -> UInt8[ndarray, "vertex 3"] | None:
        """Colors (sRGB); None if they are not known."""
        ...

    def place(self, node: Float[ndarray, "node 3"]) -> Float[ndarray, "vertex 3"]:
        """Find where the vertices are when the nodes are somewhere [m]."""
        ...


LaySurface = Callable[[], BoundSurface | None]
"""Lays the smooth surface of an object; None if it has none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneData:
    """Object, controls and hands of one sequence of a run, over all frames."""

    sequence: str
    """Name of the sequence."""
    frame_rate: float
    """Frames per second [Hz]."""
    length_unit: str
    """Name of the unit of all lengths."""
    rollout: Float[ndarray, "frame node 3"]
    """Object nodes [m]; no nodes if the run has no object."""
    control: Float[ndarray, "frame control 3"]
    """Control nodes [m]."""
    spring_nodes: Int[ndarray, "spring 2"]
    """Nodes that each spring joins; object nodes first, then control nodes."""
    object_spring_count: int
    """Number of leading springs that join two object nodes; the others are virtual springs."""
    hands: dict[str, MovingSurface]
    """Surface of each hand by its side."""
    lay_surface: LaySurface | None = None
    """Lays the surface that `object_surface` moves; None if nobody can."""
    run: str = ""
    """Id of the run."""
    joints: Mapping[str, ndarray] = field(default_factory=dict[str, ndarray])
    """The 21 joints of each hand by its side (frame joint 3) [m], of runs that hold them."""
    model: Mapping[str, ndarray] = field(default_factory=dict[str, ndarray])
    """The springs' tensors, as a run stores them; none without an object."""
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Simulation parameters of the object by name; empty if they are not known."""
    dt: float = 0.0
    """Length of one substep [s]; 0 if that is not known."""
    mass: ObjectMass | None = None
    """Mass of the object; None if it is not known."""
    skins: Mapping[str, Mapping[str, ndarray]] = field(
        default_factory=dict[str, Mapping[str, ndarray]]
    )
    """Bones and weights of the hands that have them, by side; see `read_skins`."""
    forces: Callable[[int], Float[ndarray, "node 3"]] | None = None
    """Gives the force of the hands on each node in a frame, for nodes of 1 kg [N]; None if forces
    are not known."""
    views: tuple[View, ...] = ()
    """Recorded views, if they are there."""

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.rollout)

    @cached_property
    def _bound_surface(self) -> BoundSurface | None:
        return None if self.lay_surface is None else self.lay_surface()

    def object_surface(self, frames: slice = slice(None)) -> MovingSurface | None:
        """Move the smooth surface of the object with its nodes, in all frames or in some.

        It is laid when it is first asked for, which not every format does.

        Returns:
            None if the object has no surface.
        """
        bound = self._bound_surface
        if bound is None:
            return None
        vertex = np.stack([bound.place(np.asarray(node)) for node in self.rollout[frames]])
        return MovingSurface(vertex=vertex, face=bound.face, color=bound.color)

    def virtual_springs_in(self, frame: int) -> Int[ndarray, "spring 2"]:
        """Get the springs between control and object nodes that are attached in a frame."""
        springs = self.spring_nodes[self.object_spring_count :]
        attached = self.model.get("attached")
        if attached is None:
            return springs
        first, last = attached.T
        return springs[(first < max(frame, 1)) & (max(frame, 1) <= last)]


def read_scene(run: RunFolder, sequence: str | None) -> SceneData:
    """Collect the motion of one sequence of a run.

    Args:
        run: The run.
        sequence: Name of the sequence; None takes the first one.

    Raises:
        UsageError: If the run has no such sequence.
        RunError: If the run holds no motion of it.
    """
    if sequence is not None and sequence not in run.sequence_names:
        raise UsageError(
            f"Run '{run.id}' has no sequence '{sequence}'. It has: {', '.join(run.sequence_names)}."
        )
    name = sequence or run.sequence_names[0]
    files = SequenceFiles(name)
    if not run.has(files.meta):
        raise RunError(f"Run '{run.id}' has nothing of sequence '{name}'; it is {run.state}.")
    meta = run.recording(name)
    hands: dict[str, MovingSurface] = {}
    for side in SIDES:
        if run.has(files.hand_vertex(side)):
            face = run.array(files.hand_face(side)) if run.has(files.hand_face(side)) else None
            vertex = run.array(files.hand_vertex(side))
            hands[side] = MovingSurface(vertex=vertex, face=face)
    rollout, control = (
        run.array(file) if run.has(file) else None for file in (files.rollout, files.control)
    )
    if rollout is None and not hands:
        raise RunError(f"Run '{run.id}' holds neither hands nor an object of sequence '{name}'.")
    frame_count = len(rollout) if rollout is not None else len(next(iter(hands.values())).vertex)
    nothing = np.zeros((frame_count, 0, 3), np.float32)
    model: dict[str, ndarray] = {}
    if run.has(files.model):
        model = run.tensors(files.model)
    if run.has(files.restart):
        state = run.tensors(files.restart)
        model |= {f"restart_{name}": array for name, array in state.items()}
    return SceneData(
        sequence=name,
        frame_rate=float(meta["frame_rate"]),
        length_unit=meta.get("length_unit", "m"),
        rollout=nothing if rollout is None else rollout,
        control=nothing if control is None else control[:frame_count],
        spring_nodes=model.get("spring_nodes", np.zeros((0, 2), np.int32)),
        object_spring_count=int(model["object_spring_count"][0]) if model else 0,
        hands=hands,
        run=run.id,
        model=model,
        skins=read_skins(run, name),
        joints=read_joints(run, name),
    )


def read_joints(run: RunFolder, sequence: str) -> dict[str, ndarray]:
    """Read the joints of the hands by side (frame joint 3) [m]."""
    stored = {side: SequenceFiles(sequence).hand_keypoint(side) for side in SIDES}
    return {side: run.array(rel) for side, rel in stored.items() if run.has(rel)}


def read_skins(run: RunFolder, sequence: str) -> dict[str, Mapping[str, ndarray]]:
    """Read skeletons and skin weights of the hands; runs of version 0.1 have none.

    Args:
        run: The run.
        sequence: Name of one of its sequences.

    Returns:
        By side: ``name``, ``parent``, ``T_bone_hand``, ``vertex``, ``faces``, ``vertex_bone``,
        ``vertex_weight``, ``translation`` and ``rotation``, as docs/formats.md describes them.
    """
    stored = {side: SequenceFiles(sequence).hand_skin(side) for side in SIDES}
    return {side: run.tensors(rel) for side, rel in stored.items() if run.has(rel)}
