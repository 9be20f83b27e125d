"""Edits of single springs and nodes: plain records that turn one spring-mass model into another.

A record names springs by the nodes that they join and nodes by their numbers, so that it means the
same whatever the radii and neighbor limits: it is applied after the topology has been built. A
spring that the present topology does not have is passed over.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from numpy import ndarray

from physhandi.errors import UsageError
from physhandi.settings import Finite
from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.typed import decode_json, to_typed

MOST_EDITS = 1000
"""Edits that an object may have."""
PIN_SHARE = 0.1
"""Least rest length of a spring that holds a node, as a part of the median of object springs."""
BARE_LENGTH = 0.01
"""What counts as that median of an object without springs [m]."""

_Number = Annotated[int, Meta(ge=0, le=2**31 - 1)]
"""Number of a node."""
NodePair = tuple[_Number, _Number]
"""Two numbers: of two object nodes, or of an object node and a control node counted from 0."""
_Place = tuple[Finite, Finite, Finite]
"""A point in the world [m]."""


class Edit(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """One step of editing."""

    @property
    def title(self) -> str:
        """Title in a list of steps: ``Cut 12 springs``."""
        raise NotImplementedError

    @property
    def is_of_recording(self) -> bool:
        """Whether it makes sense in the recording alone in which it was made.

        Places, frames and control nodes are those of one recording.
        """
        return False


class EditOfSprings(Edit, frozen=True, kw_only=True):
    """An edit of springs, in all frames."""

    springs: tuple[NodePair, ...] = ()
    """Pairs of object nodes whose springs it is about."""
    virtual: tuple[NodePair, ...] = ()
    """Pairs of an object node and a control node whose virtual springs it is about."""

    @property
    def is_of_recording(self) -> bool:
        """Whether it names control nodes."""
        return bool(self.virtual)

    @property
    def count_text(self) -> str:
        """Number of its springs, in words."""
        return _counted(len(self.springs) + len(self.virtual), "spring")


class ScaleMaterial(EditOfSprings, frozen=True, kw_only=True, tag="scale"):
    """Makes springs stiffer or softer, or damps them more or less."""

    quantity: Literal["stiffness", "damping"]
    """Quantity that is multiplied."""
    factor: Annotated[float, Meta(ge=1e-6, le=1e6)]
    """By how much."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return f"{self.quantity.capitalize()} ×{self.factor:.3g} of {self.count_text}"


class Cut(EditOfSprings, frozen=True, kw_only=True, tag="cut"):
    """Takes springs away."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return f"Cut {self.count_text}"


class Join(Edit, frozen=True, kw_only=True, tag="join"):
    """Joins object nodes by springs, in all frames; what is joined already stays as it is.

    They are as long at rest as the nodes are apart in the rest shape.
    """

    springs: tuple[NodePair, ...]
    """Pairs of object nodes."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return f"Join {_counted(len(self.springs), 'pair')} of nodes"


class EditOfNodes(Edit, frozen=True, kw_only=True):
    """An edit of what holds nodes, from a frame on."""

    nodes: tuple[_Number, ...]
    """Object nodes."""
    frame: Annotated[int, Meta(ge=0, le=NEVER - 1)] = 0
    """The last frame before it counts; with 0 it always does."""

    @property
    def is_of_recording(self) -> bool:
        """Whether it makes sense in one recording alone: it does."""
        return True

    def said(self, before: str, after: str = "") -> str:
        """Say what is done to how many nodes, and since when."""
        since = f" from frame {self.frame} on" if self.frame else ""
        return f"{before} {_counted(len(self.nodes), 'node')}{after}{since}"


class Pin(EditOfNodes, frozen=True, kw_only=True, tag="pin"):
    """Holds nodes at places, each by a spring to a control node that never moves.

    The control node is above the place by the spring's rest length, so that nothing pulls a node
    that is there; one that is pulled moves around it, never much farther than twice that length.
    """

    places: tuple[_Place, ...]
    """Where each node is held [m]."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return self.said("Pin")


class Attach(EditOfNodes, frozen=True, kw_only=True, tag="attach"):
    """Ties nodes to control nodes of the hands; what is tied already stays as it is."""

    controls: tuple[_Number, ...]
    """Control node of each node."""
    lengths: tuple[Annotated[float, Meta(ge=0.0, le=1e6)], ...]
    """How far each node is from its control node when this begins to count [m]."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return self.said("Attach", " to the hand")


