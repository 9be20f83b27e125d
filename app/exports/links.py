"""Permalinks: an address that opens a live scene as somebody left it, and the way back."""

from collections.abc import Mapping
from typing import Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from app.exports.permalink import holds_path, state_from_query, state_to_query
from app.exports.schema import errors
from app.ids import ItemId
from app.root_path import address_on
from app.security import bare_page
from app.viewer.content.session_state import SessionState
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from physhandi.errors import UsageError

_LONGEST = 4_000
_ASK = "<p>A page elsewhere leads here. <a href=''>Open the scene</a></p>"
CLOSED = "This live scene was closed, or it is not yours."
"""Message to who asks for a scene that is not there."""


class Link(BaseModel):
    """Address at which a live scene can be found again."""

    url: str
    """Address on this server that opens a scene in the same state."""
    query: str
    """Its part after the question mark."""
    lost: str = ""
    """Note about what the address lacks, with advice; empty if it is complete."""
    camera_path: str = ""
    """Camera path of a film of the scene, as JSON; empty if the camera stands still."""
    lacks_path: bool = False
    """Whether that has more key frames than a link holds, so that it is not in it."""


def create_links(sessions: Sessions) -> APIRouter:
    """Make the routes.

    Args:
        sessions: The live scenes.
    """
    router = APIRouter()

    def open_scene(kind: Literal["run", "sequence"], target: str, request: Request) -> Response:
        if request.state.is_foreign:
            # Whoever makes browsers come here must not fill the places for live scenes.
            return bare_page(403, "Open this live scene?", _ASK)
        purpose = request.headers.get("sec-purpose", "") + request.headers.get("purpose", "")
        if "prefetch" in purpose:
            # A browser that only expects a visit must not take a place among the live scenes.
            raise HTTPException(503, "A live scene is not opened in advance.")
        query = read_query(request)
        state = state_from_query(query)
        owner, may_keep = request.state.owner, request.state.may_change
        session = sessions.open(kind, target, owner, state=state, may_keep=may_keep)
        rest = urlencode(query, safe=",")
        return RedirectResponse(f"/live/{session}" + (f"?{rest}" if rest else ""), 303)

    @router.get("/runs/{run_id}/view", include_in_schema=False)
    def view_run(run_id: ItemId, request: Request) -> Response:
        return open_scene("run", run_id, request)

    @router.get("/sequences/{sequence_id}/view", include_in_schema=False)
    def view_sequence(sequence_id: ItemId, request: Request) -> Response:
        return open_scene("sequence", sequence_id, request)

    @router.get("/api/v1/sessions/{session_id}/link", responses=errors(404))
    def show_link(session_id: ItemId, request: Request) -> Link:
        """Tell the address that opens another scene in the state of this one."""
        session = sessions.find(session_id, request.state.owner)
        if session is None:
            raise HTTPException(404, CLOSED)
        if not isinstance(session, Session):
            return Link(url=address_on(request, session.link), query=session.link.partition("?")[2])
        link = link_of(session)
        path = "" if session.camera_path is None else session.camera_path.to_text()
        url, query = address_on(request, link), link.partition("?")[2]
        return Link(
            url=url,
            query=query,
            lost=_lost(session.state),
            camera_path=path,
            lacks_path=not holds_path(session.state),
        )

    return router


def _lost(state: SessionState) -> str:
    """Say what no link holds, and what to do."""
    if state.edits is not None:
        return (
            "Springs or nodes were edited here, which no link holds. Save it as a run (Export) "
            "and share that."
        )
    return ""


def link_of(session: Session) -> str:
    """Write the address on this server that opens another scene like one."""
    return address(session.kind, session.target, state_to_query(session.state))


def address(kind: str, target: str, query: Mapping[str, str]) -> str:
    """Write the address on this server that opens a run or a sequence in some state."""
    return f"/{kind}s/{target}/view?{urlencode(query, safe=',')}"


def read_query(request: Request, *, without: tuple[str, ...] = ()) -> Mapping[str, str]:
    """Read the fields of an address.

    Args:
        request: Who asks.
        without: Fields that mean something else.

    Raises:
        UsageError: If there is too much of it, or a field comes twice; names the field.
    """
    if len(request.url.query) > _LONGEST:
        raise UsageError(f"The link is longer than {_LONGEST} characters.")
    query: dict[str, str] = {}
    for name, text in request.query_params.multi_items():
        if name in query:
            raise UsageError(f"{name[:40]}: the link has this field twice.")
        if name not in without:
            query[name] = text
    return query
