"""Shared replays: pages that whoever has their address may look at, and nothing else.

A share is a copy of a run's replay in one HTML file, made when it is shared. It lies in a folder of
its own below ``shares/`` of the data folder, so that it outlives the server, its token and its
cache. The name of the folder is the secret part of its address; who withdraws a share deletes it.
"""

import logging
import re
import secrets
import shutil
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException

from app.exports.cache import FileCache
from app.exports.files import request_of
from app.exports.links import read_query
from app.exports.schema import errors
from app.ids import ItemId
from app.jobs.catalog import Catalog, NotFoundError
from app.root_path import address_on
from app.security import SHARED, bare_page
from app.wrong_fields import wrong_fields
from physhandi.data.files import temporary_name, write_json
from physhandi.data.run_folder import read_json
from physhandi.errors import RunError, UsageError, describe

logger = logging.getLogger(__name__)

MOST_SHARES = 100
"""Shares that a data folder may hold."""
_PAGE, _ABOUT = "page.html", "share.json"
_NAME = re.compile("[A-Za-z0-9_-]{32}")
# The page holds its own data: it may not ask this server for anything, whoever looks at it.
_POLICY = (
    "sandbox allow-scripts allow-pointer-lock; default-src 'none'; "
    "script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; worker-src blob: data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


class StoredShare(BaseModel):
    """Description of a share, stored beside its page."""

    run: str
    """Id of the run that it shows."""
    name: str
    """Name that the run had then."""
    query: str = ""
    """The view, as the part of a link after the question mark."""
    created: str
    """Time of creation, in UTC."""


class Share(StoredShare):
    """A page that can be looked at without the server's token."""

    id: str
    """Name of the share, the secret part of its address."""
    url: str
    """Its address on this server."""
    bytes: int
    """Size of its page."""


class Shares:
    """The shares of a data folder."""

    def __init__(self, folder: Path) -> None:
        """Prepare; nothing is read yet.

        Args:
            folder: Where they are kept; made with the first.
        """
        self._folder = folder
        self._lock = threading.Lock()

    def add(self, page: Path, about: StoredShare) -> Share:
        """Keep a page under a new address.

        Args:
            page: HTML file to copy.
            about: What it shows.

        Raises:
            UsageError: If there are too many.
            OSError: If it cannot be written; then nothing is shared.
        """
        name = secrets.token_urlsafe(24)
        with self._lock:
            if len(self.all()) >= MOST_SHARES:
                raise UsageError(
                    f"There are {MOST_SHARES} shared pages, the most there may be. "
                    "Withdraw some on the pages of their runs."
                )
            self._folder.mkdir(parents=True, exist_ok=True)
            making = self._folder / temporary_name(name)
            making.mkdir()
            try:
                shutil.copyfile(page, making / _PAGE)
                write_json(making / _ABOUT, about.model_dump())
                making.rename(self._folder / name)
            except BaseException:
                shutil.rmtree(making, ignore_errors=True)
                raise
        return self._read(self._folder / name)

    def all(self) -> list[Share]:
        """List the shares, the newest first; damaged ones are named in the log alone."""
        shares, problems = self._read_all()
        for problem in problems:
            logger.warning("%s", problem)
        return sorted(shares, key=lambda share: share.created, reverse=True)

    def problems(self) -> list[str]:
        """Say of each damaged share what is wrong."""
        return self._read_all()[1]

    def _read_all(self) -> tuple[list[Share], list[str]]:
        shares: list[Share] = []
        problems: list[str] = []
        for folder in sorted(self._folder.glob("[!.]*")):
            try:
                shares.append(self._read(folder))
            except RunError as error:
                problems.append(str(error))
        return shares, problems

    def page(self, name: str) -> tuple[Path, str] | None:
        """Find the page of a share, and the run that it shows.

        Args:
            name: Name of the share.
        """
        try:
            share = self._read(self._folder / name)
        except RunError:
            return None
        return self._folder / name / _PAGE, share.run

    def withdraw(self, name: str) -> bool:
        """Delete a share; tells whether it was there.

        Args:
            name: Name of the share.
        """
        with self._lock:
            folder = self._folder / name
            gone = self._folder / temporary_name(name)
            try:
                folder.rename(gone)  # From now on nobody finds it.
            except FileNotFoundError:
                return False
            shutil.rmtree(gone, ignore_errors=True)
            return True

    def _read(self, folder: Path) -> Share:
        path = folder / _ABOUT
        try:
            about = StoredShare.model_validate(read_json(path))
            size = (folder / _PAGE).stat().st_size
        except ValidationError as error:
            field, why = wrong_fields(error.errors())[0]
            raise RunError(f"{path} is damaged: {field}: {why}.") from None
        except OSError as error:
            raise RunError(describe(error)) from None
        return Share(id=folder.name, url=f"{SHARED}{folder.name}", bytes=size, **about.model_dump())


def create_shares(catalog: Catalog, file_cache: FileCache, shares: Shares) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds runs.
        file_cache: Makes pages.
        shares: Keeps them.
    """
    router = APIRouter()

    def reached(share: Share, request: Request) -> Share:
        return share.model_copy(update={"url": address_on(request, share.url)})

    @router.post("/api/v1/runs/{run_id}/shares", responses=errors(404, 409, 422, 429))
    def share(run_id: ItemId, request: Request) -> Share:
        """Make a page of a run that can be looked at without the token, until it is withdrawn.

        All fields of a link are understood. The page is a replay: it shows the run as it is now,
        and gives no way to anything else on this server.
        """
        run, query = catalog.run(run_id), read_query(request)
        page = file_cache.make(request_of(catalog, run, "html", query))
        about = StoredShare(
            run=run_id,
            name=run.name,
            query=urlencode(query, safe=","),
            created=datetime.now(UTC).isoformat(timespec="milliseconds"),
        )
        made = shares.add(page, about)
        request.state.made = {"share_id": made.id}
        return reached(made, request)

    @router.get("/api/v1/shares")
    def list_shares(request: Request, run: Annotated[ItemId | None, Query()] = None) -> list[Share]:
        """List the shared pages, of one run or of all, the newest first."""
        return [reached(share, request) for share in shares.all() if run in {None, share.run}]

    @router.delete("/api/v1/shares/{share_id}", status_code=204, responses=errors(404))
    def withdraw(share_id: ItemId) -> Response:
        """Withdraw a shared page: its address shows nothing any more."""
        if not shares.withdraw(share_id):
            raise HTTPException(404, "There is no such shared page. It may be withdrawn already.")
        return Response(status_code=204)

    @router.get(SHARED + "{share_id:path}", include_in_schema=False)
    def show(share_id: str) -> Response:
        shared = shares.page(share_id) if _NAME.fullmatch(share_id) else None
        if shared is None or not _is_there(shared[1]):
            return bare_page(
                404,
                "Nothing is shared here",
                "<p>The page that was shared at this address was withdrawn, or the address is "
                "mistyped. Ask who sent it to you.</p>",
            )
        headers = {"Content-Security-Policy": _POLICY, "X-Robots-Tag": "noindex"}
        return FileResponse(shared[0], media_type="text/html", headers=headers)

    def _is_there(run_id: str) -> bool:
        """Whether a run was not deleted, with which its shares go."""
        try:
            catalog.run_item(run_id)
        except NotFoundError:
            return False
        return True

    return router
