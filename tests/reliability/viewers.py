"""Live scenes whose websocket is cut in the middle of what they do."""

import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from support.server.measured_server import MeasuredServer
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import FRAMES, PARAMETERS, controls, make_run, sheet, show_parts
from support.waiting import until
from websockets.sync.connection import Connection

from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model
from reliability import Case, Report

_EXPONENTS = (-1.0, -0.5, 0.5)
"""Of ten, by which the stiffness is multiplied."""
_DRAGGED = [round(-0.95 + 0.1 * step, 2) for step in range(12)]
_LAST = FRAMES - 1
POOL = 46
"""Threads that a server may start for requests and keep: those of AnyIO (40) and asyncio (6)."""
_ONCE_MB = 40.0
"""Memory by which the second half may grow once [MB]: of scenes that wait for the collector."""
_A_TIME_MB = 0.2
"""And with each connection; a scene's drawing, kept by mistake, is more."""


def _reset(connection: Connection) -> None:
    """Lose the connection as if the machine were gone: the other side is told by a reset."""
    linger = struct.pack("ii", 1, 0)
    connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
    _hang_up(connection)


def _hang_up(connection: Connection) -> None:
    """Close the socket without a word of the protocol."""
    connection.socket.shutdown(socket.SHUT_RDWR)
    connection.recv_events_thread.join()


def _cut_a_message(connection: Connection) -> None:
    """Announce a message of 1,000 bytes, send 20 of them, and hang up."""
    connection.socket.sendall(bytes([0x82, 0x80 | 126]) + struct.pack("!H", 1000) + bytes(20))
    _hang_up(connection)


CUTS = (_reset, _hang_up, _cut_a_message)
"""Ways to lose a connection."""


def _play(client: ViewerClient) -> None:
    client.set("Play", True)
    client.until(lambda: client.find("Pause"))


def _simulate(client: ViewerClient) -> None:
    for exponent in _DRAGGED:
        client.set("stiffness", exponent)


def _ask_for_a_picture(client: ViewerClient) -> None:
    """Press the button, so that the server waits for a picture that never comes."""

    def button() -> str:
        groups = (uuid for uuid, p in client.gui.items() if "PNG" in (p.get("options") or ()))
        return next(groups, "")

    client.until(button)
    client.send("GuiUpdateMessage", uuid=button(), updates={"value": "PNG"})
    client.until(lambda: any(m["type"] == "GetRenderRequestMessage" for m in client.messages))


def _switch(client: ViewerClient, sequence: str) -> None:
    """Choose another sequence, and wait until the panel is built anew for it."""
    client.until(lambda: client.find("stiffness"))
    before = client.find("stiffness")
    client.set("Sequence", sequence)
    client.until(lambda: client.find("stiffness") not in {"", before})


_DEEDS: dict[str, Callable[[ViewerClient], object]] = {
    "connects": lambda _client: None,
    "loads": lambda client: client.until(lambda: client.bytes_received),
    "plays": _play,
    "simulates": _simulate,
    "saves": lambda client: client.set("Motion", "NPZ"),
    "switches": lambda client: _switch(client, "drag"),
    "looks": lambda client: client.tell_camera(position=(0.1, 0.2, 0.3)),
    "pictures": _ask_for_a_picture,
}
"""What goes on when the connection is lost."""
_LAST_WORDS = {"simulates", "saves", "looks"}
"""Deeds of which nothing is heard before the cut, so that they may be under way still."""


