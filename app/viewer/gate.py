"""The gate: one address for all live sessions, in front of their loopback viser servers."""

import asyncio
import gzip
import logging
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import viser
import websockets
from fastapi import APIRouter, HTTPException, Request, Response, WebSocket
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.viewer.session import Sessions

logger = logging.getLogger(__name__)

_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
_PROTOCOL = "viser-v"


def create_gate(sessions: Sessions) -> APIRouter:
    """Make the routes of the live sessions.

    ``GET /viewer/{session}/`` answers with viser's one page and nothing else; no path is passed
    on. ``/viewer/{session}`` with or without the slash is the websocket, passed on unchanged.
    Who may come in is decided before the gate.

    Args:
        sessions: The sessions that exist.
    """
    router = APIRouter(include_in_schema=False)
    page = _PAGE.read_bytes()
    packed = gzip.compress(page, mtime=0)

    @router.get("/viewer/{session}/")
    def show_page(session: str, request: Request) -> Response:
        if sessions.get(session) is None:
            raise HTTPException(404, "This live session does not exist or was closed.")
        is_packed = "gzip" in request.headers.get("accept-encoding", "")
        headers = {"Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        if is_packed:
            headers["Content-Encoding"] = "gzip"
        return Response(packed if is_packed else page, media_type="text/html", headers=headers)

    @router.websocket("/viewer/{session}")
    @router.websocket("/viewer/{session}/")
    async def pass_on(websocket: WebSocket, session: str) -> None:
        found = sessions.get(session)
        if found is None:
            await _refuse(websocket, 404, "This live session does not exist or was closed.")
            return
        offered = [p for p in websocket.scope["subprotocols"] if p.startswith(_PROTOCOL)]
        if not offered:
            await _refuse(websocket, 400, "A viser client must name its version.")
            return
        try:
            upstream = await connect(
                f"ws://127.0.0.1:{found.port}",
                subprotocols=[Subprotocol(protocol) for protocol in offered],
                compression=None,
                max_size=None,
                proxy=None,
            )
        except (OSError, websockets.InvalidHandshake) as error:
            logger.info("the viewer of session did not answer: %s", error)
            await _refuse(websocket, 502, "The viewer of this session does not answer.")
            return
        async with upstream:
            await websocket.accept(subprotocol=upstream.subprotocol)
            await _exchange(websocket, upstream)

    return router


async def _refuse(websocket: WebSocket, status: int, reason: str) -> None:
    if "websocket.http.response" in websocket.scope.get("extensions", {}):
        await websocket.send_denial_response(Response(reason, status, media_type="text/plain"))
    else:
        await websocket.close(4000 + status, reason)


async def _exchange(websocket: WebSocket, upstream: ClientConnection) -> None:
    """Copy messages both ways until one side is gone; each send waits for the receiver."""
    directions: list[Coroutine[Any, Any, None]] = [
        _to_server(websocket, upstream),
        _to_client(websocket, upstream),
    ]
    tasks = [asyncio.create_task(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        for result in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(result, Exception):
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
