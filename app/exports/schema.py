"""Answers of the routes of files, for the OpenAPI description."""

from typing import Any, Literal

from pydantic import BaseModel, Field

SlowFormat = Literal["mp4", "gif", "viser", "html"]
"""Formats for which every frame is drawn."""
MEDIA_TYPES: dict[str, str] = {
    "ply": "application/zip",
    "gltf": "model/gltf-binary",
    "npz": "application/octet-stream",
    "csv": "text/csv",
    "yaml": "application/yaml",
    "png": "image/png",
    "mp4": "video/mp4",
    "gif": "image/gif",
    "zip": "application/zip",
    "viser": "application/octet-stream",
    "html": "text/html",
    "usd": "application/octet-stream",
    "mjcf": "application/zip",
    "newton": "application/zip",
    "rrd": "application/octet-stream",
    "splat-ply": "application/octet-stream",
}


class FieldError(BaseModel):
    """Problem of one field."""

    field: str
    """Its place in the request."""
    message: str
    """Description of the problem."""


class ErrorDetail(BaseModel):
    """An error, for programs and for people."""

    code: str
    """Short name of the kind of error."""
    message: str
    """Description of the error, and advice."""
    fields: list[FieldError] = Field(default_factory=list[FieldError])
    """Problems of single fields."""


class ErrorAnswer(BaseModel):
    """Every error has this shape."""

    error: ErrorDetail
    """The error."""


def errors(*codes: int) -> dict[int | str, dict[str, Any]]:
    """Describe the errors that a route answers with."""
    texts = {
        401: "No valid token was sent.",
        404: "There is no such run, sequence or scene.",
        409: "The run is not finished, or is damaged.",
        422: "A field makes no sense; the message names it.",
        429: "The server makes as many files or scenes as it may.",
    }
    return {code: {"model": ErrorAnswer, "description": texts[code]} for code in (401, *codes)}


def files(*formats: str) -> dict[int | str, dict[str, Any]]:
    """Describe a file as an answer."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    content = {MEDIA_TYPES[name]: binary for name in formats or MEDIA_TYPES}
    return {200: {"content": content, "description": "The file."}}