class Shown:
    """What a scene shows, as it was set last, in words of its panel."""

    def __init__(self, folder: Path) -> None:
        make_run(folder)
        self._expected = {exponent: _simulated(exponent) for exponent in _EXPONENTS}
        self._set: dict[str, Any] = {}

    def settle(self, client: ViewerClient, exponent: float, speed: float) -> None:
        """Set everything, and wait for the motion that comes of it."""
        if client.value("Sequence") != "lift":
            # A switch is over when it plays, with everything as it suits the sequence.
            client.until(lambda: client.find("Pause"))
            _switch(client, "lift")
            client.until(lambda: client.find("Pause"))
            show_parts(client)
        self._set = {"Speed": speed, "stiffness": exponent}
        for label, value in self._set.items():
            client.set(label, value)
        # A slider that stands at a value already is not heard; that it is moved stops the clock.
        for frame in (_LAST - 1, _LAST):
            client.set("Frame", frame)
        client.until(lambda: client.find("Play") and self._is_moved(client))

    def is_as_set(self, client: ViewerClient, deed: str) -> bool:
        """Tell whether another client is shown what was set, but for what was done since."""

        def is_there() -> bool:
            told = {label: client.value(label) for label in self._set if client.find(label)}
            if deed == "switches":
                is_there = client.find("Sequence") and client.value("Sequence") == "drag"
                return bool(is_there and client.find("Pause") and told.get("stiffness") == 0.0)
            if deed == "simulates":  # How many of them came through before the cut is chance.
                return told.get("stiffness") in {self._set["stiffness"], *_DRAGGED}
            if told != self._set:
                return False
            return bool(client.find("Pause" if deed == "plays" else "Play")) and (
                deed == "plays" or self._is_moved(client)
            )

        with suppress(TimeoutError):
            client.until(is_there)
        return is_there()

    def _is_moved(self, client: ViewerClient) -> bool:
        if "points" not in client.nodes.get("/object/nodes", {}):
            return False
        expected = self._expected[self._set["stiffness"]]
        return np.allclose(client.array("/object/nodes", "points"), expected, atol=1e-6)


def _simulated(exponent: float) -> ndarray:
    """The last frame of the sheet with another stiffness, simulated here."""
    control = controls((0.0, 0.0, 1.0))
    parameters = PARAMETERS.replace(stiffness_scale=float(f"{10.0**exponent:.4g}"))
    model = build_model(sheet(), control[0], parameters)
    return Simulator(model, parameters).rollout(control).position[-1]


def drop_viewers(count: int, folder: Path) -> Report:
    """Cut a scene's websocket, connect again, and look for what was shown before."""
    chance = np.random.default_rng(17)
    shown = Shown(folder / "runs" / "sheet")
    wrong = leaked = 0
    with MeasuredServer(folder) as server:
        scene = server.open("run", "sheet")
        with server.viewer(scene) as client:
            client.until(lambda: client.find("Pause"))
            show_parts(client)
            shown.settle(client, _EXPONENTS[0], 1.0)
        until(lambda: server.connections() == 0)
        warm = halfway = server.held()
        for number in range(count):
            deed = list(_DEEDS)[int(chance.integers(len(_DEEDS)))]
            client = server.viewer(scene)
            client.tell_camera()
            _DEEDS[deed](client)
            CUTS[int(chance.integers(len(CUTS)))](client.connection)
            if deed in _LAST_WORDS:
                until(lambda: server.connections() == 0)
            with server.viewer(scene) as again:
                wrong += not shown.is_as_set(again, deed)
                exponent = _EXPONENTS[int(chance.integers(len(_EXPONENTS)))]
                shown.settle(again, exponent, (0.5, 1.0, 2.0)[number % 3])
            until(lambda: server.connections() == 0)
            if number == count // 2:
                halfway = server.held()
        until(lambda: server.held().is_no_more_than(warm), server.held)
        end = server.held()
        leaked += max(0, end.threads - warm.threads - POOL)
        leaked += end.scenes - 1
        # A page that is sent on to a copy believes that somebody is still watching.
        status, _ = server.ask("GET", f"/viewer/{scene}/")
        leaked += status != 200
        grown = end.megabytes - halfway.megabytes
        leaked += grown > _ONCE_MB + _A_TIME_MB * count
        server.shut(scene)
        until(lambda: server.held().scenes == 0)
    return {
        "done": count,
        "wrong": wrong,
        "leaked": leaked,
        "memory after the first [MB]": round(warm.megabytes),
        "at half": round(halfway.megabytes),
        "at the end": round(end.megabytes),
        "threads after the first": warm.threads,
        "threads at the end": end.threads,
        "arrays mapped at the end": end.arrays,
    }


CASES = {
    "R17": Case("A live scene's websocket is cut, and connected again", 100, 4, drop_viewers),
}
