"""Content of a session: hands, object, observation and cameras of one sequence."""

import logging
from collections.abc import Sequence as Listing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.content.observed import (
    CloudSet,
    DepthCloud,
    Markers,
    Observed,
    PointSet,
    Tracks,
    lift_keypoints,
)
from physhandi.appearance.splats import Splats
from physhandi.data.layout import SHAPE_FILE, SPLATS_FILE, SequenceFiles
from physhandi.data.object_mass import ObjectMass, estimated_mass, given_mass
from physhandi.data.run_folder import RecordingFile, reading
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import MissingInputError, PhysHandiError, UsageError
from physhandi.object_rollout import ObjectRollout, load_fitted, load_surface
from physhandi.run import Run
from physhandi.simulation.object_surface import ObjectSurface

logger = logging.getLogger(__name__)


class ContentSource(Protocol):
    """Finds runs and sequences by their ids."""

    def run(self, run_id: str, /) -> Run:
        """Open a run."""
        ...

    def sequence(self, sequence_id: str, /) -> Sequence:
        """Open a sequence."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownHand:
    """The moving surface of one hand."""

    side: Literal["right", "left"]
    """``"right"`` or ``"left"``."""
    vertex: Float[ndarray, "frame vertex 3"]
    """Vertex positions [m]."""
    face: Int[ndarray, "face 3"] | None
    """Triangles, or None if they are not known (points are shown)."""
    joint: Float[ndarray, "frame joint 3"] | None = None
    """Its 21 joints [m], if the run holds them."""
    keypoint: Float[ndarray, "view frame joint 3"] | None = None
    """Keypoints of the joints in the views (x, y [px], confidence), NaN where not seen."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Content:
    """Everything that can be shown of one sequence, with or without a run."""

    title: str
    """Name of the run or the sequence."""
    sequence_name: str
    """Name of the sequence."""
    frame_count: int
    """Number of frames."""
    frame_rate: float
    """Frames per second [Hz]."""
    reconstruction_count: int
    """Number of frames that were fitted; the later ones are predicted."""
    length_unit: str
    """Unit of all lengths, ``"m"`` if metric."""
    ground_height: float | None
    """Height of the ground [m]; None if there is none."""
    hands: tuple[ShownHand, ...] = ()
    """Reconstructed hands."""
    skeletons: tuple[Float[ndarray, "frame keypoint 3"], ...] = ()
    """Hand keypoints lifted from the views, if there are no reconstructed hands."""
    control: Float[ndarray, "frame control 3"] | None = None
    """Control nodes [m]."""
    fitted: ObjectRollout | None = None
    """The object's fitted rollout."""
    observed: Observed | None = None
    """Observed points: markers, tracks or depth."""
    tracks: Tracks | None = None
    """Points that were followed over the frames."""
    markers: Markers | None = None
    """Identified markers of a recording, if they are shown without an object."""
    views: Listing[View] = field(default_factory=tuple)
    """The recording's views."""
    mass: ObjectMass | None = None
    """Mass of the object; None if it can not even be estimated."""
    surface: ObjectSurface | None = None
    """The smooth surface of the object; None if its nodes have none."""
    splats: Splats | None = None
    """Splats of the object; None if none were fitted."""

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.length_unit == "m"

    @property
    def plays_at_once(self) -> bool:
        """Whether anything in it was followed through more than one frame, fitted or tracked.

        A bare cloud is looked at frame by frame, and costs a read of all depth images to play.
        """
        is_bare = isinstance(self.observed, DepthCloud) and not self.hands and not self.skeletons
        return self.frame_count > 1 and (self.fitted is not None or not is_bare)

    def close(self) -> None:
        """Release the video decoders; a view that is asked again opens its own anew."""
        for view in self.views:
            view.close()


def open_run_content(
    catalog: ContentSource, run_id: str, sequence_name: str | None = None
) -> Content:
    """Collect the results of one of a run's sequences.

    Args:
        catalog: Finds the run, and the recording behind it.
        run_id: The run.
        sequence_name: One of the run's sequences; None for the first.

    Raises:
        MissingInputError: If the run has no result for that sequence yet.
        RunError: If a published file is missing or damaged; names it.
    """
    run = catalog.run(run_id)
    if run.is_published:
        run.verify(allows_more=True)
    name = sequence_name or run.sequence_names[0]
    if name not in run.sequence_names:
        raise UsageError(f"Run '{run.name}' has no sequence '{name}'.")
    files = SequenceFiles(name)
    if not run.has(files.meta):
        raise MissingInputError(
            f"Run '{run.name}' has no result for sequence '{name}' yet ({files.meta} is "
            "missing). Open it when its first stage is finished."
        )
    meta = run.recording(name)
    sequence = _recording(catalog, run, name)
    control = run.array(files.control) if run.has(files.control) else None
    fitted = load_fitted(run, name)
    views = sequence.views if sequence else ()
    of_recording = _observation(sequence) if sequence else None
    return Content(
        title=run.name,
        sequence_name=name,
        frame_count=meta["frame_count"],
        frame_rate=float(meta["frame_rate"]),
        reconstruction_count=meta.get("reconstruction_frames", meta["frame_count"]),
        length_unit="m" if meta.get("metric", True) else meta.get("length_unit", "units"),
        ground_height=meta.get("ground_height"),
        hands=_hands(run, files, meta.get("hands", [])),
        control=control,
        fitted=fitted,
        observed=_run_observation(run, files, views) or of_recording,
        tracks=_run_tracks(run, files),
        views=views,
        mass=_mass(run, meta, sequence) if meta.get("metric", True) else None,
        surface=None if fitted is None else load_surface(run, fitted, views),
        splats=None if fitted is None else _splats(run, fitted),
    )


