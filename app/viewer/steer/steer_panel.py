"""Steering: the mode that a key switches, the gizmo on the wrist, and the panel's tab."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from app.viewer.clock.playback import Playback
from app.viewer.content.content import Content, ShownHand
from app.viewer.content.session_state import Pose
from app.viewer.live.client import STARTING, SimulationClient
from app.viewer.live.drive import HandOrder
from app.viewer.physics.keep_panel import SavedRun, saved_html
from app.viewer.physics.kept_choice import write_small
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes
from app.viewer.steer.key_channel import KeyChannel, Press, velocity_of, view_axes
from app.viewer.steer.steered import SteeredFrame, SteeredObject, begin_motion
from app.viewer.ui.guard import Guard, notify
from app.viewer.ui.keyboard import bind
from app.viewer.ui.tabs import Tabs
from physhandi.errors import PhysHandiError, UsageError
from physhandi.hand.curl import blended, curl_motion, finger_joints
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.fingers import CURLS, FINGERS, Fingers, curled
from physhandi.simulation.restart import NodeState
from physhandi.simulation.steering import (
    POSE,
    HandSurface,
    SteeredHand,
    SteeredMotion,
    from_quaternion,
    to_quaternion,
)

GIZMO = "/steer/wrist"
"""Path in the scene of the gizmo on the wrist, a fingertip or a point that is held."""
_START, _STOP = "Steer (G)", "Back to playback (G)"
_RECORD, _END_RECORDING = "Record (space)", "End recording (space)"
_PLAY, _DISCARD = "Play take", "Discard"
_LET_GO, _GRIP = "Let go (X)", "Grip (X)"
_SIDES, _BOTH = frozenset({"right", "left"}), "both hands"
_POINT_COLOR = (233, 30, 180)
_RED = (166, 30, 30)
"""Color of what records; white on it can be read (contrast of 7)."""
_GIZMO_SIZE = 0.22
"""Length of the gizmo's axes, as a part of the scene's extent."""
_POINT_SIZE = 0.02
"""Size of a point that is held, likewise."""
_TIP_COLOR = (236, 160, 20)
_TIP_GIZMO_SIZE, _DOT_SIZE = 0.3, 0.07
"""Length of the axes of a gizmo on a fingertip, and width of the dots by which fingers and wrists
are chosen: as parts of the hand from its wrist to the tip of its middle finger."""
_ABOVE_TIP, _ABOVE_WRIST = 0.045, 0.16
"""Distances of the dots from tips and wrist, on the backs of fingers and hand, where they are seen:
likewise."""
_SPEED = 0.25
"""Speed of a wrist at first, in extents of the scene a second."""
_TURN_SPEED = 90.0
"""Turning of a hand at first [°/s]."""
_CLOSING = 0.8
"""Speed at which keys close the fingers of a hand: all the way from open takes 2.5 s [1/s]."""
_GRAVITY = 9.81
"""Gravity that weights are computed with where there is none [m/s²]."""
_REFRESH = 0.25
_COUNTED = 1.0
"""Time over which frames are counted [s]."""
_STYLE = "font-size:0.85em;line-height:1.5;padding:0.2em 0.9em 0.5em"
_HOW = (
    "The object is simulated on from the frame that is shown while you move the hand: by the "
    "arrows and rings on its wrist, or by keys that you hold. <b>W S A D Q E</b> move it as you "
    "see it, <b>I K J L U O</b> turn it, <b>R F</b> close and open its fingers; click the dot on a "
    "fingertip to bend that finger alone. <b>X</b> lets go of the object, and grips what is near. "
    "Click a point of the object to hold it there and pull. Of two hands, <b>Move</b> takes one "
    "or both. Ctrl Z takes back."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """A recording of what somebody steered, and how to show it again."""

    motion: SteeredMotion
    """Its poses, and the state that they begin with."""
    frames: tuple[SteeredFrame, ...]
    """All its frames."""
    surfaces: Mapping[str, HandSurface]
    """Each hand in its pose of zero."""
    frame: int
    """Frame of the sequence from which the hands were steered."""

    def part(self, first: int, last: int, seconds: float) -> SteeredMotion:
        """Give the motion of some of its frames, smoothed.

        Args:
            first: First frame that is kept.
            last: Last one.
            seconds: See `SteeredMotion.smoothed`.
        """
        start = self.frames[first].position, self.frames[first].velocity
        return self.motion.part(first, last, start).smoothed(seconds)


KeepMotion = Callable[[SteeredMotion, int, str, Callable[[SavedRun], None]], None]
"""Keeps a motion that was steered from a frame on, under a name, and reports how far that is."""
Shown = tuple[ObjectRollout, int, Mapping[str, Float[ndarray, "vertex 3"]]]
"""Rollout, its frame, and the vertices of each hand [m]."""


@dataclass(frozen=True)
class Moved:
    """Target of keys and the gizmo: a hand, both, or one finger by its tip."""

    hands: tuple[int, ...]
    """Numbers of the hands, or that of a point that is held."""
    finger: int | None = None
    """Number of the finger; None for whole hands."""

    def place(
        self, hands: Sequence[SteeredHand], pose: Float[ndarray, "hand pose"]
    ) -> Float[ndarray, " 3"]:
        """Tell where its gizmo is [m]: on the wrist, the tip, or halfway between two wrists."""
        if self.finger is not None:
            (hand,) = self.hands
            return hands[hand].tip(self.finger, pose[hand])
        return np.mean([hands[hand].wrist + pose[hand, :3] for hand in self.hands], axis=0)

    def dot(
        self, hands: Sequence[SteeredHand], pose: Float[ndarray, "hand pose"]
    ) -> Float[ndarray, " 3"] | None:
        """Tell where the dot is by which it is chosen [m]; None for both, or without fingers."""
        return None if len(self.hands) > 1 else self._dot(hands[self.hands[0]], pose[self.hands[0]])

    def _dot(self, hand: SteeredHand, pose: Float[ndarray, " pose"]) -> Float[ndarray, " 3"] | None:
        if hand.fingers is None:
            return None
        fingers, size = hand.fingers, _length(hand)
        if self.finger is None:
            above = hand.wrist + _ABOVE_WRIST * size * fingers.back
        else:
            bent = pose[6], pose[7:]
            above = (fingers.tips(*bent) + _ABOVE_TIP * size * fingers.nails(*bent))[self.finger]
        return hand.moved(above[None], pose)[0]


class SteerPanel:
    """Steers the hands of one content; controls, keys and the clock come in different threads."""

    def __init__(
        self,
        server: viser.ViserServer,
        guard: Guard,
        playback: Playback,
        *,
        tabs: Tabs,
        live: SimulationClient,
        session: str,
        content: Content,
        framing: Framing,
        channel: KeyChannel,
        rollout_at: Callable[[int], tuple[ObjectRollout, int]],
        stop_comparing: Callable[[], None],
        newtons: Callable[[], float],
        skins: Callable[[], Mapping[str, Mapping[str, ndarray]]],
        keep: KeepMotion | None = None,
    ) -> None:
        """Add the tab's controls.

        Args:
            server: Where to.
            guard: Wraps the callbacks.
            playback: The session's clock.
            tabs: Where the controls go.
            live: The process that simulates.
            session: Id of the session.
            content: What is shown.
            framing: Sizes.
            channel: Tells held keys.
            rollout_at: Finds the rollout of a frame, and which of its frames.
            stop_comparing: Ends a comparison, which shows two objects.
            newtons: Tells the force on the object for one newton of its model.
            skins: Reads the skeletons of the hands that have one; see `HandSkin.to_tensors`.
            keep: Makes a run and a recording of a motion; None where nothing can be kept.
        """
        self._server = server
        self._guard = guard
        self._playback = playback
        self._tabs = tabs
        self._live = live
        self._mailbox = f"{session}/steer"
        self._content = content
        self._extent = framing.extent
        self._channel = channel
        self._rollout_at = rollout_at
        self._stop_comparing = stop_comparing
        self._newtons = newtons
        self._skins = skins
        self._keep = keep
        self._recorded: Recorded | None = None
        self._motion_folder: MotionFolder | None = None
        self._lock = threading.RLock()
        self._object: SteeredObject | None = None
        self._moved = Moved((0,))
        self._apart: dict[int, Float[ndarray, " pose"]] = {}
        self._dots: dict[Moved, Float[ndarray, " 3"]] = {}
        self._frame = 0
        self._was_playing = False
        self._surfaces: dict[str, HandSurface] = {}
        self._held: frozenset[str] = frozenset()
        self._gizmo: viser.TransformControlsHandle | None = None
        self._motion: SteeredMotion | None = None
        self._nodes = SceneNodes(server)
        self._is_dragged = self._was_dragged = False
        self._refused = ""
        self._arrivals: deque[float] = deque(maxlen=200)
        self._written = -math.inf
        self._add_controls(server.gui)
        self._commands = bind(server, guard, "steer", lambda _, __: self.toggle())
        channel.attach(self._hold, self._press)
        self._write(at_once=True)

    def _add_controls(self, gui: viser.GuiApi) -> None:
        content, guard = self._content, self._guard
        with self._tabs["Steer"]:
            self._folder = gui.add_folder(None)
        with self._folder:
            self._button = gui.add_button(_START, hint="G")
            self._status = gui.add_html("")
            self._choice: Any = gui.add_dropdown(
                "Move", ("controls",), visible=False, hint="Hand, finger, or point of the object"
            )
            self._grip_button = gui.add_button(
                _LET_GO,
                visible=False,
                hint="A hand holds nothing then, or what is near it; a point is held no more",
            )
            speed = _rounded(_SPEED * self._extent)
            self._speed: Any = gui.add_slider(
                f"Speed [{content.length_unit}/s]",
                0.1 * speed,
                8.0 * speed,
                0.1 * speed,
                speed,
                hint="Of a hand that keys move",
            )
            self._turn_speed: Any = gui.add_slider(
                "Turning [°/s]", 10.0, 360.0, 10.0, _TURN_SPEED, hint="Of a hand that keys turn"
            )
            self._limits_force: Any = gui.add_checkbox(
                "Limit force", False, hint="Hands give way where the object pulls at them harder"
            )
            weight = self._weight()
            self._most_force: Any = gui.add_slider(
                "Force [N]",
                _rounded(0.5 * weight),
                _rounded(50.0 * weight),
                _rounded(0.1 * weight),
                _rounded(3.0 * weight),
                visible=False,
                hint="At first three times what the object weighs",
            )
            self._record = gui.add_button(
                _RECORD, color=_RED, visible=False, hint="Space; at most a minute"
            )
        self._button.on_click(guard(lambda _: self.toggle()))
        self._record.on_click(guard(lambda _: self._toggle_recording()))
        self._grip_button.on_click(guard(lambda _: self._toggle_grip()))
        self._limits_force.on_update(guard(lambda _: self._limit_force()))
        self._most_force.on_update(guard(lambda _: self._limit_force()))
        self._choice.on_update(guard.by_user(lambda _: self._choose(self._choice.value)))

    @property
    def is_on(self) -> bool:
        """Whether hands are steered now."""
        return self._object is not None

    def toggle(self) -> None:
        """Steer from the frame on the screen on, or return to playback."""
        with self._lock:
            if self.is_on:
                self.leave()
            else:
                self._enter()

    def leave(self) -> None:
        """Return to playback, where it was left."""
        with self._lock:
            steered, self._object = self._object, None
            if steered is None:
                return
            self._end_recording(steered)
            steered.close()
            self._held = frozenset()
            self._remove_gizmo()
            self._nodes.clear()
            self._motion = None
            self._tell()
            self._write(at_once=True)
        if self._was_playing:
            self._playback.play()
        self._playback.redraw()

    def shown(self) -> Shown | None:
        """Give what is to be drawn in place of the frame on the clock; None for nothing.

        A clock that was started or moved ends the mode. Called by the thread that draws.
        """
        with self._lock:
            steered, playback = self._object, self._playback
            if steered is None:
                return None
            if playback.is_playing or playback.frame != self._frame:
                self._was_playing = False
                self.leave()
                return None
            if self._held:
                self._drive(steered)  # The camera may have turned.
            rollout, frame, newest = steered.shown()
            self._offer(newest.motion)
            self._follow(newest)
            if steered.is_full:
                self._end_recording(steered)
                self._tell()
            self._write()
            vertices = {
                hand.name: hand.moved(self._surfaces[hand.name].at(pose), pose)
                for hand, pose in zip(newest.motion.hands, newest.pose, strict=True)
                if hand.name in self._surfaces
            }
        return rollout, frame, vertices

    def remove(self) -> None:
        """Take the tab's controls away."""
        self.close()
        self._show_motion(None)
        for command in self._commands:
            command.remove()
        self._folder.remove()

    def close(self) -> None:
        """Stop steering and listening."""
        self._was_playing = False
        self.leave()
        self._channel.detach()

    def _enter(self) -> None:
        """Begin in the frame that is shown; called under the lock."""
        playback = self._playback
        self._was_playing = playback.is_playing
        playback.play(on=False)
        self._stop_comparing()
        self._frame = playback.frame
        rollout, frame = self._rollout_at(self._frame)
        skins = self._skins()
        surfaces: dict[str, HandSurface] = {
            hand.side: self._surface(hand, skins) for hand in self._content.hands
        }
        wrists: dict[str, ndarray] = {
            hand.side: np.array(hand.joint[min(self._frame, len(hand.joint) - 1)][0], np.float64)
            for hand in self._content.hands
            if hand.joint is not None
        }
        self._begin(begin_motion(rollout, frame, surfaces, wrists), surfaces)

    def _surface(self, hand: ShownHand, skins: Mapping[str, Mapping[str, ndarray]]) -> HandSurface:
        """Give a hand in the frame; its fingers move if it has bones."""
        vertex = np.asarray(hand.vertex[min(self._frame, len(hand.vertex) - 1)], np.float64)
        skin = skins.get(hand.side)
        if skin is None or len(skin["vertex_bone"]) != len(vertex):
            return HandSurface(shapes=vertex[None])
        motion = curl_motion(skin, hand.side, self._frame, CURLS)
        moved = blended(motion, skin["vertex_bone"], skin["vertex_weight"], vertex)
        shapes, fingers = vertex + (moved - curled(moved, 0.0)), None
        if hand.joint is not None:
            joint = np.asarray(hand.joint[min(self._frame, len(hand.joint) - 1)], np.float64)
            joints = finger_joints(skin, hand.side, self._frame, CURLS, joint)
            fingers = Fingers(**joints)
        return HandSurface(shapes=shapes, fingers=fingers)

    def _begin(self, motion: SteeredMotion, surfaces: Mapping[str, HandSurface]) -> None:
        """Simulate on from the state of a motion; called under the lock."""
        self._surfaces = dict(surfaces)
        self._object = SteeredObject(
            self._mailbox,
            self._live,
            motion,
            extent=self._extent,
            on_change=self._hear,
        )
        self._limit_force()
        self._arrivals.clear()
        self._offer(motion)
        self._tabs.open("Steer")
        self._tell()
        self._write(at_once=True)
        self._playback.redraw()

    def _toggle_recording(self) -> None:
        """Begin or end to record."""
        with self._lock:
            steered = self._object
            if steered is None or steered.is_replaying:
                return
            if steered.is_recording:
                self._end_recording(steered)
            else:
                self._show_motion(None)
                steered.record(on=True)
            self._tell()
            self._write(at_once=True)

    def _end_recording(self, steered: SteeredObject) -> None:
        """Offer what was recorded, if more than its start was; called under the lock."""
        frames = steered.recorded
        steered.record(on=False)
        if len(frames) < 2:
            return
        first = frames[0]
        motion = replace(
            first.motion,
            start=(first.position, first.velocity),
            pose=np.stack([frame.pose for frame in frames]),
        )
        self._show_motion(
            Recorded(motion=motion, frames=frames, surfaces=self._surfaces, frame=self._frame)
        )

    def _show_motion(self, recorded: Recorded | None) -> None:
        """Offer a recording to be trimmed, smoothed, simulated and kept, or nothing."""
        if self._motion_folder is not None:
            self._motion_folder.remove()
        self._recorded, self._motion_folder = recorded, None
        if recorded is not None:
            with self._folder:
                self._motion_folder = MotionFolder(
                    self._server.gui,
                    self._guard,
                    recorded,
                    play=self._play,
                    discard=lambda: self._show_motion(None),
                    keep=self._keep,
                )

    def _play(self, motion: SteeredMotion) -> None:
        """Simulate a motion again and show it."""
        with self._lock:
            recorded = self._recorded
            if recorded is None:
                return
            if self._object is not None and self._object.motion.model is not motion.model:
                self.leave()  # It was recorded from another frame on, or with other grips.
            if self._object is None:
                self._playback.play(on=False)
                self._playback.seek(recorded.frame)
                self._was_playing, self._frame = False, recorded.frame
                self._stop_comparing()
                self._begin(replace(motion, pose=motion.pose[:1]), recorded.surfaces)
            if self._object is not None:
                self._object.replay(motion)
            self._tell()

    def grab(self, node: int) -> None:
        """Hold an object node, and move that from now on."""
        with self._lock:
            steered = self._object
            if steered is None or steered.is_replaying:
                return
            self._end_recording(steered)
            motion = steered.regrip(
                lambda motion, state, pose: motion.hold_point(
                    node, state, pose, _unused_name(motion)
                )
            )
            self._offer(motion)
            self._select(Moved((len(motion.hands) - 1,)))

    @property
    def dots(self) -> Float[ndarray, "dot 3"]:
        """Dots by which hands and fingers are chosen, as they were drawn last [m]."""
        with self._lock:
            return np.reshape([*self._dots.values()], (-1, 3))

    def choose_dot(self, number: int) -> None:
        """Move the hand or the finger of one of `dots` from now on."""
        with self._lock:
            if self._object is not None and number < len(self._dots):
                self._select(tuple(self._dots)[number])

    def _toggle_grip(self) -> None:
        """Let the chosen hands go, or grip what is near; a point is held no more."""
        with self._lock:
            steered = self._object
            if steered is None or steered.is_replaying:
                return
            hands = self._moved.hands
            is_point = self._is_point(steered.motion, hands[0])

            def change(
                motion: SteeredMotion, state: NodeState, pose: Float[ndarray, "hand pose"]
            ) -> SteeredMotion:
                if is_point:
                    return motion.without_point(hands[0], state, pose)
                holding = [hand for hand in hands if motion.holds(hand)]
                for hand in holding or hands:
                    let_go_or_grip = motion.let_go if holding else motion.grip
                    motion = let_go_or_grip(hand, state, pose)
                    pose = motion.pose[0]
                if not holding and not any(motion.holds(hand) for hand in hands):
                    raise UsageError("Nothing of the object is near the hand. Move it nearer.")
                return motion

            self._end_recording(steered)
            try:
                self._offer(steered.regrip(change))
            except UsageError as error:
                notify(self._server, "Nothing to grip", str(error), seconds=4.0)
            if is_point:
                self._select(Moved((0,)))
            self._write(at_once=True)

    def _is_point(self, motion: SteeredMotion, hand: int) -> bool:
        """Whether a hand is a point of the object that is held by itself."""
        return hand >= max(len(self._content.hands), 1) and hand < len(motion.hands)

    def _what(self, motion: SteeredMotion, hand: int) -> str:
        """Name a hand or a point within a sentence."""
        title = _title(motion.hands[hand])
        return title if self._is_point(motion, hand) else f"the {title}"

    def _offer(self, motion: SteeredMotion) -> None:
        """Let the hands of a motion be chosen, if they are others than before."""
        if self._motion is motion:
            return
        before, self._motion = self._motion, motion
        names = _choices(motion)
        if before is None or tuple(names) != tuple(_choices(before)):
            self._choice.options = tuple(names)
            self._choice.visible = len(names) > 1
            last = len(motion.hands) - 1
            self._select(
                self._moved
                if self._moved in names.values()
                else Moved((min(self._moved.hands[0], last),))
            )

    def _select(self, moved: Moved) -> None:
        """Move another hand or finger from now on; the others stay where they are."""
        steered, motion = self._object, self._motion
        if steered is None or motion is None:
            return
        self._moved = moved
        for other in range(len(motion.hands)):
            if other not in moved.hands:
                steered.order(other, HandOrder())
        self._remove_gizmo()
        self._add_gizmo(motion, steered.newest.pose)
        name = next(name for name, its in _choices(motion).items() if its == moved)
        if self._choice.value != name:
            self._choice.value = name
        self._tell()
        self._write(at_once=True)
        self._playback.redraw()

    def _remove_gizmo(self) -> None:
        if self._gizmo is not None:
            self._gizmo.remove()
        self._gizmo, self._is_dragged, self._was_dragged = None, False, False

    def _add_gizmo(self, motion: SteeredMotion, pose: Float[ndarray, "hand pose"]) -> None:
        hands, finger = self._moved.hands, self._moved.finger
        gizmo = self._gizmo = self._server.scene.add_transform_controls(
            GIZMO,
            scale=(
                _GIZMO_SIZE * self._extent
                if finger is None
                else _TIP_GIZMO_SIZE * _length(motion.hands[hands[0]])
            ),
            disable_rotations=not self._turns(motion),
            depth_test=False,
            position=self._moved.place(motion.hands, pose),
        )

        # In the order in which the browser has sent them, which threads would not keep.
        async def moved(event: viser.TransformControlsEvent) -> None:
            self._drag(event)

        gizmo.on_update(moved)

    def _turns(self, motion: SteeredMotion) -> bool:
        """Whether the gizmo turns what it moves: two hands have no common wrist."""
        hands = self._moved.hands
        return (
            self._moved.finger is None and len(hands) == 1 and not self._is_point(motion, hands[0])
        )

    def _drag(self, event: viser.TransformControlsEvent) -> None:
        """Let hands follow the gizmo; two of them keep their places beside it."""
        with self._lock:
            steered = self._object
            if steered is None or event.target is not self._gizmo or steered.is_replaying:
                return
            if event.phase == "start":
                self._is_dragged, self._refused = True, ""
                steered.begin_gesture()
                self._keep_apart(steered.newest)
                return
            if event.phase == "end":
                self._is_dragged, self._was_dragged = False, True
            newest = steered.newest
            if max(self._moved.hands) >= len(newest.motion.hands):
                return
            try:
                if self._moved.finger is None:
                    self._drag_hands(steered, newest, event.target)
                else:
                    self._drag_finger(steered, newest, self._moved.finger, event.target.position)
            except PhysHandiError as error:
                if str(error) != self._refused:
                    self._refused = str(error)
                    notify(event.client, "Not possible", self._refused)

    def _drag_hands(
        self, steered: SteeredObject, newest: SteeredFrame, gizmo: viser.TransformControlsHandle
    ) -> None:
        for number in self._moved.hands:
            place, turn = np.asarray(gizmo.position, np.float64), np.asarray(gizmo.wxyz)
            apart = self._apart.get(number)
            if apart is not None:
                place, turn = place + apart[:3], to_quaternion(apart[3:6])
            goal = _goal(newest.motion.hands[number], place, turn)
            steered.order(number, HandOrder(goal=goal, bend=steered.order_of(number).bend))

    def _drag_finger(
        self,
        steered: SteeredObject,
        newest: SteeredFrame,
        finger: int,
        place: Float[ndarray, " 3"],
    ) -> None:
        (number,) = self._moved.hands
        order, pose = steered.order_of(number), newest.pose[number].copy()
        if order.bend is not None:
            pose[7:] = order.bend
        bend = newest.motion.hands[number].follow(finger, place, pose)
        steered.order(number, replace(order, bend=tuple(float(angle) for angle in bend)))

    def _keep_apart(self, frame: SteeredFrame) -> None:
        """Remember how two hands are turned, and where they are beside their gizmo [m]."""
        self._apart = {}
        if len(self._moved.hands) == 1:
            return
        middle = self._moved.place(frame.motion.hands, frame.pose)
        for number in self._moved.hands:
            pose = frame.pose[number].copy()
            pose[:3] += frame.motion.hands[number].wrist - middle
            self._apart[number] = pose

    def _follow(self, frame: SteeredFrame) -> None:
        """Put the gizmo where the hand is, unless it is being dragged, and draw dots to click."""
        hands = frame.motion.hands
        points = [
            hand.wrist + pose[:3]
            for number, (hand, pose) in enumerate(zip(hands, frame.pose, strict=True))
            if self._is_point(frame.motion, number)
        ]
        self._nodes.points(
            "/steer/points",
            np.reshape(points, (-1, 3)),
            _POINT_COLOR,
            _POINT_SIZE * self._extent,
            is_visible=True,
        )
        self._dots = {
            moved: place
            for moved in _choices(frame.motion).values()
            if moved != self._moved and (place := moved.dot(hands, frame.pose)) is not None
        }
        self._nodes.spheres(
            "/steer/dots",
            self.dots,
            _TIP_COLOR,
            _dot_width(frame.motion),
            is_visible=True,
        )
        gizmo = self._gizmo
        if gizmo is None or self._is_dragged:
            return
        turns, number = self._turns(frame.motion), self._moved.hands[0]
        position = self._moved.place(hands, frame.pose)
        wxyz = to_quaternion(frame.pose[number, 3:6] if turns else np.zeros(3))
        if self._was_dragged:
            # Where the hand was before may have come after the last of the drag, and the browser
            # shows that; viser sends nothing that it believes to be there.
            self._was_dragged = False
            gizmo.position, gizmo.wxyz = position + 0.01 * self._extent, -wxyz
        if not np.allclose(gizmo.position, position, atol=1e-6 * self._extent):
            gizmo.position = position
        if not np.allclose(gizmo.wxyz, wxyz, atol=1e-6):
            gizmo.wxyz = wxyz

    def _choose(self, name: str) -> None:
        """Move another hand; the one before stays where it is."""
        with self._lock:
            names = {} if self._motion is None else _choices(self._motion)
            if name in names:
                self._select(names[name])

    def _hold(self, held: frozenset[str]) -> None:
        """Move the hand while keys are held."""
        with self._lock:
            before, self._held = self._held, held
            steered = self._object
            if steered is None:
                return
            if held and not before:
                steered.begin_gesture()
            if held or before:
                self._drive(steered)

    def _drive(self, steered: SteeredObject) -> None:
        turn_speed = math.radians(self._turn_speed.value)
        velocity = velocity_of(self._held, self._axes(), self._speed.value, turn_speed)
        closing = _CLOSING * (("KeyR" in self._held) - ("KeyF" in self._held))
        for hand in self._moved.hands:
            bend = steered.order_of(hand).bend
            steered.order(hand, HandOrder(velocity=velocity, closing=closing, bend=bend))

    def _weight(self) -> float:
        """Tell what the object weighs, as forces are shown [N]."""
        fitted = self._content.fitted
        if fitted is None:
            return 1.0
        gravity = abs(fitted.parameters.gravity) or _GRAVITY
        return self._newtons() * fitted.model.node_count * gravity

    def _limit_force(self) -> None:
        """Bound how hard hands pull, or not."""
        with self._lock:
            is_limited = bool(self._limits_force.value)
            self._most_force.visible = is_limited
            if self._object is not None:
                most = float(self._most_force.value) / self._newtons()
                self._object.limit_force(most if is_limited else None)

    def _axes(self) -> Float[ndarray, "3 3"]:
        """Find out how the newest client looks at the scene."""
        clients = self._server.get_clients()
        if not clients:
            return view_axes(Pose.first(self._server.initial_camera))
        return view_axes(Pose.of(clients[max(clients)].camera))

    def _press(self, press: Press) -> None:
        steered = self._object
        if press == "record":
            self._toggle_recording()
        elif press == "grip":
            self._toggle_grip()
        elif press == "undo" and steered is not None and not steered.undo():
            notify(self._server, "Nothing to take back", "The hand has not been moved.", seconds=3)

    def _hear(self, kind: str, error: str) -> None:
        """Follow the simulation; runs in its thread."""
        if kind in {"frame", "finished"}:
            self._arrivals.append(time.monotonic())
            self._playback.redraw()
            return
        titles = {"diverged": "The object has run away; it is back where it was recorded"}
        notify(self._server, titles.get(kind, "Steering has stopped"), error, seconds=12.0)
        self.leave()

    def _tell(self) -> None:
        """Tell the page whether keys steer."""
        state: dict[str, Any] = {"steering": self.is_on}
        if self.is_on and self._motion is not None:
            hands, finger = self._moved.hands, self._moved.finger
            number = hands[0]
            state["what"] = _BOTH if len(hands) > 1 else self._what(self._motion, number)
            state["both"] = len(hands) > 1
            state["turns"] = not self._is_point(self._motion, number)
            state["curls"] = self._motion.hands[number].curls is not None
            state["finger"] = "" if finger is None else FINGERS[finger]
            state["recording"] = self._object is not None and self._object.is_recording
        self._channel.tell(state)

    def _write(self, *, at_once: bool = False) -> None:
        """Say what is going on, not more often than people read."""
        now = time.monotonic()
        if not at_once and now - self._written < _REFRESH:
            return
        self._written = now
        steered = self._object
        self._show_buttons(steered)
        text = _HOW
        if steered is not None:
            recent = sum(now - at < _COUNTED for at in tuple(self._arrivals))
            duration = steered.duration
            pace = f"{recent / _COUNTED:.0f} frames/s"
            if math.isfinite(duration):
                pace += f" · {1e3 * duration:.3g} ms to simulate one"
            elif not self._live.is_ready:
                pace = STARTING.replace("*", "")
            doing = "Playing the take" if steered.is_replaying else "Steering"
            text = f"<b>{doing} from frame {self._frame}</b><br>{pace}{self._pull(steered.newest)}"
            if steered.is_recording:
                seconds = (len(steered.recorded) - 1) / steered.motion.parameters.frame_rate
                text += f"<br>● Recording, {seconds:.1f} s"
        self._status.content = f"<div style='{_STYLE}' data-steering>{text}</div>"

    def _pull(self, frame: SteeredFrame) -> str:
        """Say how hard the object pulls at what is moved."""
        hands = self._moved.hands
        if frame.pull is None or max(hands) >= len(frame.pull):
            return ""
        force = self._newtons() * np.linalg.norm(frame.pull, axis=-1)
        return "".join(
            f"<br>the object pulls at {self._what(frame.motion, hand)} with {force[hand]:.2g} N"
            for hand in hands
        )

    def _show_buttons(self, steered: SteeredObject | None) -> None:
        """Say on the buttons what they would do now; those that do nothing are hidden."""
        is_on, motion = steered is not None, self._motion
        holds = motion is not None and any(motion.holds(hand) for hand in self._moved.hands)
        is_recording = steered is not None and steered.is_recording
        for button, is_visible, label in (
            (self._button, True, _STOP if is_on else _START),
            (self._grip_button, is_on, _LET_GO if holds else _GRIP),
            (self._record, is_on, _END_RECORDING if is_recording else _RECORD),
        ):
            if button.visible != is_visible:
                button.visible = is_visible
            if button.label != label:
                button.label = label


