"""Files over HTTP, read by independent programs and compared with the run's arrays."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from support.server.server_world import World
from support.viewer.gltf_player import Player
from support.viewer.viser_file import Recording

from app.exports.request import FileRequest
from app.exports.schema import MEDIA_TYPES
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import load_fitted, load_surface
from physhandi.run import Run
from physhandi.simulation.simulator import Simulator

RUN = "/api/v1/runs/fitted/export"


def fetch(world: World, query: str, path: str = RUN) -> bytes:
    answer = world.script().get(f"{path}?format={query}")
    assert answer.status_code == 200, answer.text
    kind = query.partition("&")[0]
    assert answer.headers["content-type"].partition(";")[0] == MEDIA_TYPES[kind]
    assert answer.headers["content-disposition"].startswith("attachment; filename=")
    return answer.content


def rollout(run: Run) -> np.ndarray:
    return np.asarray(run.array("sequences/sheet/rollout.npy"))


def test_motion_of_a_run_is_what_its_arrays_hold(
    world: World, run: Run, made: list[FileRequest], tmp_path: Path
) -> None:
    truth = rollout(run)
    with np.load(io.BytesIO(fetch(world, "npz"))) as arrays:
        np.testing.assert_array_equal(arrays["rollout"], truth)
    (tmp_path / "x.glb").write_bytes(fetch(world, "gltf"))
    played = Player(tmp_path / "x.glb")
    for frame in (0, len(truth) - 1):
        np.testing.assert_allclose(played.vertices("object", frame), truth[frame], atol=1e-6)
    with zipfile.ZipFile(io.BytesIO(fetch(world, "ply"))) as archive:
        assert len(archive.namelist()) == len(truth)
        vertex = read_ply(archive.read("frame_00004.ply"), tmp_path)
    np.testing.assert_allclose(vertex[: truth.shape[1]], truth[4], atol=1e-6)
    assert fetch(world, "usd").startswith(b"PXR-USDC")
    one = world.script().get(f"{RUN}?format=ply&f=4")
    np.testing.assert_array_equal(read_ply(one.content, tmp_path), vertex)
    assert one.headers["content-disposition"] == 'attachment; filename="fitted_00004.ply"'
    # What needs the object's surface is made in a child process, as all that is heavy.
    assert [order.format for order in made] == ["gltf", "ply", "usd", "ply"]


def read_ply(content: bytes, folder: Path) -> np.ndarray:
    import trimesh

    (folder / "x.ply").write_bytes(content)
    shape: Any = trimesh.load(folder / "x.ply", process=False)
    return np.asarray(shape.vertices)


def test_a_changed_parameter_is_simulated_before_it_is_written(
    world: World, run: Run, made: list[FileRequest], tmp_path: Path
) -> None:
    fitted = FittedObject.of(run, "sheet")
    parameters = fitted.parameters.replace(drag=9.0)
    restart = fitted.fitted.restart
    assert restart is not None
    motion = Simulator(fitted.model, parameters).rollout(fitted.fitted.control, restart)
    expected = motion.position
    assert np.abs(expected - rollout(run)).max() > 1e-3
    with np.load(io.BytesIO(fetch(world, "npz&drag=9"))) as arrays:
        np.testing.assert_allclose(arrays["rollout"], expected, atol=1e-6)
    (tmp_path / "x.glb").write_bytes(fetch(world, "gltf&drag=9"))
    played = Player(tmp_path / "x.glb").vertices("object", len(expected) - 1)
    np.testing.assert_allclose(played, expected[-1], atol=1e-6)
    with zipfile.ZipFile(io.BytesIO(fetch(world, "ply&drag=9"))) as archive:
        vertex = read_ply(archive.read(f"frame_{len(expected) - 1:05d}.ply"), tmp_path)
    np.testing.assert_allclose(vertex[: expected.shape[1]], expected[-1], atol=1e-6)
    one = world.script().get(f"{RUN}?format=ply&drag=9&f={len(expected) - 1}")
    np.testing.assert_array_equal(read_ply(one.content, tmp_path), vertex)
    csv = fetch(world, "csv&drag=9").decode().splitlines()
    last = next(row.split(",") for row in csv if row.startswith("sheet,9,") and ",object,7," in row)
    np.testing.assert_allclose([float(v) for v in last[-3:]], expected[9, 7], atol=1e-6)
    assert [order.format for order in made] == ["npz", "gltf", "ply", "ply", "csv"]


def test_pictures_have_the_size_and_the_view_that_were_asked_for(
    world: World, made: list[FileRequest]
) -> None:
    small = fetch(world, "png&f=3&width=320&height=200&show=nodes&theme=dark")
    image = cv2.imdecode(np.frombuffer(small, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (200, 320, 3)
    blue = (image[..., 0].astype(int) - image[..., 2]) > 100
    assert blue.sum() > 100
    assert image[0, 0].max() < 40
    away = fetch(world, "png&f=3&width=320&height=200&show=nodes&cam=0,0,5,0,0,9&up=1,0,0")
    nothing = cv2.imdecode(np.frombuffer(away, np.uint8), cv2.IMREAD_COLOR)
    assert (nothing == 255).all()
    assert len(made) == 2
    fetch(world, "png&f=3&width=320&height=200&show=nodes&theme=dark")
    assert len(made) == 2


def test_recordings_come_as_files_and_as_pages(
    world: World, made: list[FileRequest], run: Run
) -> None:
    recording = Recording.read(fetch(world, "viser"))
    scene = recording.at(recording.seconds)
    shown = scene["/object/surface"]["vertices"].reshape(-1, 3)
    surface = load_surface(run, load_fitted(run, "sheet"), ())
    np.testing.assert_allclose(shown, surface.place(rollout(run)[-1]), atol=2e-4)
    assert len(scene["/object/surface"]["color"]) == 3  # It was never filmed in color.
    page = world.script().get(f"{RUN}?format=html")
    assert "__VISER_EMBED_DATA__" in page.text
    assert page.headers["content-security-policy"].startswith("default-src 'none'")
    assert len(made) == 2


def test_a_live_scene_gives_the_rollout_of_its_sliders(
    world: World, made: list[FileRequest]
) -> None:
    script = world.script()
    order = {"kind": "run", "id": "fitted"}
    scene = script.post("/api/v1/sessions", json=order).json()["id"]
    session: Any = world.sessions.get(scene)
    rollout = session.snapshot().rollout
    moved = rollout.position + np.float32(0.25)
    session._object._rollouts.newest.position = moved
    session._playback.seek(2)
    path = f"/api/v1/sessions/{scene}/export"
    with np.load(io.BytesIO(fetch(world, "npz", path))) as arrays:
        np.testing.assert_allclose(arrays["rollout"], moved, atol=1e-6)
    with zipfile.ZipFile(io.BytesIO(fetch(world, "zip&width=200&height=150", path))) as archive:
        names = set(archive.namelist())
        nodes = archive.read("nodes.csv").decode().splitlines()[1].split(",")
        link = archive.read("permalink.txt").decode()
    assert {"README.txt", "picture.png", "camera.json", "frame.ply", "parameters.yaml"} <= names
    np.testing.assert_allclose([float(v) for v in nodes[2:5]], moved[2, 0], atol=1e-6)
    assert link.startswith("/runs/fitted/view?f=2&")
    assert b"drag" in fetch(world, "yaml", path)
    stranger = world.browser().get(f"{path}?format=npz")
    assert stranger.status_code == 404
    assert not list((world.settings.data_dir / "cache" / "exports").glob(".*"))
    world.sessions.shutdown()


@pytest.mark.parametrize(
    ("query", "status", "word"),
    [
        ("format=exe", 422, "format"),
        ("", 422, "format"),
        ("format=png&width=4097", 422, "width"),
        ("format=png&height=15", 422, "height"),
        ("format=png&f=10", 422, "f: 'sheet' has frames 0 to 9"),
        ("format=ply&f=10", 422, "frames 0 to 9"),
        ("format=png&fig=1", 422, "fig"),
        ("format=png&sequence=../../etc", 422, "sequence"),
        ("format=npz&drag=-1", 422, "drag"),
        ("format=yaml&drag=1", 422, "yaml"),
        ("format=png&out=/etc/passwd", 422, "out"),
        ("format=png&rollout=/etc", 422, "rollout"),
        ("format=png&f=1&f=2", 422, "f"),
    ],
)
def test_errors_name_the_field_in_the_shape_that_openapi_tells(
    still_world: World, made: list[FileRequest], query: str, status: int, word: str
) -> None:
    answer = still_world.script().get(f"{RUN}?{query}")
    assert answer.status_code == status
    assert word in answer.json()["error"]["message"]
    assert made == []
    schema = still_world.script().get("/api/v1/openapi.json").json()
    told = schema["paths"]["/api/v1/runs/{run_id}/export"]["get"]["responses"][str(status)]
    shape = told["content"]["application/json"]["schema"] | {"components": schema["components"]}
    jsonschema.validate(answer.json(), shape)


def test_openapi_describes_every_route_of_files_and_links(world: World) -> None:
    schema = world.script().get("/api/v1/openapi.json").json()
    jsonschema.Draft202012Validator.check_schema(schema["components"]["schemas"]["ErrorAnswer"])
    export = schema["paths"]["/api/v1/runs/{run_id}/export"]["get"]
    assert set(export["responses"]["200"]["content"]) >= set(MEDIA_TYPES.values())
    assert {"200", "401", "404", "409", "422", "429"} <= set(export["responses"])
    formats = next(p for p in export["parameters"] if p["name"] == "format")["schema"]["enum"]
    assert set(formats) == set(MEDIA_TYPES)
    for path in (
        "/api/v1/sessions/{session_id}/export",
        "/api/v1/sessions/{session_id}/link",
        "/api/v1/runs/{run_id}/replay",
        "/api/v1/runs/{run_id}/replay.viser",
    ):
        assert path in schema["paths"]
        for operation in schema["paths"][path].values():
            assert operation["description"]
    refused = world.client().get(RUN + "?format=npz")
    assert refused.status_code == 401
    told = export["responses"]["401"]["content"]["application/json"]["schema"]
    jsonschema.validate(json.loads(refused.text), told | {"components": schema["components"]})
