"""The gate: one address for all live sessions, in front of their loopback viser servers."""

import asyncio
import json
import logging
import re
from collections import Counter
from collections.abc import Coroutine
from typing import Any

import websockets
from fastapi import APIRouter, HTTPException, Request, Response, WebSocket
from starlette.responses import RedirectResponse
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.viewer.edit.selection import DrawnShape
from app.viewer.sessions import Session, Sessions
from app.viewer.steer.key_channel import KeyChannel
from app.viewer.ui.scene_frame import packed_scene_page, scene_page
from app.viewer.viewer_log import limit_viewer_log
from physhandi.errors import UsageError

logger = logging.getLogger(__name__)

_PROTOCOL = "viser-v"
_GONE = (
    "This live scene does not exist, was closed, or belongs to another browser. "
    "Open your own from the home page."
)
_MOST_REFUSED = 20
"""So many messages that are none, and the page that sends them is hung up on."""
_PIXEL_RATIO = re.compile(r"[0-9]{1,2}(\.[0-9]{1,20})?")
_LEAVING_S = 1.2
"""Time that the page that a tab has left may take to disconnect [s]."""


def create_gate(sessions: Sessions) -> APIRouter:
    """Make the routes of the live sessions.

    ``GET /viewer/{session_id}/`` answers with viser's one page and nothing else; no path is passed
    on. ``/viewer/{session_id}`` with or without the slash is the websocket, passed on unchanged;
    ``/viewer/{session_id}/keys`` is another one, for keys that are held while hands are steered;
    ``/viewer/{session_id}/shape`` takes what was drawn by a lasso or a brush.
    Who may come in is decided before the gate; that a session is one's own, here. Each tab has a
    session of its own: a page that is opened while another tab watches the session is sent on to a
    copy, which begins with the same state. A tab that is reloaded has hung up before.

    Args:
        sessions: The sessions that exist.
    """
    limit_viewer_log()
    watching: Counter[str] = Counter()
    router = APIRouter(include_in_schema=False)
    page = scene_page()
    packed = packed_scene_page()

    @router.get("/viewer/{session_id}/")
    async def show_page(session_id: str, request: Request) -> Response:
        session = sessions.find(session_id, request.state.owner)
        if session is None:
            raise HTTPException(404, _GONE)
        if await _is_taken(watching, session_id):
            copied = await asyncio.to_thread(sessions.copy, session)
            headers = {"Cache-Control": "no-store"}
            return RedirectResponse(f"/viewer/{copied}/", 303, headers=headers)
        is_packed = "gzip" in request.headers.get("accept-encoding", "")
        headers = {"Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        if is_packed:
            headers["Content-Encoding"] = "gzip"
        return Response(packed if is_packed else page, media_type="text/html", headers=headers)

    @router.websocket("/viewer/{session_id}")
    @router.websocket("/viewer/{session_id}/")
    async def pass_on(websocket: WebSocket, session_id: str) -> None:
        session = sessions.find(session_id, websocket.state.owner)
        if session is None:
            await _refuse(websocket, 404, _GONE)
            return
        watching[session_id] += 1
        session.pixel_ratio = _pixel_ratio(websocket)
        upstream: ClientConnection | None = None
        try:
            upstream = await _connect(websocket, session.port)
            if upstream is not None:
                await _exchange(websocket, upstream)
        finally:
            # Before the scene has hung up, which may take long: the tab may be coming back.
            watching[session_id] -= 1
            if watching[session_id] <= 0:
                del watching[session_id]
            if upstream is not None:
                await upstream.close()

    _add_shapes(router, sessions)
    _add_keys(router, sessions)
    return router


def _add_shapes(router: APIRouter, sessions: Sessions) -> None:
    """Let pages tell what was drawn in a scene that is edited."""

    @router.post("/viewer/{session_id}/shape", status_code=204)
    async def take_shape(session_id: str, request: Request) -> None:
        session = sessions.find(session_id, request.state.owner)
        if not isinstance(session, Session):
            raise HTTPException(404, _GONE)
        drawn = DrawnShape.parse(await request.body())
        await asyncio.to_thread(session.select, drawn)


def _add_keys(router: APIRouter, sessions: Sessions) -> None:
    """Let pages tell which keys are held while hands are steered."""

    @router.websocket("/viewer/{session_id}/keys")
    async def hear_keys(websocket: WebSocket, session_id: str) -> None:
        session = sessions.find(session_id, websocket.state.owner)
        if not isinstance(session, Session):
            await _refuse(websocket, 404, _GONE)
            return
        await websocket.accept()
        await _hear(websocket, session.keys)


async def _hear(websocket: WebSocket, keys: KeyChannel) -> None:
    """Take the keys that a page holds, and tell it what is going on; of that, the newest counts."""
    loop = asyncio.get_running_loop()
    newest: asyncio.Queue[str | None] = asyncio.Queue()

    def put(text: str | None) -> None:
        while not newest.empty():
            newest.get_nowait()
        newest.put_nowait(text)

    def listener(text: str | None) -> None:
        loop.call_soon_threadsafe(put, text)

    async def tell() -> None:
        while (text := await newest.get()) is not None:
            await websocket.send_text(text)

    async def hear() -> None:
        refused = 0
        # One after the other: keys that are let go must not be overtaken by those that were held.
        while refused < _MOST_REFUSED:
            text = await websocket.receive_text()
            try:
                await asyncio.to_thread(keys.hear, text)
            except UsageError as error:
                refused += 1
                await websocket.send_text(json.dumps({"error": str(error)}))

    keys.listen(listener)
    try:
        await _first_of(websocket, tell(), hear())
    finally:
        await asyncio.to_thread(keys.leave, listener)


async def _connect(websocket: WebSocket, port: int) -> ClientConnection | None:
    """Reach a session's viser server for a client; None if one of them cannot be reached."""
    offered = [p for p in websocket.scope["subprotocols"] if p.startswith(_PROTOCOL)]
    if not offered:
        await _refuse(websocket, 400, "A viser client must name its version.")
        return None
    try:
        upstream = await connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[Subprotocol(protocol) for protocol in offered],
            compression=None,
            max_size=None,
            proxy=None,
        )
    except (OSError, websockets.InvalidHandshake) as error:
        logger.info("the viewer of session did not answer: %s", error)
        await _refuse(websocket, 502, "The viewer of this session does not answer.")
        return None
    try:
        await websocket.accept(subprotocol=upstream.subprotocol)
    except (OSError, RuntimeError, WebSocketDisconnect):
        logger.debug("the client was gone before it came in")
        await upstream.close()
        return None
    return upstream