class MotionFolder:
    """Controls of a recording: trim and smooth it, simulate it again, keep it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        guard: Guard,
        recorded: Recorded,
        *,
        play: Callable[[SteeredMotion], None],
        discard: Callable[[], None],
        keep: KeepMotion | None,
    ) -> None:
        """Add the folder where the caller stands.

        Args:
            gui: Where to.
            guard: Wraps the callbacks.
            recorded: The recording.
            play: Simulates a motion and shows it.
            discard: Takes the recording away.
            keep: Makes a run and a recording of a motion; None where nothing can be kept.
        """
        self._recorded = recorded
        self._keep = keep
        last = len(recorded.frames) - 1
        seconds = last / recorded.motion.parameters.frame_rate
        self._folder = gui.add_folder(f"Take of {seconds:.1f} s")
        with self._folder:
            self._part: Any = gui.add_multi_slider(
                "Keep",
                0,
                last,
                1,
                (0, last),
                min_range=1,
                hint="First and last frame that are kept",
            )
            self._smooth: Any = gui.add_slider(
                "Smooth [s]",
                0.0,
                0.5,
                0.02,
                0.0,
                hint="Averages the hands' way over so much time before and after each frame",
            )
            buttons = gui.add_button_group(
                "Take", (_PLAY, _DISCARD), hint="Playing simulates what is kept from its start"
            )
            buttons.on_click(
                guard(lambda event: play(self.motion) if event.target.value == _PLAY else discard())
            )
            if keep is not None:
                self._name: Any = gui.add_text("take name", "", hint="Of the run and the recording")
                save = gui.add_button(
                    "Save as run and recording", hint="Both open like any other from the home page"
                )
                save.on_click(guard(lambda _: self._save()))
            self._progress: Any = gui.add_html("", visible=False)

    @property
    def motion(self) -> SteeredMotion:
        """The trimmed and smoothed motion."""
        first, last = (int(value) for value in self._part.value)
        return self._recorded.part(first, last, float(self._smooth.value))

    def remove(self) -> None:
        """Take the folder away."""
        self._folder.remove()

    def _save(self) -> None:
        """Have a run and a recording made."""
        if self._keep is None:
            return
        self._keep(self.motion, self._recorded.frame, self._name.value, self._report)

    def _report(self, run: SavedRun) -> None:
        write_small(self._progress, saved_html(run))


def _choices(motion: SteeredMotion) -> dict[str, Moved]:
    """Name all that can be moved."""
    names = {_title(hand): Moved((number,)) for number, hand in enumerate(motion.hands)}
    both = tuple(number for number, hand in enumerate(motion.hands) if hand.name in _SIDES)
    if len(both) > 1:
        names[_BOTH] = Moved(both)
    for number, hand in enumerate(motion.hands):
        if hand.fingers is not None:
            for finger, name in enumerate(FINGERS):
                names[f"{hand.name} {name}"] = Moved((number,), finger)
    return names


def _title(hand: SteeredHand) -> str:
    """Name what is moved for people."""
    return f"{hand.name} hand" if hand.name in _SIDES else hand.name


def _dot_width(motion: SteeredMotion) -> float:
    """Tell how wide dots on hands are [m]."""
    lengths = [_length(hand) for hand in motion.hands if hand.fingers is not None]
    return _DOT_SIZE * max(lengths, default=0.0)


def _length(hand: SteeredHand) -> float:
    """Tell how long a hand with fingers is, from its wrist to the tip of its middle finger [m]."""
    tip = hand.tip(FINGERS.index("middle finger"), np.zeros(POSE))
    return float(np.linalg.norm(tip - hand.wrist))


def _unused_name(motion: SteeredMotion) -> str:
    """Name a new point."""
    names = {hand.name for hand in motion.hands}
    return next(name for number in count(1) if (name := f"point {number}") not in names)


def _goal(
    hand: SteeredHand, position: Float[ndarray, " 3"], wxyz: Float[ndarray, " 4"]
) -> tuple[float, ...]:
    """Give the pose of a hand whose wrist is at a place.

    Raises:
        UsageError: If a number is not finite, or the quaternion is zero.
    """
    place, turn = np.asarray(position, np.float64), np.asarray(wxyz, np.float64)
    is_finite = bool(np.isfinite(place).all() and np.isfinite(turn).all())
    if not is_finite or float(np.linalg.norm(turn)) < 1e-6:
        raise UsageError("A hand needs a place and a direction of finite numbers.")
    goal = np.concatenate([place - hand.wrist, from_quaternion(turn)])
    return tuple(float(value) for value in goal)


def _rounded(value: float) -> float:
    """Round to one digit that counts."""
    power = 10.0 ** math.floor(math.log10(value))
    return round(value / power) * power
