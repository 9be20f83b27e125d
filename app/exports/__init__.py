"""What leaves the application: permalinks, replays and files."""

from fastapi import APIRouter

from app.exports.links import create_links
from app.viewer.session import Sessions


def create_exports(sessions: Sessions) -> APIRouter:
    """Make the routes of links, replays and files.

    Args:
        sessions: The live scenes.
    """
    router = APIRouter()
    router.include_router(create_links(sessions))
    return router