class Release(EditOfNodes, frozen=True, kw_only=True, tag="release"):
    """Lets nodes go: nothing holds them any more, neither a hand nor a pin."""

    @property
    def title(self) -> str:
        """Title in a list of steps."""
        return self.said("Release")


AnyEdit = ScaleMaterial | Cut | Join | Pin | Attach | Release
Edits = tuple[AnyEdit, ...]
"""Edits in the order in which they are applied."""
_CHECKED: Any = Annotated[Edits, Meta(max_length=MOST_EDITS)]


def apply_edits(
    model: SpringMassModel,
    edits: Edits,
    parameters: SimulationParameters,
    rest_node: Float[ndarray, "node 3"] | None = None,
) -> SpringMassModel:
    """Apply edits to a model, one after the other.

    Args:
        model: The model without them; not modified.
        edits: What is to be done; a spring that the model does not have is passed over.
        parameters: For the stiffness, damping and least length of springs that are added.
        rest_node: The object's rest shape [m]; its nodes at frame 0 if left out.

    Returns:
        The edited model; the same object if there are no edits.

    Raises:
        UsageError: If an edit names a node that there is not, or cannot be made; says which.
    """
    rest = np.asarray(model.object_node if rest_node is None else rest_node, np.float64)
    for number, edit in enumerate(edits, start=1):
        try:
            model = _applied(model, edit, parameters, rest)
        except UsageError as error:
            raise UsageError(f"Edit {number} ({edit.title}): {error}") from None
    return model


def keeps_what_is_joined(edits: Edits) -> bool:
    """Tell whether edits change nothing but stiffness and damping.

    An object of which something was cut, joined, pinned, tied or let go is not the one that was
    seen: it does not restart from the observed state.
    """
    return all(isinstance(edit, ScaleMaterial) for edit in edits)


def checked_edits(edits: Sequence[Edit]) -> Edits:
    """Check edits that a script has made, and turn their lists into tuples.

    Raises:
        UsageError: If a value is of the wrong kind or out of bounds; says where.
    """
    try:
        return to_typed(msgspec.to_builtins(list(edits)), _CHECKED)
    except (msgspec.ValidationError, TypeError, ValueError) as error:
        raise UsageError(f"These are no edits: {error}.") from None


def encode_edits(edits: Edits) -> bytes:
    """Write edits as JSON; see `decode_edits`."""
    return msgspec.json.encode(edits)


def decode_edits(content: bytes, where: str) -> Edits:
    """Read edits from JSON.

    Args:
        content: What `encode_edits` has written, or somebody else.
        where: What it was read from, for the error.

    Raises:
        UsageError: If something in it is wrong; names the place in it.
    """
    try:
        return decode_json(content, _CHECKED)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        kinds = ", ".join(str(kind.__struct_config__.tag) for kind in get_args(AnyEdit))
        raise UsageError(
            f"{where} holds no edits: {error}. Expected a list of objects whose kind is one of "
            f"{kinds} (docs/formats.md)."
        ) from None


def _applied(
    model: SpringMassModel,
    edit: AnyEdit,
    parameters: SimulationParameters,
    rest_node: Float[ndarray, "node 3"],
) -> SpringMassModel:
    if model.rod is not None and isinstance(edit, Cut | Join | Release):
        raise UsageError(
            "this rope bends as one rod that a gripper holds, so it cannot be cut, joined or let "
            "go. Change its stiffness or damping, pin it, or attach it."
        )
    match edit:
        case ScaleMaterial():
            return _scaled(model, edit)
        case Cut():
            return _without(model, _named(model, edit))
        case Join():
            return _joined(model, edit, parameters, rest_node)
        case Pin():
            return _pinned(model, edit, parameters)
        case Attach():
            return _attached(model, edit, parameters)
        case Release():
            return _released(model, edit)