def _pixel_ratio(websocket: WebSocket) -> float:
    """Read what the page's script says of the screen; 1 if that makes no sense."""
    match = _PIXEL_RATIO.fullmatch(websocket.cookies.get("pixel_ratio", ""))
    return min(max(float(match[0]), 0.25), 8.0) if match else 1.0


async def _is_taken(watching: Counter[str], session_id: str) -> bool:
    """Return whether another tab watches a session and goes on watching it."""
    end = asyncio.get_running_loop().time() + _LEAVING_S
    while watching[session_id] > 0:
        if asyncio.get_running_loop().time() > end:
            return True
        await asyncio.sleep(0.03)
    return False


async def _refuse(websocket: WebSocket, status: int, reason: str) -> None:
    if "websocket.http.response" in websocket.scope.get("extensions", {}):
        await websocket.send_denial_response(Response(reason, status, media_type="text/plain"))
    else:
        await websocket.close(4000 + status, reason)


async def _exchange(websocket: WebSocket, upstream: ClientConnection) -> None:
    """Copy messages both ways until one side is gone; each send waits for the receiver."""
    await _first_of(websocket, _to_server(websocket, upstream), _to_client(websocket, upstream))


async def _first_of(websocket: WebSocket, *directions: Coroutine[Any, Any, None]) -> None:
    """Work in all directions until one has ended, and hang up."""
    tasks = [asyncio.create_task(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        for result in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(result, Exception) and not isinstance(result, WebSocketDisconnect):
                logger.error("passing messages on failed", exc_info=result)
    if websocket.application_state is WebSocketState.CONNECTED:
        try:
            await websocket.close()
        except (RuntimeError, WebSocketDisconnect):
            logger.debug("the client was gone already")


async def _to_server(websocket: WebSocket, upstream: ClientConnection) -> None:
    try:
        while True:
            message = await websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            content = message.get("bytes")
            await upstream.send(message["text"] if content is None else content)
    except (websockets.ConnectionClosed, WebSocketDisconnect, RuntimeError):
        return


async def _to_client(websocket: WebSocket, upstream: ClientConnection) -> None:
    try:
        async for message in upstream:
            if isinstance(message, str):
                await websocket.send_text(message)
            else:
                await websocket.send_bytes(message)
    except (websockets.ConnectionClosed, WebSocketDisconnect, RuntimeError):
        return
