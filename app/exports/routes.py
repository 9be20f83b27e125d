"""The routes of links, replays, shared pages and files."""

from fastapi import APIRouter

from app.exports.cache import FileCache
from app.exports.files import create_files
from app.exports.links import create_links, link_of
from app.exports.replay import create_replays
from app.exports.shares import Shares, create_shares
from app.jobs.catalog import Catalog
from app.pages import Pages
from app.viewer.sessions import Sessions


def create_exports(
    catalog: Catalog,
    sessions: Sessions,
    pages: Pages,
    file_cache: FileCache,
    shares: Shares,
    *,
    root_path: str = "",
) -> list[APIRouter]:
    """Make the routes of links, replays, shared pages and files, and let scenes know their links.

    Args:
        catalog: Finds runs and sequences.
        sessions: The live scenes.
        pages: Renders.
        file_cache: Makes files.
        shares: Keeps pages that were shared.
        root_path: Path below which the application is reached.
    """
    sessions.link_of = lambda session: f"{root_path}{link_of(session)}"
    return [
        create_links(sessions),
        create_files(catalog, sessions, file_cache),
        create_replays(catalog, file_cache, pages),
        create_shares(catalog, file_cache, shares),
    ]
