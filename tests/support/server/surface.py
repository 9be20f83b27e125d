"""What people can reach of the program, as plain names: commands, addresses, answers, controls.

`tests/compatibility/make_fixture.py` lists it with the program of an earlier commit, and
`test_surface.py` with the present one; so nothing here may depend on where a module lies.
"""

import copy
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import redirect_stdout, suppress
from io import StringIO
from typing import Any, Protocol

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.testclient import TestClient

_OPTION = re.compile(r"^  (--\S.*?)(?:  +|$)")
_SUBCOMMAND = re.compile(r"^    • (\S+)", re.MULTILINE)
_CHOICES = re.compile(r"\{([^}]*)\}")
_OF_PAGES = re.compile(
    r" /(runs|sequences)/\{\}/(parts|picture|still|preview|thumbnail)\b| /viewer/| /assets"
)
"""Addresses that only the pages themselves ask for."""
_STORED = re.compile(r"→ (results\.\w+\.|overrides\.|sequences\.sheet\.[a-z]+\.)")
"""Fields that a run's files have, whatever passes them on."""
_WIDE = "240"
ANY_SCENE = "any scene"
"""Stands for controls that some scene has, be they hidden at first."""


class Client(Protocol):
    """A client of a live scene that keeps what it is told."""

    messages: list[dict[str, Any]]
    gui: dict[str, dict[str, Any]]


def commands(main: Callable[[list[str]], None]) -> list[str]:
    """List all commands with their options and the values that these name."""
    found: list[str] = []
    waiting: list[tuple[str, ...]] = [()]
    while waiting:
        command = waiting.pop()
        text = _help(main, command)
        for name in _SUBCOMMAND.findall(text):
            waiting.append((*command, name))
            found.append(" ".join((*command, name)))
        for line in text.splitlines():
            option = _OPTION.match(line)
            if option is not None:
                found += _option(" ".join(command), option[1])
    return sorted(found)


def _help(main: Callable[[list[str]], None], command: tuple[str, ...]) -> str:
    printed, width = StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _WIDE
    try:
        with redirect_stdout(printed), suppress(SystemExit):
            main([*command, "--help"])
    finally:
        os.environ.pop("COLUMNS")
        os.environ |= {} if width is None else {"COLUMNS": width}
    return printed.getvalue()


def _option(command: str, text: str) -> Iterator[str]:
    """Name an option of a command, and each of its named values."""
    for name in re.findall(r"--[a-z0-9-]+", text):
        yield f"{command} {name}".strip()
        for choices in _CHOICES.findall(text):
            named = [choice for choice in choices.split(",") if choice != "None"]
            yield from (f"{command} {name} {choice}" for choice in named)


def addresses(app: FastAPI) -> list[str]:
    """List all addresses with their methods, the fields of their queries and of their bodies."""
    pages: list[Any] = []
    found: list[str] = []
    for route in routes(app.routes):
        if not hasattr(route, "methods"):
            kind = "websocket" if "WebSocket" in type(route).__name__ else "files"
            found.append(f"{kind} {_plain(route.path)}")
        elif hasattr(route, "include_in_schema"):
            pages.append(copy.copy(route))
            pages[-1].include_in_schema = True
    described = get_openapi(title="all", version="0", routes=pages)
    schemas = described.get("components", {}).get("schemas", {})
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            name = f"{method.upper()} {_plain(path)}"
            found.append(name)
            given = [p["name"] for p in operation.get("parameters", []) if p["in"] == "query"]
            found += [f"{name} ?{field}" for field in given]
            for content in operation.get("requestBody", {}).get("content", {}).values():
                fields = _fields(content["schema"], schemas)
                found += [f"{name} body {field}" for field in fields]
    return sorted({name for name in found if not _OF_PAGES.search(name)})


def routes(given: Iterable[Any]) -> Iterator[Any]:
    """Walk through routes, also those that a router was included with."""
    for route in given:
        inner = getattr(getattr(route, "original_router", None), "routes", None)
        if inner is None:
            yield route
        else:
            yield from routes(inner)


def _plain(path: str) -> str:
    return re.sub(r"\{[^}]*\}", "{}", path)


def _fields(schema: Mapping[str, Any], schemas: Mapping[str, Any]) -> Iterator[str]:
    """Name the fields of a body, of all kinds that it may be."""
    if "$ref" in schema:
        yield from _fields(schemas[schema["$ref"].rpartition("/")[2]], schemas)
    for kind in ("oneOf", "anyOf", "allOf"):
        for part in schema.get(kind, []):
            yield from _fields(part, schemas)
    yield from schema.get("properties", {})


