"""Base of all live scenes: a viser server of their own, an owner, and connected viewers."""

import asyncio
import functools
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Protocol, cast, get_type_hints

import rich
import viser
import viser._assignable_props_api as handles
import viser._messages as messages

from app.settings import WEB_ASSETS
from app.viewer.content.session_state import Kind, Pose, SessionInfo
from app.viewer.ui.guard import Guard, without_markup

SURROUNDINGS = WEB_ASSETS / "surroundings.jpg"
"""Environment map that lights the scene, 256 x 128 px with a gain map: viser's "city", which is
Potsdamer Platz of Poly Haven (CC0), averaged over 4 x 4 px. A browser without a graphics card takes
a second more to prepare the original; towel and hand look the same, to two of 255 levels."""
_BRIGHTNESS = 0.4
"""Of that light. With it and the lamps that `web_assets/scene_frame.js` turns down, a towel that
was recorded as (50, 136, 152) is seen as (43, 136, 160); with all of it as (117, 186, 205)."""
_FROM_BELOW = 0.9
"""Intensity of the light from below. The environment map is nearly black there: of the same towel's
underside (1, 23, 29) was seen, and (0, 80, 94) is with this."""

# Viser looks up for every handle what types the properties of its class have, though these stay:
# a quarter of the time in which a scene is opened.
handles.get_type_hints = cast("Any", functools.cache(get_type_hints))


class _LoopEvent(asyncio.Event):
    """An event of an event loop that any thread may set.

    Viser sets its own from the thread that has something to send, which asyncio does not allow: if
    that comes between the loop's looking at the event and its waiting for it, nothing ever wakes
    the loop again and the client sees no more of the scene; or setting it fails because the loop
    changes who waits meanwhile.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._home = loop
        self._is_coming = False

    def set(self) -> None:
        """Have the loop set it, unless it is set; a loop that is closed has nobody to wake."""
        # Viser looks for messages after it has cleared the event.
        if not self.is_set() and not self._is_coming:
            self._is_coming = True
            with suppress(RuntimeError):
                self._home.call_soon_threadsafe(self._arrive)

    def _arrive(self) -> None:
        self._is_coming = False  # First: what is set from now on may be set for a later message.
        super().set()


class _Waker:
    """What viser's messages wake: an event loop, once for all that it has not looked at yet.

    For each message viser sets the event, and has the loop set it once more: an eighth of the time
    in which a scene is opened.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, event: _LoopEvent) -> None:
        self._loop = loop
        self._event = event

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any) -> None:
        """Have the loop call something; what sets the event sees to that by itself."""
        if callback == self._event.set:
            self._event.set()
        else:
            self._loop.call_soon_threadsafe(callback, *args)

    def create_task(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Have the loop work on something."""
        return self._loop.create_task(work)


def start_viser(label: str) -> viser.ViserServer:
    """Start a viser server on a free loopback port.

    Args:
        label: Title of its panel; must be harmless as HTML.
    """
    # Viser would print its loopback address, which misleads; even a quiet console lays it out.
    cast("Any", rich.get_console()).print = lambda *_, **__: None
    server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
    # Any client could ask for a public tunnel with this message.
    infrastructure: Any = server._websock_server  # noqa: SLF001  # no other way
    infrastructure.unregister_handler(messages.ShareUrlRequest)
    loop = server.get_event_loop()

    def let_threads_send(sender: Any) -> None:
        buffer = sender.get_message_buffer()
        buffer.message_event = _LoopEvent(loop)
        buffer.event_loop = _Waker(loop, buffer.message_event)

    let_threads_send(infrastructure)
    infrastructure.on_client_connect(let_threads_send)  # Called before anything is sent to it.
    upright = (1.0, 0.0, 0.0, 0.0)
    infrastructure.queue_message(  # viser's own function knows its own images alone.
        messages.EnvironmentMapMessage(
            hdri_data=SURROUNDINGS.read_bytes(),
            background=False,
            background_blurriness=0.0,
            background_intensity=1.0,
            background_wxyz=upright,
            environment_intensity=_BRIGHTNESS,
            environment_wxyz=upright,
        )
    )
    # Black from above: what faces up stays as it is. At its origin a lamp of this kind knows no up.
    server.scene.add_light_hemisphere(
        "/light_from_below", sky_color=(0, 0, 0), intensity=_FROM_BELOW, position=(0.0, 0.0, 1.0)
    )
    return server


class FollowsCameras(Protocol):
    """Shows something that depends on where a client's camera stands."""

    def welcome(self, client: viser.ClientHandle, /) -> None:
        """Show it to a client that has just come."""
        ...

    def turn(self, client: viser.ClientHandle, /) -> None:
        """Follow a client's camera."""
        ...


class SceneServer(ABC):
    """A viser server for one browser tab, which closes when nobody looks for long."""

    kind: Kind
    """Kind of the target."""

    def __init__(self, session_id: str, *, owner: str, title: str) -> None:
        """Start the server; scene and panel are built by the caller.

        Args:
            session_id: Unguessable id.
            owner: Whose session it is.
            title: Of the panel; may be any user's text.
        """
        self.id = session_id
        self.owner = owner
        self.created = time.time()
        self.pixel_ratio = 1.0
        """Pixels of the screen for each of the page, in a row, as the tab told last."""
        self._seen = time.monotonic()
        self._is_closed = False
        self._closing = threading.Lock()
        self._lock = threading.RLock()
        self._server = start_viser(without_markup(title))
        self._guard = Guard(self._server)

    @property
    @abstractmethod
    def target(self) -> str:
        """The item shown: an id, or a query."""

    @property
    @abstractmethod
    def title(self) -> str:
        """Title for people."""

    @property
    def port(self) -> int:
        """Loopback port of the viser server."""
        return self._server.get_port()

    @property
    def info(self) -> SessionInfo:
        """Entry of a listing for it."""
        return SessionInfo(
            id=self.id,
            kind=self.kind,
            target=self.target,
            owner=self.owner,
            title=self.title,
            client_count=len(self._server.get_clients()),
            created=self.created,
            idle=self.idle,
            offers=self.offers,
        )

    @property
    def offers(self) -> tuple[str, ...]:
        """Actions that it offers; see `SessionInfo`."""
        return ()

    @property
    def idle(self) -> float:
        """Time since a browser was connected [s]."""
        if self._server.get_clients():
            self._seen = time.monotonic()
        return time.monotonic() - self._seen

    @abstractmethod
    def _forget(self, client: viser.ClientHandle) -> Pose:
        """Forget a client; returns where its camera stood in the scene."""

    def _let_in(self, client: viser.ClientHandle, shown: FollowsCameras) -> None:
        """Show a new client something that follows its camera from now on."""
        # Heard before it is aimed: where a browser's camera stood may be told a moment later.
        client.camera.on_update(self._guard(lambda _: shown.turn(client)))
        shown.welcome(client)

    def _part(self, client: viser.ClientHandle) -> None:
        """Keep the camera of a client that leaves, for the tab that is being reloaded."""
        self._seen = time.monotonic()
        pose = self._forget(client)
        with self._closing:
            if not self._is_closed:
                pose.give_first(self._server.initial_camera)

    def _begin_to_close(self) -> None:
        """Keep no camera from now on: the server is about to stop."""
        with self._closing:
            self._is_closed = True