def _scaled(model: SpringMassModel, edit: ScaleMaterial) -> SpringMassModel:
    factor = np.where(_named(model, edit), edit.factor, 1.0)
    value = np.asarray(getattr(model, edit.quantity), np.float64)
    scaled: dict[str, Any] = {edit.quantity: (factor * value).astype(np.float32)}
    return replace(model, **scaled)


def _joined(
    model: SpringMassModel,
    edit: Join,
    parameters: SimulationParameters,
    rest_node: Float[ndarray, "node 3"],
) -> SpringMassModel:
    pair = np.unique(np.sort(_pairs(edit.springs), axis=1), axis=0)
    _check(pair, model.node_count, "object node")
    pair = pair[~np.isin(_keys(model, pair), _keys(model, model.spring_nodes))]
    length = np.linalg.norm(rest_node[pair[:, 1]] - rest_node[pair[:, 0]], axis=1)
    if np.any(length <= 0.0):
        at = pair[int(np.argmin(length))]
        raise UsageError(
            f"nodes {at[0]} and {at[1]} are at one place, so no spring can join them. Leave this "
            "pair out."
        )
    stiffness = parameters.stiffness
    return _with_springs(
        model,
        model.object_spring_count,
        {
            "spring_nodes": pair,
            "rest_length": np.maximum(length, parameters.rest_length_floor),
            "stiffness": np.full(len(pair), stiffness),
            "damping": np.full(len(pair), _damping(parameters, stiffness)),
        },
    )


def _pinned(model: SpringMassModel, edit: Pin, parameters: SimulationParameters) -> SpringMassModel:
    node = _nodes(model, edit, edit.places)
    length = _shortest(model, parameters)
    pin = np.array(edit.places, np.float64).reshape(-1, 3)
    pin[:, 2] += length
    control = model.control_count + np.arange(len(node))
    held = replace(
        model,
        control_count=model.control_count + len(node),
        pin_place=np.concatenate([model.pin_place, pin.astype(np.float32)]),
    )
    return _tied(held, (node, control, np.full(len(node), length)), edit.frame, parameters)


def _attached(
    model: SpringMassModel, edit: Attach, parameters: SimulationParameters
) -> SpringMassModel:
    node = _nodes(model, edit, edit.controls, edit.lengths)
    control = np.array(edit.controls, np.int64).reshape(-1)
    _check(control, model.control_count - model.pin_count, "control node that moves")
    acts = (model.attached[:, 0] <= edit.frame) & (model.attached[:, 1] > edit.frame)
    tied = _keys(model, model.spring_nodes[model.object_spring_count :][acts])
    pair = np.stack([node, control + model.node_count], axis=1)
    new = ~np.isin(_keys(model, pair), tied)
    length = np.array(edit.lengths, np.float64).reshape(-1)
    return _tied(model, (node[new], control[new], length[new]), edit.frame, parameters)


def _released(model: SpringMassModel, edit: Release) -> SpringMassModel:
    own = model.object_spring_count
    is_let_go = np.isin(model.spring_nodes[own:].min(axis=1), _nodes(model, edit))
    attached = model.attached.copy()
    attached[is_let_go, 1] = np.minimum(attached[is_let_go, 1], edit.frame)
    # What would be attached later, or in no frame at all, is left out.
    never = np.zeros(len(model.spring_nodes), dtype=bool)
    never[own:] = attached[:, 0] >= attached[:, 1]
    return _without(replace(model, attached=attached), never)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _pairs(pairs: Sequence[NodePair]) -> Int[ndarray, "pair 2"]:
    return np.array(pairs, np.int64).reshape(-1, 2)


def _keys(model: SpringMassModel, pair: Int[ndarray, "pair 2"]) -> Int[ndarray, " pair"]:
    """Give one number for each unordered pair of nodes."""
    ends = np.sort(np.asarray(pair, np.int64), axis=1)
    return ends[:, 0] * (model.node_count + model.control_count) + ends[:, 1]