def open_sequence_content(catalog: ContentSource, sequence_id: str) -> Content:
    """Collect what a recording shows before anything is fitted to it."""
    sequence = catalog.sequence(sequence_id)
    return Content(
        title=sequence.name,
        sequence_name=sequence.name,
        frame_count=sequence.frame_count,
        frame_rate=sequence.frame_rate,
        reconstruction_count=len(sequence.reconstruction_frames),
        length_unit="m" if sequence.metric else sequence.length_unit,
        ground_height=sequence.ground_height,
        skeletons=lift_keypoints(sequence.views),
        control=sequence.control,
        observed=_observation(sequence),
        markers=Markers.of(sequence),
        views=sequence.views,
    )


def _splats(run: Run, fitted: ObjectRollout) -> Splats | None:
    """Load the splats of a run's object; None if none were fitted."""
    if not run.has(SPLATS_FILE):
        return None
    with reading(run.out / SPLATS_FILE):
        splats = Splats.from_tensors(run.tensors(SPLATS_FILE))
        if len(splats.rest_node) != fitted.model.node_count:
            raise ValueError(
                f"rest_node has {len(splats.rest_node)} nodes, but the object has "
                f"{fitted.model.node_count}."
            )
    return splats


def _mass(run: Run, meta: RecordingFile, sequence: Sequence | None) -> ObjectMass | None:
    """Find what the object weighs: as the recording says today, as it said, or an estimate."""
    kilograms = meta.get("mass") if sequence is None else sequence.mass
    if kilograms is not None:
        return given_mass(float(kilograms))
    return estimated_mass(run.yaml(SHAPE_FILE)) if run.has(SHAPE_FILE) else None


def _recording(catalog: ContentSource, run: Run, name: str) -> Sequence | None:
    """Find the recording where the run found it, else by its name."""
    folder = Path(run.sequences[run.sequence_names.index(name)])
    try:
        return Sequence.load(folder) if folder.is_dir() else catalog.sequence(name)
    except PhysHandiError as error:
        logger.info("the recording behind the run is not shown: %s", error)
        return None


def _hands(run: Run, files: SequenceFiles, recorded: Listing[str]) -> tuple[ShownHand, ...]:
    """Load the hands; `recorded` are the sides in the order of the keypoints."""
    seen = run.array(files.keypoint) if run.has(files.keypoint) else None
    hands: list[ShownHand] = []
    sides: tuple[Literal["right", "left"], ...] = ("right", "left")
    for side in sides:
        if run.has(files.hand_vertex(side)):
            vertex = run.array(files.hand_vertex(side))
            stored = files.hand_face(side)
            face = run.array(stored) if run.has(stored) else _faces(side, vertex.shape[1])
            stored = files.hand_keypoint(side)
            joint = run.array(stored) if run.has(stored) else None
            at = recorded.index(side) if side in recorded else -1
            is_seen = seen is not None and 0 <= at < seen.shape[2]
            keypoint = seen[:, :, at] if seen is not None and is_seen else None
            hands.append(
                ShownHand(side=side, vertex=vertex, face=face, joint=joint, keypoint=keypoint)
            )
    return tuple(hands)


def _faces(side: Literal["right", "left"], vertex_count: int) -> Int[ndarray, "face 3"] | None:
    """Give the open hand's faces to a run that stored none."""
    from physhandi.hand.loading import load_hand_model

    model = load_hand_model(side)
    if model.vertex_count != vertex_count:
        logger.info("the %s hand has %d vertices; shown as points", side, vertex_count)
        return None
    return np.asarray(model.faces, dtype=np.int32)


def _run_observation(run: Run, files: SequenceFiles, views: Listing[View]) -> Observed | None:
    clouds = files.observation("cloud"), files.observation("cloud_end")
    if all(run.has(name) for name in clouds):
        return CloudSet(run.array(clouds[0]), run.array(clouds[1]), views)
    seen = files.observation("point"), files.observation("is_visible")
    if not all(run.has(name) for name in seen):
        return None
    return PointSet(run.array(seen[0]), run.array(seen[1]))


def _run_tracks(run: Run, files: SequenceFiles) -> Tracks | None:
    seen = files.observation("point"), files.observation("is_visible")
    if not all(run.has(name) for name in seen):
        return None
    point, is_visible = (run.array(name) for name in seen)
    nodes = files.observation("node_of_track")
    node = run.array(nodes) if run.has(nodes) else None
    return Tracks(point=point, is_visible=is_visible, node=node) if point.shape[1] else None


def _observation(sequence: Sequence) -> Observed | None:
    if sequence.marker is not None:
        is_seen = np.array(np.isfinite(sequence.marker).all(axis=-1))
        is_seen[:, list(sequence.controlled_markers)] = False  # Control points are drawn there.
        return PointSet(sequence.marker, is_seen)
    if any(view.has_depth for view in sequence.views):
        return DepthCloud(sequence.views)
    return None