def answers(client: TestClient, grasp: str) -> list[str]:
    """List the fields of the API's answers about the folder of these tests.

    Args:
        client: May ask everything.
        grasp: Id of the run with hands.
    """
    found: list[str] = []
    asked = {
        "/api/v1/runs?limit=1&q=tag:best": "/api/v1/runs",
        "/api/v1/runs/quick": "/api/v1/runs/{}",
        f"/api/v1/runs/{grasp}": "/api/v1/runs/{}",
        "/api/v1/runs/softer": "/api/v1/runs/{}",
        "/api/v1/runs/quick/losses": "/api/v1/runs/{}/losses",
        "/api/v1/runs/quick/frame_errors": "/api/v1/runs/{}/frame_errors",
        "/api/v1/sequences": "/api/v1/sequences",
        "/api/v1/sequences/grasp": "/api/v1/sequences/{}",
        "/api/v1/profiles": "/api/v1/profiles",
        "/api/v1/settings?profile=quick": "/api/v1/settings",
        f"/api/v1/settings?run={grasp}": "/api/v1/settings",
        "/api/v1/comparison?a=quick&b=softer": "/api/v1/comparison",
        "/api/v1/system": "/api/v1/system",
        "/healthz": "/healthz",
        "/api/v1/runs/nobody": "an error",
        "/api/v1/runs?sort=wrong": "an error",
    }
    for path, name in asked.items():
        found += [f"{name} → {field}" for field in fields_of(client.get(path).json())]
    draft = {"sequences": ["sheet"], "profile": "quick", "overrides": {"node_spacing": 0.02}}
    checked = client.post("/api/v1/runs/check", json=draft).json()
    found += [f"/api/v1/runs/check → {field}" for field in fields_of(checked)]
    return sorted({name for name in found if not _STORED.search(name)})


def fields_of(content: Any, at: str = "") -> Iterator[str]:
    """Name all fields of plain data; those of a list's entries count as one entry's."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield f"{at}{name}"
            yield from fields_of(value, f"{at}{name}.")
    elif isinstance(content, list):
        for value in content:
            yield from fields_of(value, at)


def settings(client: TestClient) -> list[str]:
    """List the settings of all profiles by path and kind, and the profiles."""
    found: set[str] = set()
    for profile in client.get("/api/v1/profiles").json()["profiles"]:
        found.add(f"profile {profile['name']}")
        told = client.get(f"/api/v1/settings?profile={profile['name']}").json()["settings"]
        for setting in told:
            found.add(f"{setting['path']} ({setting['kind']})")
            choices = setting.get("choices") or ()
            found |= {f"{setting['path']} {choice}" for choice in choices}
    return sorted(found)


def keys(groups: Iterable[Any]) -> list[str]:
    """List the keys of a live scene and what they trigger."""
    rows = (key for group in groups for key in group.keys)
    return sorted(" ".join(k.shown) + (f": {k.action}" if k.action else "") for k in rows)


def controls(client: Client) -> tuple[list[str], list[str]]:
    """List the controls of a live scene that a client was told of, with what they offer.

    Returns:
        Those that are seen, and those that are hidden in the state of the scene.
    """
    kinds = {
        str(message["uuid"]): str(message["type"]).removeprefix("Gui").removesuffix("Message")
        for message in client.messages
        if str(message["type"]).startswith("Gui") and isinstance(message.get("props"), dict)
    }
    seen: set[str] = set()
    hidden: set[str] = set()
    for uuid, props in client.gui.items():
        kind = kinds[uuid].lower()
        label = str(props.get("label") or "").removeprefix("● ")
        found = {f"{kind} {label}"} if label else set[str]()
        found |= {f"{kind} {label}: {option}" for option in props.get("options") or () if label}
        found |= {f"tab {tab}" for tab in props.get("_tab_labels") or ()}
        (seen if props.get("visible", True) else hidden).update(found)
    return sorted(seen), sorted(hidden - seen)


def scenes(
    sessions: Any, grasp: str, connect: Callable[[str], Any], wait: Callable[[str, Any], None]
) -> dict[str, list[str]]:
    """List the controls of each kind of live scene, and those that any of them hides.

    Args:
        sessions: Opens the scenes.
        grasp: Id of the run with hands.
        connect: Opens a client at an address.
        wait: Takes in what a client is told, of the scene of that name.
    """
    opened = {
        "scene of a sheet": ("run", "quick"),
        "scene of a hand and its object": ("run", grasp),
        "scene of a recording with hands": ("sequence", "grasp"),
        "scene of a recording with markers": ("sequence", "sheet"),
        "scene of two runs": ("comparison", "a=quick&b=softer"),
    }
    found: dict[str, list[str]] = {}
    hidden: set[str] = set()
    for name, (kind, target) in opened.items():
        session_id = sessions.open(kind, target, "somebody")
        with connect(f"ws://127.0.0.1:{sessions.get(session_id).port}") as client:
            wait(name, client)
            found[name], of_scene = controls(client)
        hidden |= {*found[name], *of_scene}
        sessions.close(session_id)
    return found | {ANY_SCENE: sorted(hidden)}
