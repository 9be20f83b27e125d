"""The small pictures of runs and sequences, as files of addresses that change with them."""

from contextlib import suppress
from typing import Any

from fastapi import APIRouter, Response

from app.ids import ItemId
from app.previews.store import PreviewKind, Previews

_KEPT = {"Cache-Control": "private, max-age=604800, immutable"}
_AGAIN = {"Cache-Control": "no-store"}


def add_pictures(router: APIRouter, previews: Previews) -> None:
    """Add the pictures to the routes.

    Args:
        router: Gets the routes.
        previews: Keeps them.
    """

    def answer(kind: PreviewKind, item_id: str, version: str, *, is_moving: bool) -> Response:
        path = previews.file(kind, item_id, is_moving=is_moving)
        if path is not None:
            headers = _KEPT if version and f"-{version}." in path.name else _AGAIN
            with suppress(FileNotFoundError):  # It may be cleared away at this moment.
                return Response(path.read_bytes(), media_type="image/webp", headers=headers)
        picture = previews.look(kind, item_id)
        # Nothing yet, or nothing ever: neither is an error of whoever looks at the page.
        return Response(status_code=202 if picture.state == "pending" else 204, headers=_AGAIN)

    @router.get("/runs/{run_id}/still")
    def run_still(run_id: ItemId, v: str = "") -> Response:
        return answer("run", run_id, v, is_moving=False)

    @router.get("/runs/{run_id}/preview")
    def run_preview(run_id: ItemId, v: str = "") -> Response:
        return answer("run", run_id, v, is_moving=True)

    @router.get("/runs/{run_id}/picture")
    def run_picture(run_id: ItemId) -> dict[str, Any]:
        return _picture_state(previews, "run", run_id)

    @router.get("/sequences/{sequence_id}/still")
    def sequence_still(sequence_id: ItemId, v: str = "") -> Response:
        return answer("sequence", sequence_id, v, is_moving=False)

    @router.get("/sequences/{sequence_id}/preview")
    def sequence_preview(sequence_id: ItemId, v: str = "") -> Response:
        return answer("sequence", sequence_id, v, is_moving=True)

    @router.get("/sequences/{sequence_id}/picture")
    def sequence_picture(sequence_id: ItemId) -> dict[str, Any]:
        return _picture_state(previews, "sequence", sequence_id)


def _picture_state(previews: Previews, kind: PreviewKind, item_id: str) -> dict[str, Any]:
    """Tell a page that waits for a picture whether it is there by now, and where."""
    picture = previews.look(kind, item_id)
    return {"state": picture.state, "still": picture.still, "moving": picture.moving}
