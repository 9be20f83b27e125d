"""The truth of SynthHDI: bodies of finite elements that hands of capsules move, by MuJoCo.

Nothing is shared with the project's own simulator: other material laws, other contact, other time
stepping. MuJoCo runs in one thread, so the same input gives the same bits on the same machine.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from physhandi.data.sequence_meta import Side
from physhandi.errors import SimulationDivergedError, UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.bodies.bodies import Body
from physhandi.synthetic.engines.flex_scene import FlexParameters, list_bones, write_scene
from physhandi.synthetic.engines.truth import (
    FRAME_RATE,
    CapsuleHand,
    Hold,
    MovingHand,
    PhysicalTruth,
)

_SPEED_LIMIT = 20.0
_TARGETS_PER_FRAME = 4
_LEAST_WEIGHT = 0.2
_TOUCH = 0.0005
_FRAMES_TO_STICK = 3


def simulate_truth(
    body: Body,
    scripts: Sequence[MovingHand],
    hands: Mapping[Side, CapsuleHand],
    *,
    frame_count: int,
    hold: Hold = "friction",
    progress: Progress | None = None,
    parameters: FlexParameters | None = None,
) -> PhysicalTruth:
    """Simulate a body moved by hands.

    Args:
        body: What lies on the ground.
        scripts: How each hand moves.
        hands: Shape of each hand that a script moves.
        frame_count: Frames to simulate, 30 a second.
        hold: By friction alone; or what a hand has touched for 0.1 s sticks to it from then on.
        progress: Told after every frame; may ask to stop.
        parameters: Time, friction and firmness.

    Returns:
        Places of the nodes, and which of them a hand touches, in every frame.

    Raises:
        UsageError: If there are no frames, or a script moves a hand that is not there.
        SimulationDivergedError: If a node leaves the range of sane motion.
        CancelledError: If the user asked to stop.
    """
    if frame_count < 1:
        raise UsageError(f"A simulation needs 1 frame or more, not {frame_count}.")
    for script in scripts:
        if script.side not in hands:
            raise UsageError(f"A script moves the {script.side} hand, but there is no such hand.")
    progress = progress or NullProgress()
    parameters = parameters or FlexParameters()
    used: dict[Side, CapsuleHand] = {s.side: hands[s.side] for s in scripts}
    world = _World(body, scripts, used, parameters)
    position = np.empty((frame_count, body.node_count, 3), dtype=np.float32)
    contact = np.empty((frame_count, body.node_count), dtype=bool)
    moved: dict[Side, list[ndarray]] = {side: [] for side in used}
    for frame, touched in enumerate(world.frames(frame_count)):
        progress.check_cancelled()
        if hold == "attachment":
            world.attach_what_was_touched()
        position[frame] = world.node
        contact[frame] = touched | world.is_attached
        for side, transform in world.bone_transforms(frame / FRAME_RATE).items():
            moved[side].append(transform)
        progress.report("simulate", frame + 1, frame_count, message=body.name)
    return PhysicalTruth(
        body=body,
        position=position,
        contact=contact,
        hold=hold,
        hands={side: np.stack(transforms) for side, transforms in moved.items()},
    )


class _World:
    """A running MuJoCo simulation."""

    def __init__(
        self,
        body: Body,
        scripts: Sequence[MovingHand],
        hands: Mapping[Side, CapsuleHand],
        parameters: FlexParameters,
    ) -> None:
        mujoco = self._mujoco = import_module("mujoco")
        self._body = body
        self._scripts = scripts
        self._hands = hands
        self._parameters = parameters
        self._bones = list_bones(hands)
        scene = write_scene(body, hands, parameters, FRAME_RATE)
        self._model = mujoco.MjModel.from_xml_string(scene)
        _vary_stiffness(self._model, body)
        self._data = mujoco.MjData(self._model)
        names = [bone.name for bone in self._bones]
        self._bone_body = np.array([self._model.body(name).id for name in names], dtype=np.int64)
        self._target = np.array(
            [self._model.body(f"{name}_target").mocapid[0] for name in names], dtype=np.int64
        )
        self._is_hand = np.isin(self._model.geom_bodyid, self._bone_body)
        self._touched_frames = np.zeros(body.node_count, dtype=np.int64)
        self._touching_bone = np.zeros(body.node_count, dtype=np.int64)
        self.is_attached = np.zeros(body.node_count, dtype=bool)
        """Whether the node is attached to a hand."""

    @property
    def node(self) -> Float[ndarray, "node 3"]:
        """Current positions of the nodes [m]."""
        return self._data.xpos[self._model.flex_vertbodyid]

    def frames(self, frame_count: int) -> Iterator[ndarray]:
        """Settle, let the hands begin, then go from frame to frame; give what they touch in each.

        A node is touched if it is in at least half of the steps that led to the frame.
        """
        before = self._parameters.settling_time - min((s.begin for s in self._scripts), default=0.0)
        lead = max(round(before * FRAME_RATE), 1)
        self._put_hands(self._targets(-lead / FRAME_RATE))
        for frame in range(-lead, frame_count - 1):
            touched = self._advance(frame)
            if frame + 1 >= 0:
                yield touched

    def bone_transforms(self, time: float) -> dict[Side, Float[ndarray, "bone 4 4"]]:
        """Compute the transforms from the resting hand to each bone's current pose.

        Args:
            time: Now [s]; bones without capsules are where the script has them at this time.
        """
        transforms: dict[Side, ndarray] = {
            script.side: np.array(self._hands[script.side].bone_transforms(script.at(time)))
            for script in self._scripts
        }
        for bone, number in zip(self._bones, self._bone_body, strict=True):
            turn = self._data.xmat[number].reshape(3, 3)
            transform = transforms[bone.side][bone.index]
            transform[:3, :3] = turn
            transform[:3, 3] = self._data.xpos[number] - turn @ bone.center
        return transforms

    def attach_what_was_touched(self) -> None:
        """Attach surface nodes to a bone that has touched them for some frames."""
        ready = (self._touched_frames >= _FRAMES_TO_STICK) & ~self.is_attached
        for node in np.flatnonzero(ready[: self._body.surface_node_count]):
            bone = self._bone_body[self._touching_bone[node]]
            turn = self._data.xmat[bone].reshape(3, 3)
            self._model.eq_obj1id[node] = bone
            self._model.eq_data[node, :3] = turn.T @ (self.node[node] - self._data.xpos[bone])
            self._model.eq_data[node, 3:6] = 0.0
            self._data.eq_active[node] = 1
            self.is_attached[node] = True

    def _advance(self, frame: int) -> ndarray:
        """Simulate from a frame to the next one."""
        substeps = self._parameters.substeps_per_frame
        count = np.zeros(self._body.node_count, dtype=np.int64)
        times = (frame + np.arange(_TARGETS_PER_FRAME + 1) / _TARGETS_PER_FRAME) / FRAME_RATE
        targets = [self._targets(float(time)) for time in times]
        ways = [self._way(before, after) for before, after in pairwise(targets)]
        for step in range(substeps):
            part = (step + 1) / substeps * _TARGETS_PER_FRAME
            first = min(int(part), _TARGETS_PER_FRAME - 1)
            self._move_targets(targets[first], ways[first], part - first)
            self._mujoco.mj_step(self._model, self._data)
            self._check(frame + 1, step)
            node, bone = self._touches()
            count[np.unique(node)] += 1
            self._touching_bone[node] = bone
        # A step leaves behind where everything was at its begin.
        self._mujoco.mj_kinematics(self._model, self._data)
        touched = 2 * count >= substeps
        self._touched_frames = np.where(touched, self._touched_frames + 1, 0)
        return touched

    def _targets(self, time: float) -> tuple[Float[ndarray, "bone 3"], Rotation]:
        """Compute targets that bring the bones to their prescribed poses at a time.

        A weld damps all motion and knows no speed of its target, so bones trail behind.
        """
        time += 2 * self._parameters.weld_time
        transform: dict[Side, ndarray] = {}
        for script in self._scripts:
            hand = self._hands[script.side]
            transform[script.side] = hand.bone_transforms(script.at(time))
        each = [transform[bone.side][bone.index] for bone in self._bones]
        if not each:
            return np.zeros((0, 3)), Rotation.identity(0)
        place = [m[:3, :3] @ b.center + m[:3, 3] for m, b in zip(each, self._bones, strict=True)]
        return np.array(place), Rotation.from_matrix(np.array([m[:3, :3] for m in each]))

    def _way(self, before: Any, after: Any) -> tuple[Float[ndarray, "bone 3"], ndarray]:
        """Tell where targets go next, and the rotation vectors of how they turn on the way."""
        if not self._bones:
            return after[0], np.zeros((0, 3))
        return after[0], (after[1] * before[1].inv()).as_rotvec()

    def _move_targets(self, before: Any, way: tuple[ndarray, ndarray], part: float) -> None:
        """Interpolate the targets on their way."""
        if not self._bones:
            return
        place, turn = way
        self._data.mocap_pos[self._target] = (1 - part) * before[0] + part * place
        rotation = Rotation.from_rotvec(part * turn) * before[1]
        self._data.mocap_quat[self._target] = rotation.as_quat(scalar_first=True)

    def _put_hands(self, targets: tuple[Float[ndarray, "bone 3"], Rotation]) -> None:
        """Set the bones to their targets."""
        self._move_targets(targets, self._way(targets, targets), 0.0)
        for bone, target in zip(self._bone_body, self._target, strict=True):
            start = self._model.jnt_qposadr[self._model.body_jntadr[bone]]
            self._data.qpos[start : start + 3] = self._data.mocap_pos[target]
            self._data.qpos[start + 3 : start + 7] = self._data.mocap_quat[target]

    def _touches(self) -> tuple[Int[ndarray, " touch"], Int[ndarray, " touch"]]:
        """Find the nodes that carry a contact with a hand, and the bone that touches each."""
        contact = self._data.contact
        geom = contact.geom.max(axis=1, initial=-1)
        flex = contact.flex.max(axis=1, initial=-1)
        mine = (geom >= 0) & (flex >= 0) & (contact.dist < _TOUCH)
        mine[mine] &= self._is_hand[geom[mine]]
        index = np.flatnonzero(mine)
        if not len(index):
            return index, index
        place = np.searchsorted(self._bone_body, self._model.geom_bodyid[geom[index]])
        vertex, element = contact.vert[index].max(axis=1), contact.elem[index].max(axis=1)
        is_vertex = vertex >= 0
        corner = self._body_elements[element[~is_vertex]]
        weight = _weights(self._data.flexvert_xpos[corner], contact.pos[index[~is_vertex]])
        row, column = np.nonzero(weight >= _LEAST_WEIGHT)
        node = np.concatenate([vertex[is_vertex], corner[row, column]])
        return node, np.concatenate([place[is_vertex], place[~is_vertex][row]])

    @property
    def _body_elements(self) -> Int[ndarray, "element corner"]:
        return self._model.flex_elem.reshape(-1, self._body.dimension + 1)

    def _check(self, frame: int, substep: int) -> None:
        """Raise an error if the simulation has failed."""
        speed = np.linalg.norm(self._data.qvel[self._node_dof], axis=1)
        sane = np.isfinite(speed) & (speed < _SPEED_LIMIT)
        if sane.all():
            return
        node = int(np.argmin(sane))
        raise SimulationDivergedError(
            f"The {self._body.name} was torn in frame {frame}, substep {substep}: its node {node} "
            f"moved at {speed[node]:.3g} m/s. Move the hand more slowly, or raise "
            f"substeps_per_frame (now {self._parameters.substeps_per_frame}); the body's Young's "
            f"modulus is {self._body.stiffness:.3g} Pa.",
            frame=frame,
            substep=substep,
            node=node,
        )

    @cached_property
    def _node_dof(self) -> Int[ndarray, "node 3"]:
        first = self._model.body_dofadr[self._model.flex_vertbodyid]
        return first[:, None] + np.arange(3)


def _vary_stiffness(model: Any, body: Body) -> None:
    """Scale the stiffness of each element, which the format only knows for a whole body."""
    if (body.element_stiffness == 1.0).all():
        return
    stiffness = model.flex_stiffness.reshape(len(body.elements), -1)
    stiffness *= body.element_stiffness[:, None]


def _weights(
    corner: Float[ndarray, "point corner 3"], point: Float[ndarray, "point 3"]
) -> Float[ndarray, "point corner"]:
    """Compute the barycentric weights of the element's point nearest to a given point.

    The weights of a point outside are cut at 0, which is near enough to tell which corners count.
    """
    edge = corner[:, 1:] - corner[:, :1]
    square = edge @ edge.transpose(0, 2, 1)
    right = np.einsum("pcd,pd->pc", edge, point - corner[:, 0])
    square += 1e-12 * np.eye(square.shape[1])
    rest = np.linalg.solve(square, right[..., None])[..., 0]
    weight = np.clip(np.column_stack([1.0 - rest.sum(axis=1), rest]), 0.0, 1.0)
    return weight / weight.sum(axis=1, keepdims=True)