def _check(number: Int[ndarray, "..."], count: int, what: str) -> None:
    """Refuse numbers that nothing has."""
    largest = int(number.max(initial=-1))
    if largest >= count:
        has = f"numbers 0 to {count - 1}" if count else "none"
        raise UsageError(f"there is no {what} {largest}; the object has {has}.")


def _named(model: SpringMassModel, edit: EditOfSprings) -> Bool[ndarray, " spring"]:
    """Mark the springs that an edit names."""
    own, virtual = _pairs(edit.springs), _pairs(edit.virtual)
    _check(own, model.node_count, "object node")
    _check(virtual[:, 0], model.node_count, "object node")
    _check(virtual[:, 1], model.control_count, "control node")
    virtual[:, 1] += model.node_count
    named = _keys(model, np.concatenate([own, virtual]))
    return np.isin(_keys(model, model.spring_nodes), named)


def _nodes(
    model: SpringMassModel, edit: EditOfNodes, *beside: Sequence[object]
) -> Int[ndarray, " chosen"]:
    """Give an edit's nodes as an array, once each has one of whatever there is beside it."""
    node = np.array(edit.nodes, np.int64).reshape(-1)
    if any(len(values) != len(node) for values in beside) or len(np.unique(node)) < len(node):
        raise UsageError(
            f"expected different nodes, and one value for each of the {len(node)} in every other "
            "list."
        )
    _check(node, model.node_count, "object node")
    return node


def _damping(parameters: SimulationParameters, stiffness: float) -> float:
    """Give the damping of a new spring; one without stiffness is off, its dashpot included."""
    return parameters.damping if stiffness > 0.0 else 0.0


def _shortest(model: SpringMassModel, parameters: SimulationParameters) -> float:
    """Give the least rest length of a spring that holds a node [m]: shorter ones are too stiff."""
    own = model.rest_length[: model.object_spring_count]
    usual = float(np.median(own)) if len(own) else BARE_LENGTH
    return max(parameters.virtual_rest_length_floor, PIN_SHARE * usual)


def _tied(
    model: SpringMassModel,
    ties: tuple[ndarray, ndarray, ndarray],
    frame: int,
    parameters: SimulationParameters,
) -> SpringMassModel:
    """Add virtual springs that act from a frame on.

    Args:
        model: What they are added to.
        ties: Object node, control node and distance [m] of each.
        frame: The last frame before.
        parameters: For their stiffness and damping.
    """
    node, control, length = ties
    count, stiffness = len(node), parameters.virtual_stiffness
    return _with_springs(
        model,
        len(model.spring_nodes),
        {
            "spring_nodes": np.stack([node, control + model.node_count], axis=1),
            "rest_length": np.maximum(length, _shortest(model, parameters)),
            "stiffness": np.full(count, stiffness),
            "damping": np.full(count, _damping(parameters, stiffness)),
            "attached": np.tile([[frame, NEVER]], (count, 1)),
        },
    )


def _with_springs(model: SpringMassModel, place: int, new: dict[str, ndarray]) -> SpringMassModel:
    """Put springs into the list of a model; virtual ones, at its end, have the field `attached`."""
    merged: dict[str, Any] = {}
    for name, values in new.items():
        old: ndarray = getattr(model, name)
        at = len(old) if name == "attached" else place
        merged[name] = np.concatenate([old[:at], values.astype(old.dtype), old[at:]])
    own = 0 if "attached" in new else len(new["spring_nodes"])
    return replace(model, **merged, object_spring_count=model.object_spring_count + own)


def _without(model: SpringMassModel, removed: Bool[ndarray, " spring"]) -> SpringMassModel:
    """Leave springs out."""
    stays, own = ~removed, model.object_spring_count
    return replace(
        model,
        spring_nodes=model.spring_nodes[stays],
        rest_length=model.rest_length[stays],
        stiffness=model.stiffness[stays],
        damping=model.damping[stays],
        attached=model.attached[stays[own:]],
        object_spring_count=int(stays[:own].sum()),
    )
