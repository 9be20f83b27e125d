"""A recorded interaction on disk: synchronised views, controls, markers and geometry."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.length_unit import (
    FARTHEST_POSITION,
    doubt_depth,
    doubt_extent,
    doubt_keypoints,
    doubt_position,
)
from physhandi.data.sequence_meta import FILE, SIDES, SequenceMeta, ShapeClass, Side, read_meta
from physhandi.data.sequence_meta import ViewMeta as ViewMeta
from physhandi.data.truth import TRUTH_FOLDER as TRUTH
from physhandi.data.truth import read_held_out_views
from physhandi.data.view import View
from physhandi.errors import SequenceError

_F, _I, _B = "floating-point", "integer", "boolean"
_KINDS: dict[str, Any] = {_F: np.floating, _I: np.integer, _B: np.bool_}
_Table = dict[str, tuple[tuple[str | int, ...], str, bool]]

# File: axes ("frame" is the sequence's), kind of number, whether NaN may stand for "not seen".
ARRAYS: _Table = {
    "control.npy": (("frame", "control", 3), _F, False),
    "held_point.npy": (("frame", 3), _F, False),
    "marker.npy": (("frame", "marker", 3), _F, True),
    "marker_node.npy": (("marker",), _I, False),
    "marker_motion_valid.npy": (("frame", "marker"), _B, False),
    "validation_track.npy": (("frame", "validation", 3), _F, True),
    "object_node.npy": (("node", 3), _F, False),
    "rest_node.npy": (("node", 3), _F, False),
    "mesh_vertex.npy": (("mesh vertex", 3), _F, False),
    "mesh_face.npy": (("mesh face", 3), _I, False),
    "mesh_color.npy": (("mesh vertex", 3), _I, False),
}
VIEW_ARRAYS: _Table = {
    "keypoint.npy": (("frame", "hand", 21, 3), _F, True),
    "track.npy": (("frame", "track", 2), _F, True),
    "track_visible.npy": (("frame", "track"), _B, False),
}

# Axes that must not be empty: without a node or a control there is nothing to simulate.
_NEEDED = {"control", "marker", "node"}
_MOST_BYTES = 2**32
TRUTH_ARRAYS: _Table = {
    **{f"hand_{side}_keypoint.npy": (("frame", 21, 3), _F, False) for side in SIDES},
    **{f"hand_{side}_vertex.npy": (("frame", f"{side} vertex", 3), _F, False) for side in SIDES},
    "contact_point.npy": (("point", 3), _F, False),
    "contact.npy": (("frame", "point"), _B, False),
    "object_point.npy": (("frame", "point", 3), _F, False),
    "object_face.npy": (("object face", 3), _I, False),
}


def check_layout(folder: Path, meta: SequenceMeta, views: tuple[View, ...]) -> None:
    """Check that the files fit to ``sequence.yaml`` and to each other, without decoding images.

    Raises:
        SequenceError: At the first thing that is wrong.
    """
    axes = {"frame": meta.frame_count, "hand": len(meta.hands)}
    _check_arrays(folder, folder, meta.name, ARRAYS, axes)
    _check_arrays(folder, folder / TRUTH, meta.name, TRUTH_ARRAYS, {"frame": meta.frame_count})
    for view in views:
        if not view.folder.is_dir():
            _fail(meta.name, f"views/{view.name}", f"is missing, but {FILE} lists it", "add it")
        # Each view has its own number of tracks.
        _check_arrays(folder, view.folder, meta.name, VIEW_ARRAYS, dict(axes))
        has_track = [(view.folder / f).is_file() for f in ("track.npy", "track_visible.npy")]
        if has_track[0] != has_track[1]:
            reason = "needs both track.npy and track_visible.npy"
            _fail(meta.name, f"views/{view.name}", reason, "add the other one")
        view.check_presence()
    for view in read_held_out_views(folder, meta.name, meta.frame_count):
        view.check_presence()
    _check_markers(folder, meta, axes)
    _check_mesh(folder, meta.name)


def value_checks(
    folder: Path, meta: SequenceMeta, views: tuple[View, ...], *, reads_color: bool = True
) -> Iterator[Callable[[], object]]:
    """Give checks that read every frame of every part, one after the other.

    Sizes, labels, finiteness and the unit of lengths are checked. Each raises a SequenceError at
    the first thing that is wrong in its file or frame; later ones can be called all the same.

    Args:
        folder: Folder of the sequence.
        meta: Its description.
        views: Its views.
        reads_color: Whether color images are decoded too, which takes longest.
    """
    name = meta.name
    for file in ARRAYS:
        yield partial(_check_finite, folder, folder / file, name)
    for file in TRUTH_ARRAYS:
        yield partial(_check_finite, folder, folder / TRUTH / file, name)
    yield partial(_check_motion, folder, name)
    if meta.metric:
        yield partial(_check_unit, folder, meta)
    for view in (*views, *read_held_out_views(folder, name, meta.frame_count)):
        for file in VIEW_ARRAYS:
            yield partial(_check_finite, folder, view.folder / file, name)
        yield partial(_check_tracks, view, name)
        yield partial(_check_keypoints, view, name)
        readers = ((view.has_color and reads_color, view.color), (view.has_mask, view.mask))
        for read in [read for is_there, read in readers if is_there]:
            for frame in range(view.frame_count):
                yield partial(read, frame)
        view.close()
        if view.has_depth:
            yield from _depth_checks(view, meta)


def _depth_checks(view: View, meta: SequenceMeta) -> Iterator[Callable[[], object]]:
    """Read every depth image, then judge the unit by what all of them hold."""
    largest: list[float] = []

    def read(frame: int) -> None:
        largest.append(float(view.depth(frame).max(initial=0.0)))

    def judge() -> None:
        doubt = doubt_depth(round(1e3 * max(largest, default=0.0)))
        if doubt is not None and meta.metric:
            _fail(meta.name, f"{view.place}/depth", *_told(doubt))

    for frame in range(view.frame_count):
        yield partial(read, frame)
    yield judge


def _check_unit(folder: Path, meta: SequenceMeta) -> None:
    """Refuse lengths that look like millimetres, or like thousandths of metres."""
    for view in meta.views:
        doubt = doubt_position(view.camera.T_world_camera[:3, 3])
        if doubt is not None:
            field = f"T_world_camera of view '{view.name}'"
            _fail(meta.name, FILE, *_told(doubt[1]), field=field)
    for file, (axes, kind, _) in ARRAYS.items():
        if kind != _F or not (folder / file).is_file():
            continue
        position = read_array(folder / file)
        doubt = doubt_position(position, FARTHEST_POSITION)
        if doubt is not None:
            at = ", ".join(f"{axis} {index}" for axis, index in zip(axes, doubt[0], strict=False))
            frame = doubt[0][0] if axes[0] == "frame" else None
            _fail(meta.name, file, *_told(doubt[1]), frame=frame, field=at)
        small = doubt_extent(position) if file in {"object_node.npy", "rest_node.npy"} else None
        if small is not None:
            _fail(meta.name, file, *_told(small))


def _check_arrays(
    root: Path, folder: Path, name: str, table: _Table, axis_size: dict[str, int]
) -> None:
    for file_name, (axes, kind, _) in table.items():
        path = folder / file_name
        if not path.is_file():
            continue
        file = path.relative_to(root).as_posix()
        try:
            array = read_array(path, mmap=True)
        except (ValueError, OSError) as error:
            _fail(name, file, f"is not a readable .npy file: {error}", "re-export it")
        text = "(" + ", ".join(str(axis) for axis in axes) + ")"
        if not np.issubdtype(array.dtype, _KINDS[kind]):
            _fail(name, file, f"holds {array.dtype}", f"expected {kind} numbers {text}")
        pairs = zip(axes, array.shape, strict=False)
        fixed = [isinstance(axis, str) or size == axis for axis, size in pairs]
        if array.ndim != len(axes) or not all(fixed):
            reason = f"has shape {array.shape}; expected axes {text}"
            _fail(name, file, reason, "re-export it")
        if array.nbytes > _MOST_BYTES:
            reason = f"has shape {array.shape}, {array.nbytes} bytes; {_MOST_BYTES} are the most"
            _fail(name, file, reason, "keep fewer points")
        for axis, size in zip(axes, array.shape, strict=True):
            if size == 0 and axis in _NEEDED:
                reason = f"has shape {array.shape}: no {axis} at all"
                _fail(name, file, reason, "remove or fill it")
            expected = axis_size.setdefault(axis, size) if isinstance(axis, str) else size
            if size != expected:
                _fail(
                    name,
                    file,
                    f"has shape {array.shape} for axes {text}; expected {axis} = {expected}, "
                    f"as {FILE} or another file says",
                    f"re-export it or correct {FILE}",
                )


def _check_markers(folder: Path, meta: SequenceMeta, axes: dict[str, int]) -> None:
    for file in ("rest_node.npy", "marker_node.npy"):
        if (folder / file).is_file() and not (folder / "object_node.npy").is_file():
            _fail(meta.name, file, "is about nodes, but object_node.npy is missing", "add it")
    for file in ("object_node.npy", "control.npy"):
        if (folder / "held_point.npy").is_file() and not (folder / file).is_file():
            reason = f"says how a rope is held, but {file} is missing"
            _fail(meta.name, "held_point.npy", reason, "add it, or remove this one")
    path = folder / "marker_node.npy"
    nodes = read_array(path) if path.is_file() else np.zeros(0, int)
    node_count = axes.get("node", 0)
    if nodes.size and not 0 <= nodes.min() <= nodes.max() < node_count:
        _fail(
            meta.name,
            "marker_node.npy",
            f"names nodes {nodes.min()} to {nodes.max()}, but object_node.npy has {node_count}",
            "number nodes from 0",
        )
    marker_count = axes.get("marker", 0)
    wrong = [marker for marker in meta.controlled_markers if marker >= marker_count]
    if wrong:
        reason = f"lists controlled_markers {wrong[0]}, but marker.npy has {marker_count} markers"
        _fail(meta.name, FILE, reason, "correct it", field="controlled_markers")
    if (meta.surface_node_count or 0) > node_count:
        reason = f"says surface_node_count {meta.surface_node_count}, but object_node.npy has "
        reason = f"{reason}{node_count} nodes"
        _fail(meta.name, FILE, reason, "correct it", field="surface_node_count")


def _check_mesh(folder: Path, name: str) -> None:
    """Check that a mesh of the object is whole, and names corners that it has."""
    is_there = {file: (folder / file).is_file() for file in ("mesh_vertex.npy", "mesh_face.npy")}
    for file, other in (("mesh_vertex.npy", "mesh_face.npy"), ("mesh_face.npy", "mesh_vertex.npy")):
        if is_there[file] and not is_there[other]:
            _fail(name, file, f"is half a mesh: {other} is missing", "add it, or remove this one")
    if (folder / "mesh_color.npy").is_file() and not is_there["mesh_vertex.npy"]:
        _fail(name, "mesh_color.npy", "colors no mesh: mesh_vertex.npy is missing", "remove it")
    if not is_there["mesh_face.npy"]:
        return
    corner = read_array(folder / "mesh_face.npy")
    count = len(read_array(folder / "mesh_vertex.npy", mmap=True))
    if not len(corner):
        _fail(name, "mesh_face.npy", "holds no triangle", "remove the mesh")
    if not 0 <= corner.min() <= corner.max() < count:
        reason = f"names corners {corner.min()} to {corner.max()}, but mesh_vertex.npy has {count}"
        _fail(name, "mesh_face.npy", reason, "number corners from 0")


def _check_finite(root: Path, path: Path, name: str) -> None:
    axes, kind, may_be_nan = (ARRAYS | VIEW_ARRAYS | TRUTH_ARRAYS)[path.name]
    if kind != _F or not path.is_file():
        return
    array = read_array(path)
    is_wrong: ndarray = np.isinf(array) if may_be_nan else ~np.isfinite(array)
    if is_wrong.any():
        place = tuple(int(index) for index in np.argwhere(is_wrong)[0])
        named = ("joint" if axis == 21 else axis for axis in axes)
        at = ", ".join(f"{axis} {index}" for axis, index in zip(named, place[:-1], strict=False))
        file = path.relative_to(root).as_posix()
        frame = place[0] if axes[0] == "frame" else None
        remedy = "repair or cut out these frames"
        _fail(name, file, f"is {array[place]} at {at}", remedy, frame=frame)


def _check_motion(folder: Path, name: str) -> None:
    """Check that a trusted motion joins two frames in which its marker was seen."""
    file = "marker_motion_valid.npy"
    if not (folder / file).is_file():
        return
    if not (folder / "marker.npy").is_file():
        reason = "says which motions of markers to trust, but there is no marker.npy"
        _fail(name, file, reason, "add it")
    is_valid = read_array(folder / file)
    marker = read_array(folder / "marker.npy")
    is_seen = np.asarray(np.isfinite(marker).all(axis=-1))
    can_be_valid = np.zeros_like(is_seen)
    can_be_valid[1:] = is_seen[1:] & is_seen[:-1]
    wrong = np.argwhere(is_valid & ~can_be_valid)
    if wrong.size:
        frame, marker = wrong[0]
        _fail(
            name,
            file,
            f"trusts the motion of marker {marker} to frame {frame} from the frame before, but "
            "marker.npy does not have both positions",
            "entry [t] must mean frame t-1 to t",
            frame=int(frame),
        )


def _check_tracks(view: View, name: str) -> None:
    if view.track is None or view.track_visible is None:
        return
    lost = np.argwhere(view.track_visible & np.isnan(view.track).any(-1))
    if lost.size:
        frame, track = lost[0]
        _fail(
            name,
            f"{view.place}/track.npy",
            f"is NaN at frame {frame}, track {track}, which track_visible.npy calls visible",
            "mark it as not visible",
            frame=int(frame),
        )


def _check_keypoints(view: View, name: str) -> None:
    if view.keypoint is None:
        return
    doubt = doubt_keypoints(view.keypoint, view.camera.width, view.camera.height)
    if doubt is not None:
        frame, hand, joint = doubt[0]
        field = f"frame {frame}, hand {hand}, joint {joint}"
        _fail(name, f"{view.place}/keypoint.npy", *_told(doubt[1]), frame=frame, field=field)


def _told(doubt: str) -> tuple[str, str]:
    """Split what is said of a unit into what is wrong and what to do about it."""
    reason, _, remedy = doubt.partition("; ")
    return reason, remedy


def _fail(
    name: str, file: str, reason: str, remedy: str, *, frame: int | None = None, field: str = ""
) -> NoReturn:
    where = f"{file}: {field}" if field else file
    raise SequenceError(
        f"Sequence '{name}': {where} {reason}; {remedy}.",
        file=file,
        frame=frame,
        field=field,
        remedy=remedy,
    )


_VIEW_PARTS = ("color", "depth", "mask", "keypoint", "track")


class Sequence:
    """One recorded interaction; every part but ``sequence.yaml`` may be absent.

    The world is z-up and gravity points along -z. Use `Sequence.load`.
    """

    def __init__(self, folder: Path, meta: SequenceMeta) -> None:
        self.folder = folder
        self.meta = meta
        self.views: tuple[View, ...] = tuple(
            View(folder / "views" / view.name, meta.name, view.camera, meta.frame_count)
            for view in meta.views
        )

    def __repr__(self) -> str:
        return f"Sequence({str(self.folder)!r})"

    @classmethod
    def load(cls, folder: Path | str) -> "Sequence":
        """Open a sequence and check its description, its files and their shapes.

        Args:
            folder: Folder that holds ``sequence.yaml``.

        Raises:
            SequenceError: If something is wrong; names sequence, file and field.
        """
        path = Path(folder).resolve()
        sequence = cls(path, read_meta(path))
        check_layout(path, sequence.meta, sequence.views)
        return sequence

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self.meta.name

    @property
    def description(self) -> str:
        """Description of the recorded scene."""
        return self.meta.description

    @property
    def label(self) -> str:
        """Free label of the user."""
        return self.meta.label

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.meta.frame_count

    @property
    def frame_rate(self) -> float:
        """Frames per second [Hz]."""
        return self.meta.frame_rate

    @property
    def metric(self) -> bool:
        """Whether lengths are metres."""
        return self.meta.metric

    @property
    def length_unit(self) -> str:
        """Name of the unit of all lengths."""
        return self.meta.length_unit

    @property
    def ground_height(self) -> float | None:
        """Height of the table or floor above z = 0 [m]; None if there is none."""
        return self.meta.ground_height

    @property
    def gravity(self) -> float:
        """Gravitational acceleration along -z [m/s²]."""
        return self.meta.gravity

    @property
    def hands(self) -> tuple[Side, ...]:
        """Hands that take part, in the order of the keypoints' hand axis."""
        return self.meta.hands

    @property
    def controlled_markers(self) -> tuple[int, ...]:
        """Markers that are fixed to a control, so that metrics do not score them."""
        return self.meta.controlled_markers

    @property
    def surface_node_count(self) -> int | None:
        """Number of leading object nodes that lie on the surface; None if that is not known."""
        return self.meta.surface_node_count

    @property
    def shape(self) -> ShapeClass | None:
        """Kind of object; None if that is to be found from what the first frame shows."""
        return self.meta.shape

    @property
    def mass(self) -> float | None:
        """Mass of the object [kg]; None if nobody weighed it."""
        return self.meta.mass

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Provenance of the recording."""
        return self.meta.provenance

    @property
    def reconstruction_frames(self) -> range:
        """Frames that are fitted."""
        return range(self.meta.reconstruction_count)

    @property
    def future_frames(self) -> range:
        """Frames that are held out for scoring the prediction."""
        return range(self.meta.reconstruction_count, self.frame_count)

    @property
    def depth_views(self) -> list[View]:
        """Views that tell where surfaces are and whose: those with depth and masks."""
        return [view for view in self.views if view.has_depth and view.has_mask]

    @cached_property
    def held_out_views(self) -> tuple[View, ...]:
        """Views for scoring only, from ``truth/views/``; no stage of a fit reads them."""
        return read_held_out_views(self.folder, self.name, self.frame_count)

    @cached_property
    def control(self) -> Float[ndarray, "frame control 3"] | None:
        """Point controllers that take the place of hands [m]."""
        return self._array("control.npy", np.float32)

    @cached_property
    def held_point(self) -> Float[ndarray, "frame 3"] | None:
        """Point beside a rope's first node that turns with what holds the rope there [m].

        It says how a rope is twisted about itself, which points along it leave open. The object
        nodes are in their order along the rope then.
        """
        return self._array("held_point.npy", np.float32)

    @cached_property
    def marker(self) -> Float[ndarray, "frame marker 3"] | None:
        """Identified observed points [m]; NaN where not seen."""
        return self._array("marker.npy", np.float32)

    @cached_property
    def marker_node(self) -> Int[ndarray, " marker"] | None:
        """Object node that each marker observes."""
        return self._array("marker_node.npy", np.int32)

    @cached_property
    def marker_motion_valid(self) -> Bool[ndarray, "frame marker"] | None:
        """Whether the motion of each marker from the frame before can be trusted."""
        return self._array("marker_motion_valid.npy", np.bool_)

    @cached_property
    def validation_track(self) -> Float[ndarray, "frame validation 3"] | None:
        """Annotated points that no stage may fit, for scoring [m]; NaN where not annotated."""
        return self._array("validation_track.npy", np.float32)

    @cached_property
    def object_node(self) -> Float[ndarray, "node 3"] | None:
        """Given object nodes of frame 0 [m]."""
        return self._array("object_node.npy", np.float32)

    @cached_property
    def rest_node(self) -> Float[ndarray, "node 3"] | None:
        """The same nodes in the shape without tension [m]."""
        return self._array("rest_node.npy", np.float32)

    @cached_property
    def mesh(self) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]] | None:
        """Whole surface of the object in frame 0: corners [m], and triangles seen from outside."""
        vertex = self._array("mesh_vertex.npy", np.float32)
        return None if vertex is None else (vertex, self._array("mesh_face.npy", np.int32))

    @cached_property
    def mesh_color(self) -> UInt8[ndarray, "vertex 3"] | None:
        """Color of each corner of the mesh."""
        return self._array("mesh_color.npy", np.uint8)

    def missing(self, *parts: str) -> list[str]:
        """Tell which of the named parts the sequence lacks.

        Args:
            parts: Of ``views hands color depth mask keypoint track control held_point marker
                marker_node marker_motion_valid validation_track object_node rest_node``. A part
                of views counts as there if one view has it. ``object`` stands for what an object
                can be observed by (markers, or depth with masks) and moved by (hands or control).

        Returns:
            The parts that are not there, in the order asked for.
        """
        wanted: list[str] = []
        for part in parts:
            wanted.extend(self._object_parts() if part == "object" else [part])
        return [part for part in dict.fromkeys(wanted) if not self._has(part)]

    def validate(self, *, reads_color: bool = True) -> None:
        """Read every frame of every part and check its values.

        Args:
            reads_color: Whether color images are decoded too, which takes longest.

        Raises:
            SequenceError: At the first thing that is wrong; names file, frame and remedy.
        """
        for check in self.checks(reads_color=reads_color):
            check()

    def checks(self, *, reads_color: bool = True) -> Iterator[Callable[[], object]]:
        """Give what `validate` does as single checks, so that one can go on after a failed one.

        Args:
            reads_color: Whether color images are decoded too, which takes longest.
        """
        return value_checks(self.folder, self.meta, self.views, reads_color=reads_color)

    def fingerprint(self) -> str:
        """Compute a SHA-256 over all names and sizes, and the content of YAML and arrays."""
        return self._fingerprint

    def content_fingerprint(self) -> str:
        """Compute a SHA-256 over what was recorded, whatever the sequence is called.

        It covers what `fingerprint` covers, but of ``sequence.yaml`` only what describes the
        recording: not name, description, label, provenance, split, shape and mass.
        """
        return self._content_fingerprint

    @cached_property
    def _fingerprint(self) -> str:
        return self._digest(leaves_out=frozenset())

    @cached_property
    def _content_fingerprint(self) -> str:
        fields = self.meta.to_dict()
        for name in ("name", "description", "label", "provenance", "split", "shape", "mass"):
            fields.pop(name, None)
        text = json.dumps(fields, sort_keys=True) + self._digest(leaves_out=frozenset({FILE}))
        return hashlib.sha256(text.encode()).hexdigest()

    def _digest(self, *, leaves_out: frozenset[str]) -> str:
        digest = hashlib.sha256()
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder).as_posix()
            if not path.is_file() or any(part.startswith(".") for part in name.split("/")):
                continue
            if name in leaves_out:
                continue
            digest.update(f"{name}\0{path.stat().st_size}\0".encode())
            if path.suffix in {".npy", ".yaml"}:
                with path.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
        return digest.hexdigest()

    def _object_parts(self) -> list[str]:
        seen = ["marker"] if self._has("marker") else ["depth", "mask"]
        return [*seen, "hands" if self.hands else "control"]

    def _has(self, part: str) -> bool:
        if part in {"views", "hands"}:
            return bool(getattr(self, part))
        if part in {"color", "depth", "mask"}:
            return any(getattr(view, f"has_{part}") for view in self.views)
        if part in _VIEW_PARTS:
            return any((view.folder / f"{part}.npy").is_file() for view in self.views)
        if f"{part}.npy" not in ARRAYS:
            raise ValueError(f"{part!r} is not a part of a sequence")
        return (self.folder / f"{part}.npy").is_file()

    def _array(self, file: str, kind: Any) -> Any:
        path = self.folder / file
        return read_array(path).astype(kind, copy=False) if path.is_file() else None
