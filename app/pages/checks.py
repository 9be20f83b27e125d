"""The check of a recording: its frames with what is known of them, its stages and its problems."""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, cast

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from app.ids import ItemId
from app.jobs.catalog import Catalog, SequenceItem
from app.jobs.checks import check_item
from app.jobs.recordings.models import ModelFolders
from app.pages.render import Pages
from app.previews.overlay import LAYERS, draw_frame
from physhandi.data.files import named_fields, with_status
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.fitting.checks.readiness import ABOUT, readiness
from physhandi.perception.lifting import HAND_LABEL, OBJECT_LABEL

_KEPT = {"Cache-Control": "private, max-age=3600"}
_AGAIN = {"Cache-Control": "no-store"}


class FrameQuery(BaseModel):
    """Picture of a frame; the fields are the parameters of an address."""

    model_config = ConfigDict(extra="forbid")

    layers: Annotated[str, Field(max_length=100)] = ""
    """Names of layers, with commas."""
    depth: bool = False
    """Whether depth is the ground even where there is color."""
    v: Annotated[str, Field(max_length=40)] = ""
    """State of the recording's files."""


def add_checks(router: APIRouter, catalog: Catalog, models: ModelFolders, pages: Pages) -> None:
    """Add the pages that check recordings to the routes.

    Args:
        router: Gets the routes.
        catalog: Finds sequences.
        models: Finds networks of the user.
        pages: Renders.
    """

    @router.get("/sequences/{sequence_id}/check")
    def show_check(
        request: Request, sequence_id: ItemId, frame: Annotated[int, Query(ge=0, le=10_000_000)] = 0
    ) -> HTMLResponse:
        item = catalog.sequence_item(sequence_id)
        sequence = item.sequence
        stages = readiness(sequence) if sequence is not None else {}
        return pages.render(
            request,
            "check.html",
            item=item,
            sequence=sequence,
            frame=min(frame, sequence.frame_count - 1) if sequence is not None else 0,
            views=[_described(view) for view in sequence.views] if sequence is not None else [],
            layers=_layers_of(sequence) if sequence is not None else [],
            labels=_labels_of(sequence) if sequence is not None else [],
            can_annotate=sequence is not None and _can_annotate(item, sequence),
            models=models.list(),
            model_folder=models.folder,
            is_annotated=sequence is not None and len(sequence.missing("mask", "track")) < 2,
            version=_version(item.folder),
            imported=_imported(sequence) if sequence is not None else None,
            stages={name: stage.to_dict() for name, stage in stages.items()},
            about=ABOUT,
        )

    @router.get("/sequences/{sequence_id}/problems")
    def show_problems(request: Request, sequence_id: ItemId) -> HTMLResponse:
        """Read every file, which takes seconds, and give stages and problems."""
        item = catalog.sequence_item(sequence_id)
        report = check_item(item).to_dict()
        return pages.render(request, "_checked.html", **report, about=ABOUT, is_whole=True)

    @router.get("/sequences/{sequence_id}/views/{view_name}/frames/{frame}")
    def show_frame(
        sequence_id: ItemId,
        view_name: ItemId,
        frame: int,
        query: Annotated[FrameQuery, Query()],
    ) -> Response:
        item = catalog.sequence_item(sequence_id)
        version = _version(item.folder)
        sequence = _opened(item.folder, version)
        view = next((view for view in sequence.views if view.name == view_name), None)
        if view is None or not 0 <= frame < view.frame_count:
            raise HTTPException(404, "This recording has no such view or frame.")
        layers = frozenset(query.layers.split(",")) & set(LAYERS)
        content = draw_frame(
            view, frame, sides=sequence.hands, layers=layers, shows_depth=query.depth
        )
        headers = _KEPT if query.v == version else _AGAIN
        return Response(content, media_type="image/jpeg", headers=headers)


def _described(view: View) -> dict[str, Any]:
    parts = {
        "color": view.has_color,
        "depth": view.has_depth,
        "masks": view.has_mask,
        "keypoints": view.has_keypoint,
        "tracks": view.track is not None,
    }
    return {
        "name": view.name,
        "width": view.camera.width,
        "height": view.camera.height,
        "parts": [name for name, is_there in parts.items() if is_there],
        "lacks": [name for name, is_there in parts.items() if not is_there],
        "can_choose": view.has_color and view.has_depth,
        "can_correct": view.has_mask,
    }


def _imported(sequence: Sequence) -> dict[str, Any] | None:
    """Collect what an importer noted of what it found, repaired and assumed."""
    notes = sequence.provenance.get("notes")
    calibration = named_fields(sequence.provenance.get("calibration")) or {}
    listed = [str(note) for note in cast("list[Any]", notes)] if isinstance(notes, list) else []
    if not listed and not calibration:
        return None
    errors = named_fields(calibration.get("reprojection_error_px")) or {}
    error = {view: px for view, px in errors.items() if isinstance(px, float)}
    return {"notes": listed, "by": str(calibration.get("by", "")), "error": error}


def _can_annotate(item: SequenceItem, sequence: Sequence) -> bool:
    """Tell whether masks can be found in a recording; those that came with the program stay."""
    return not item.is_bundled and any(view.has_color for view in sequence.views)


def _layers_of(sequence: Sequence) -> list[tuple[str, str]]:
    """Give the layers that some view has, by their names in addresses and for people."""
    titles = {"mask": "Masks", "keypoint": "Keypoints", "track": "Tracks"}
    missing = sequence.missing(*LAYERS)
    return [(layer, titles[layer]) for layer in LAYERS if layer not in missing]


def _labels_of(sequence: Sequence) -> list[tuple[int, str]]:
    """Give what can be painted into masks, by its label."""
    hands = [(HAND_LABEL[side], f"{side} hand") for side in sequence.hands]
    return [(OBJECT_LABEL, "object"), *hands, (0, "nothing")]


@lru_cache(maxsize=8)
def _opened(folder: Path, _version: str) -> Sequence:
    """Open a sequence once, so that its videos are not decoded from the start for every frame."""
    return Sequence.load(folder)


def _version(folder: Path) -> str:
    """Name the state of a recording's files; another one when files come, go or are replaced."""
    parts = (*folder.glob("*.*"), *folder.glob("views/*/"), *folder.glob("views/*/*"))
    times = [folder.stat().st_mtime_ns, *(status.st_mtime_ns for _, status in with_status(parts))]
    return f"{max(times):x}-{len(times)}"
