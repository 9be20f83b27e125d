# ruff: noqa: I001  # its imports are sorted as the modules of that commit are
"""Makes the data folder of these tests, and lists what people can reach, at commit 57a38d7.

Run it in a checkout of exactly that commit, not in this one; HERE is this folder::

    cd CHECKOUT && PYTHONPATH=CHECKOUT:HERE/.. python HERE/make_fixture.py /srv/physhandi

It writes ``data.tar.xz`` (the data folder), ``expected.json`` (what that program said of it),
``permalinks.json`` and ``surface.json`` to the folder named on the command line; README.md says
what is in them.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, get_args

import numpy as np
from support.server import surface
from support.waiting import until
from fastapi import FastAPI
from fastapi.testclient import TestClient
from pydantic import SecretStr

from app import cli, commands, permalink
from app.arguments import Reconstruct
from app.benchmarks.viewer_client import ViewerClient
from app.viewer.compare.request import CompareAsk
from app.exports.links import address
from app.jobs import listing, run_index
from app.jobs.catalog import Catalog
from app.jobs.listing import RunQuery
from app.jobs.scheduler import Scheduler
from app.keys import KEYS
from app.permalink import state_from_query, state_to_query
from app.server import create_app
from app.settings import Settings
from app.viewer.layers import THEMES, Layers
from app.viewer.preset_store import PresetStore
from app.viewer.presets import builtin_presets
from app.viewer.save_run import RunSaver
from app.viewer.session_state import Pose, SessionState
from physhandi.data.camera import PinholeCamera
from physhandi.data.checkpoint import write_checkpoint
from physhandi.data.environment import describe_environment
from physhandi.data.sequence_schema import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter, write_sequence
from physhandi.hand.model import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import Progress
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

COMMIT = "57a38d7"
POSE = {"cam": "0.5,0,0.5,0,0,0"}
TOKEN = "made-for-this-fixture-and-nothing-else"  # noqa: S105
IMAGE = 64
GRASP_FRAMES, GRASP_FITTED = 3, 2
SHEET_FRAMES, SHEET_FITTED = 8, 5
FINGERTIPS = (4, 8, 12)
CLOTH = SimulationParameters(
    connection_radius=0.024,
    max_neighbors=8,
    virtual_connection_radius=0.012,
    virtual_max_neighbors=2,
    stiffness=400.0,
    virtual_stiffness=2000.0,
    damping=4.0,
    drag=1.0,
    ground_height=0.0,
    substeps_per_frame=60,
)
PAGES = (
    "/",
    "/runs",
    "/runs?q=tag:best",
    "/sequences",
    "/system",
    "/launch",
    "/launch?run={quick}",
    "/launch?run={grasp}",
    "/diff?run={quick}&run={softer}&show=all",
    "/compare?a={quick}&b={softer}",
    "/runs/{quick}/compare",
    "/runs/{quick}/parts",
    "/suites",
)


class Cut(Progress):
    """Ends the process in the midst of the first-order stage, as a lost machine does."""

    def __init__(self, folder: Path) -> None:
        self._checkpoints = folder / "attempts" / "1" / "ckpt"

    def report(self, stage: str, iteration: int, *rest: Any, **more: Any) -> None:
        """Kill this process at the second pass; no stage keeps checkpoints yet, so one is made."""
        if stage == "first_order" and iteration == 2:
            for number in range(3):
                state = {"position": np.arange(6.0).reshape(2, 3) + number}
                write_checkpoint(self._checkpoints, "example", state)
            os.kill(os.getpid(), signal.SIGKILL)


def looking_from(azimuth: float) -> PinholeCamera:
    """A small camera that looks at (0, 0, 0.2), slightly from above."""
    target = np.array([0.0, 0.0, 0.2])
    eye = target + 0.6 * np.array([np.cos(azimuth), np.sin(azimuth), 0.5])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, eye], axis=1)
    focal = 420.0 * IMAGE / 240
    K = np.array([[focal, 0.0, IMAGE / 2], [0.0, focal, IMAGE / 2], [0.0, 0.0, 1.0]])
    distortion = np.array([0.05, -0.02, 0.001, -0.001, 0.0])
    return PinholeCamera(K, pose, IMAGE, IMAGE, distortion)


def closing_hand() -> HandMotion:
    """A right hand that closes a little while it rises."""
    time_ = np.linspace(0.0, 0.25, GRASP_FRAMES)
    articulation = np.zeros((GRASP_FRAMES, 15, 3))
    articulation[:, 3:, 0] = -0.2 - 0.8 * time_[:, None] * np.linspace(0.6, 1.0, 12)
    articulation[:, 0:3, 0] = -0.1 - 0.3 * time_[:, None]
    rotation = np.zeros((GRASP_FRAMES, 3))
    rotation[:, 0], rotation[:, 2] = -1.3, 2.9 + 0.6 * time_
    place = np.stack([0.05 * time_, -0.04 + 0.02 * time_, 0.2 + 0.1 * time_], axis=1)
    return HandMotion(
        side="right",
        shape=np.array([0.8, 0.5, -0.5, 0.3, -0.4, 0.6, 0.2, -0.6, 0.0, 0.4]),
        articulation=articulation,
        wrist_rotation=rotation,
        wrist_translation=place,
        scale=1.0,
        model="open",
    )


def film(camera: PinholeCamera, surface: np.ndarray, node: np.ndarray) -> tuple[np.ndarray, ...]:
    """Color, depth [mm] and mask of points on a hand and of an object's nodes; the nearest wins."""
    point = np.concatenate([surface, node])
    label = np.repeat([2, 1], [len(surface), len(node)])
    pixel = np.round(camera.project(point)).astype(int)
    depth_of_point = 1000.0 * camera.camera_depth(point)
    depth, mask = np.zeros((IMAGE, IMAGE), np.uint16), np.zeros((IMAGE, IMAGE), np.uint8)
    for index in np.argsort(-depth_of_point):
        column, row = pixel[index]
        if 0 <= column < IMAGE and 0 <= row < IMAGE:
            depth[row, column], mask[row, column] = round(depth_of_point[index]), label[index]
    color = np.array([[60, 70, 80], [40, 90, 200], [220, 170, 140]], np.uint8)[mask]
    return color, depth, mask


def write_grasp(folder: Path) -> None:
    """Write a hand that holds a small patch by three fingertips, seen by two views."""
    hand, motion = load_hand_model("right"), closing_hand()
    vertex, joint = motion.vertices(hand), motion.keypoints(hand)
    tip = joint[0][list(FINGERTIPS)].astype(np.float64)
    share = np.array([(a, b, 3 - a - b) for a in range(4) for b in range(4 - a)]) / 3
    patch = share @ tip
    node = np.concatenate([patch, np.add(patch, [0.0, 0.004, -0.012])]).astype(np.float32)
    cloth = replace(CLOTH, connection_radius=0.045, stiffness=200.0, ground_height=None)
    model = build_model(node, vertex[0], cloth)
    object_ = Simulator(model, cloth).rollout(vertex).position
    near = np.linalg.norm(object_[:, :, None] - vertex[:, None], axis=-1).min(axis=2) < 0.005
    cameras = [looking_from(0.3), looking_from(1.9)]
    views = tuple(
        ViewMeta(name=n, camera=c) for n, c in zip(("front", "side"), cameras, strict=True)
    )
    corner = vertex[:, hand.faces]
    surface = np.concatenate([vertex, corner.mean(axis=2)], axis=1)
    with SequenceWriter(folder) as writer:
        for view in views:
            pixel = view.camera.project(joint.astype(np.float64))[:, None]
            seen = np.concatenate([pixel, np.full_like(pixel[..., :1], 0.9)], axis=-1)
            writer.save_array(f"views/{view.name}/keypoint.npy", seen.astype(np.float32))
            for frame in range(GRASP_FRAMES):
                images = film(view.camera, surface[frame], object_[frame])
                for part, image in zip(("color", "depth", "mask"), images, strict=True):
                    writer.save_image(f"views/{view.name}/{part}/{frame:05d}.png", image)
        arrays = {
            "marker.npy": object_,
            "marker_node.npy": np.arange(len(node), dtype=np.int32),
            "object_node.npy": node,
            "rest_node.npy": node,
            "truth/hand_right_keypoint.npy": joint.astype(np.float32),
            "truth/contact_point.npy": node,
            "truth/contact.npy": near,
            "truth/object_point.npy": object_,
        }
        for rel, array in arrays.items():
            writer.save_array(rel, array)
        writer.finish(
            SequenceMeta(
                name=folder.name,
                description="A right hand holds a patch by three fingertips.",
                frame_rate=30.0,
                frame_count=GRASP_FRAMES,
                hands=("right",),
                views=views,
                reconstruction=GRASP_FITTED,
                provenance={"origin": "simulated by this project", "licence": "Apache-2.0"},
            )
        )


def write_sheet(folder: Path, lift: float) -> None:
    """Write the markers of a sheet that two point controllers lift at two of its corners."""
    line = 0.018 * np.arange(4)
    flat = np.stack([*np.meshgrid(line, line, indexing="ij"), np.full((4, 4), 0.1)], axis=-1)
    node = flat.reshape(-1, 3)
    rise = np.linspace(0.0, 1.0, SHEET_FRAMES)[:, None, None] * np.array([0.01, 0.0, lift])
    control = (node[[0, 3]] + [0.0, 0.0, 0.005] + rise).astype(np.float32)
    model = build_model(node, control[0], CLOTH)
    softer = np.where(node[model.spring_nodes[:, 0], 0] < 0.02, 2.0, 0.7) * model.stiffness
    model = replace(model, stiffness=softer.astype(np.float32))
    marker = Simulator(model, CLOTH).rollout(control).position
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=SHEET_FRAMES,
        ground_height=0.0,
        reconstruction=SHEET_FITTED,
        label="small",
    )
    arrays = {
        "control.npy": control,
        "marker.npy": marker,
        "marker_node.npy": np.arange(len(node), dtype=np.int32),
        "object_node.npy": node.astype(np.float32),
        "rest_node.npy": node.astype(np.float32),
    }
    write_sequence(folder, meta, arrays)


def command_line(*arguments: str) -> str:
    """Give a command line to the program; returns what it prints."""
    printed, told = StringIO(), StringIO()
    with redirect_stdout(printed), redirect_stderr(told):
        try:
            cli.main([*arguments])
        except SystemExit as end:
            if end.code:
                raise RuntimeError(f"{arguments} ended with {end.code}: {told.getvalue()}") from end
    return printed.getvalue()


def make_runs_by_commands(data: Path) -> None:
    """Fit, simulate and evaluate with commands, as people do in a terminal."""
    own = ("--data-dir", str(data), "--device", "cpu")
    runs = data / "runs"
    command_line("reconstruct", "sheet", "--profile", "quick", "--out", f"{runs}/quick", *own)
    changes = ("--stiffness-scale", "0.5", "--connection-radius", "0.03", "--drag", "2.5")
    substeps = ("--substeps-per-frame", "auto")
    command_line("simulate", "quick", "--out", f"{runs}/softer", *changes, *substeps, *own)
    other = ("--sequence", "sheet_high")
    command_line("simulate", "quick", "--out", f"{runs}/elsewhere", *other, *own)
    suite = ("--sequences", "sheet", "--methods", "static")
    command_line("evaluate", "suite", *suite, "--out", f"{data}/suites/small", *own)
    subprocess.run([sys.executable, __file__, "--cut", str(data)], check=False)  # It kills itself.


def cut_short(data: Path) -> None:
    """Fit until the midst of a stage, and vanish."""
    socket.gethostname = lambda: "workstation"
    out = data / "runs" / "interrupted"
    command = Reconstruct(
        sequences=("sheet",), out=out, profile="quick", device="cpu", data_dir=data
    )
    commands.reconstruct(command, Cut(out))


def make_runs_by_server(client: TestClient, saver: RunSaver, data: Path) -> dict[str, str]:
    """Launch, save, cancel and rename fits, as people do in the browser; returns their ids."""

    def launch(**body: Any) -> str:
        answer = client.post("/api/v1/runs", json=body)
        answer.raise_for_status()
        return str(answer.json()["id"])

    def state(run_id: str) -> str:
        return str(client.get(f"/api/v1/runs/{run_id}").json()["state"])

    settings = {
        "node_spacing": 0.012,
        "object_.search.generations": 3,
        "object_.search.variables.stiffness": {"low": 50.0, "high": 5000.0, "scale": "log"},
        "object_.search.variables.connection_radius": {"low": 0.03, "high": 0.06, "scale": "log"},
        "object_.first_order.iterations": 4,
        "refinement.iterations": 3,
    }
    # Cancelled first: while the first one is at work, it waits in line.
    grasp = launch(sequences=["grasp"], profile="quick", name="Grasp", overrides=settings)
    cancelled = launch(sequences=["sheet"], profile="paper", name="Never begun")
    client.post(f"/api/v1/runs/{cancelled}/cancel").raise_for_status()
    none = {
        "simulation.connection_radius": 0.001,
        "object_.search.variables.connection_radius": None,
    }
    failed = launch(sequences=["sheet"], profile="quick", overrides=none, parent="quick")
    short = {
        "object_.search.generations": 2,
        "object_.first_order.iterations": 4,
        "object_.first_order.judged_every": 2,
    }
    phystwin = launch(sequences=["sheet"], profile="phystwin", overrides=short)
    saved = saver.save("quick", "sheet", "On the moon", {"gravity": 1.62, "ground_height": None})
    ids = {"grasp": grasp, "cancelled": cancelled, "failed": failed}
    ids |= {"phystwin": phystwin, "saved": saved.id}
    ends = {"succeeded", "failed", "cancelled"}
    until(lambda: all(state(run_id) in ends for run_id in ids.values()))
    found = {name: state(run_id) for name, run_id in ids.items()}
    wanted = {"grasp": "succeeded", "cancelled": "cancelled", "failed": "failed"}
    if found != wanted | {"phystwin": "succeeded", "saved": "succeeded"}:
        raise RuntimeError(f"the runs ended otherwise: {found}")
    about = {
        "name": "Sheet, the good one",
        "tags": ["best", "cloth"],
        "note": "Two corners are lifted.\nδ is what the search chose.",
    }
    client.patch("/api/v1/runs/quick", json=about).raise_for_status()
    client.patch(f"/api/v1/runs/{grasp}", json={"tags": ["hand"]}).raise_for_status()
    return ids


def keep_presets(data: Path) -> None:
    """Keep a preset as the panel does, and one as people write them by hand."""
    store = PresetStore(data / "presets")
    store.save("Wet towel", {"drag": 6.0, "stiffness_scale": 0.3}, "m")
    store.save("No ground, fine", {"ground_height": None, "substeps_per_frame": "auto"}, "m")
    by_hand = {
        "format": "physhandi-preset/1",
        "name": "Wide",
        "parameters": {"connection_radius": 0.035, "self_collision": True},
    }
    (data / "presets" / "by_hand.json").write_text(json.dumps(by_hand, indent=1) + "\n")


def states(ids: dict[str, str]) -> list[tuple[str, str, str, SessionState]]:
    """What people set up in live scenes: a title, kind and id of what is shown, and the state."""
    usual = state_from_query({})
    look = Pose(
        position=np.array([0.31, -0.42, 0.55]),
        look_at=np.array([0.02, 0.03, 0.11]),
        up=np.array([0.0, 0.6, 0.8]),
        fov=np.radians(38.5),
    )
    inspecting = Layers(
        hands=False,
        surface=True,
        all_controls=True,
        object_springs=True,
        forces=False,
        observed=True,
        cameras=False,
        ground=False,
        force_scale=2.5,
        color="strain",
        color_range=(-0.025, 0.025),
    )
    posed = replace(usual, frame=6, pose=look, layers=inspecting, theme="dark")
    playing = replace(usual, frame=2, is_playing=True, speed=0.25, does_loop=False)
    changes = {
        "connection_radius": 0.031,
        "max_neighbors": 9,
        "virtual_connection_radius": 0.011,
        "stiffness_scale": 0.4,
        "damping": 12.5,
        "drag": 3.0,
        "gravity": 1.62,
        "ground_height": None,
        "self_collision": True,
    }
    tweaked = replace(usual, frame=3, parameter_changes=changes, automatic_substeps=True)
    counted = replace(usual, frame=7, parameter_changes={"substeps_per_frame": 240})
    seen = replace(usual, frame=1, layers=Layers(looks_from="front", color="error"))
    figure = replace(usual, frame=2, is_figure=True)
    return [
        ("camera, layers and colors", "run", "quick", posed),
        ("a clock", "run", ids["phystwin"], replace(playing, sequence_name="sheet")),
        ("parameters and automatic substeps", "run", "quick", tweaked),
        ("a number of substeps", "run", "quick", counted),
        ("from a camera", "run", ids["grasp"], seen),
        ("the figure", "run", ids["grasp"], figure),
        ("a recording", "sequence", "grasp", replace(usual, frame=2, pose=look)),
    ]


def describe_state(state: SessionState) -> dict[str, Any]:
    """What a link means, in plain data."""
    layers = dict(state.layer_changes)
    return {
        "sequence_name": state.sequence_name,
        "frame": state.frame,
        "is_playing": state.is_playing,
        "speed": state.speed,
        "does_loop": state.does_loop,
        "theme": state.theme,
        "is_figure": state.is_figure,
        "automatic_substeps": state.automatic_substeps,
        "layer_changes": layers,
        "parameter_changes": dict(state.parameter_changes),
        "pose": state.pose
        and {
            "position": state.pose.position.tolist(),
            "look_at": state.pose.look_at.tolist(),
            "up": state.pose.up.tolist(),
            "fov": state.pose.fov,
        },
    }


def record_links(client: TestClient, ids: dict[str, str]) -> dict[str, Any]:
    """Write the addresses of live scenes, comparisons and lists, and what they mean."""
    scenes: list[dict[str, Any]] = []
    for title, kind, target, state in states(ids):
        query = state_to_query(state)
        opened = client.get(address(kind, target, query), follow_redirects=False)
        session = opened.headers["location"].partition("?")[0].rpartition("/")[2]
        told = client.get(f"/api/v1/sessions/{session}/link").json()["url"]
        client.delete(f"/api/v1/sessions/{session}")
        scenes.append(
            {
                "title": title,
                "address": address(kind, target, query),
                "query": query,
                "state": describe_state(state_from_query(query)),
                "link_of_the_open_scene": told,
            }
        )
    asks = [
        CompareAsk(a="quick", b="softer"),
        CompareAsk(
            a="quick", b=ids["phystwin"], mode="wipe", color="difference", f=5, sequence="sheet"
        ),
    ]
    comparisons = [
        {"address": f"/compare?{ask.query}", "fields": ask.model_dump(exclude={"kind"})}
        for ask in asks
    ]
    queries = [
        RunQuery(q="tag:best"),
        RunQuery(q="-is:bundled is:published", sort="-fitted", limit=3),
        RunQuery(state="failed"),
        RunQuery(kind="simulation", sort="name", sequence="sheet"),
    ]
    lists = [
        {
            "address": query.address(),
            "runs": [
                run["id"]
                for run in client.get(query.address("/api/v1/runs")).json()["runs"]
                if not run["is_bundled"]
            ],
        }
        for query in queries
    ]
    return {"scenes": scenes, "comparisons": comparisons, "lists": lists}


def record_answers(client: TestClient, ids: dict[str, str], data: Path) -> dict[str, Any]:
    """Write what the program said of the folder; what the files of a run say themselves is not."""

    def get(path: str) -> Any:
        answer = client.get(path)
        answer.raise_for_status()
        return answer.json()

    names = {"quick": "quick", "softer": "softer"} | ids
    runs = [run["id"] for run in get("/api/v1/runs")["runs"] if not run["is_bundled"]]
    pages = [page.format(**names) for page in PAGES]
    pages += [f"/runs/{run_id}" for run_id in runs]
    pages += [f"/suites/{path.name}" for path in sorted((data / "suites").iterdir())]
    for page in pages:
        client.get(page, headers={"Accept": "text/html"}).raise_for_status()
    described = {run_id: get(f"/api/v1/runs/{run_id}") for run_id in runs}
    for run in described.values():
        for volatile in ("revision", "estimate", "results"):
            run.pop(volatile, None)
    settings = {
        run_id: {setting["path"]: setting["value"] for setting in found["settings"]}
        for run_id in ("quick", ids["grasp"], ids["phystwin"])
        if (found := get(f"/api/v1/settings?run={run_id}"))
    }
    return {
        "commit": COMMIT,
        "ids": names,
        "runs": described,
        "settings": settings,
        "sequences": [s for s in get("/api/v1/sequences")["sequences"] if not s["is_bundled"]],
        "comparison": get("/api/v1/comparison?a=quick&b=softer"),
        "pages": pages,
    }


def link_fields() -> list[dict[str, str]]:
    """Give a query for each field of a scene's link, and for each value that it names."""
    known = [
        *({key: value} for key in permalink._CHOICES for value in permalink._CHOICES[key]),
        *({"show": layer} for layer in permalink._SWITCHES),
        *({"theme": theme} for theme in THEMES),
        *({key: "1"} for key in ("f", "fig", "play", "loop")),
        {"sequence": "sheet"},
        {"range": "0,1"},
        {"scale": "2"},
        {"from": "front"},
        {"speed": "0.5"},
        POSE,
        POSE | {"fov": "50"},
        POSE | {"up": "0,1,0"},
        {"substeps_per_frame": "auto"},
        {"ground_height": "none"},
    ]
    usual = SimulationParameters().to_dict()
    for name in permalink._PARAMETERS:
        value = 0.0 if usual[name] is None else usual[name]
        known.append({name: permalink._parameter_text(value)})
    return known


def comparison_fields() -> list[dict[str, str]]:
    """Give a query for each field of a comparison's address, and for each value that it names."""
    both = {"a": "quick", "b": "softer"}
    named = {name: get_args(field.annotation) for name, field in CompareAsk.model_fields.items()}
    choices = [both | {key: value} for key in ("mode", "color") for value in named[key]]
    return [both, both | {"sequence": "sheet"}, both | {"f": "3"}, *choices]


def list_fields() -> list[str]:
    """Give an address for each field of a list of runs, and for each value that it names."""
    words = [f"is:{flag}" for flag in listing._FLAGS] + ["-tag:best", "quick"]
    words += [f"{key}:sheet" for key in listing._KEYS if key != "is"]
    fields = [{"q": word} for word in words]
    fields += [{"sort": f"{sign}{name}"} for name in listing.SORTS for sign in ("", "-")]
    fields += [{name: "x"} for name in ("state", "profile", "sequence", "kind")]
    fields += [{"limit": "5"}, {"offset": "1"}]
    return [listing.RunQuery.model_validate(field).address() for field in fields]


def record_surface(server: FastAPI, client: TestClient, grasp: str) -> dict[str, Any]:
    """List what people can reach."""
    return {
        "commands": surface.commands(cli.main),
        "addresses": surface.addresses(server),
        "answers": surface.answers(client, grasp),
        "settings": surface.settings(client),
        "server settings": sorted(f"PHYSHANDI_{name.upper()}" for name in Settings.model_fields),
        "keys": surface.keys(KEYS),
        "presets": [preset.name for preset in builtin_presets()],
        "links": link_fields(),
        "links of comparisons": comparison_fields(),
        "lists": list_fields(),
        "controls": surface.scenes(
            server.state.sessions, grasp, ViewerClient, lambda _, told: told.listen(5.0)
        ),
    }


def smallest_picture(client: TestClient, data: Path) -> tuple[str, bytes]:
    """Have the pictures of the list drawn; give name and content of the smallest one of a run."""
    folder = data / "cache" / "previews"
    client.get("/runs", headers={"Accept": "text/html"}).raise_for_status()
    until(lambda: len(list(folder.glob("run-*.still.webp"))) > 2)
    picture = min(folder.glob("run-*.still.webp"), key=lambda path: path.stat().st_size)
    return picture.name, picture.read_bytes()


def export_files(root: Path, links: dict[str, Any]) -> None:
    """Export a run as it is, and as two of the links change its parameters."""
    own = ("--data-dir", f"{root}/data", "--device", "cpu", "--overwrite")
    for kind in ("npz", "csv", "yaml"):
        command_line(
            "export", "quick", "--format", kind, "--out", f"{root}/exports/fitted.{kind}", *own
        )
    for scene in links["scenes"]:
        if scene["state"]["parameter_changes"]:
            out = f"{root}/exports/{scene['title'].replace(' ', '_')}.npz"
            link = ("--link", scene["address"])
            command_line("export", "quick", "--format", "npz", "--out", out, *link, *own)


def pack(folders: tuple[Path, ...], archive: Path) -> None:
    """Pack folders with their empty folders, hidden files and times, but nobody's name."""

    def nobody(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.uid = entry.gid = 0
        entry.uname = entry.gname = ""
        return entry

    with tarfile.open(archive, "w:xz", format=tarfile.PAX_FORMAT, preset=9) as stream:
        for folder in folders:
            stream.add(folder, folder.name, filter=nobody)


def main() -> None:
    """Make everything below the folder that is named."""
    if sys.argv[1] == "--cut":
        cut_short(Path(sys.argv[2]))
        return
    commit = describe_environment("cpu")["commit"] or ""
    if not commit.startswith(COMMIT):
        sys.exit(f"This is made by commit {COMMIT}, but the checkout is at {commit or 'none'}.")
    root = Path(sys.argv[1])
    data = root / "data"
    shutil.rmtree(data, ignore_errors=True)
    write_grasp(data / "sequences" / "grasp")
    write_sheet(data / "sequences" / "sheet", lift=0.04)
    write_sheet(data / "sequences" / "sheet_high", lift=0.06)
    make_runs_by_commands(data)
    keep_presets(data)
    run_index._WORTH_SAVING = 1
    settings = Settings(data_dir=data, token=SecretStr(TOKEN), device="cpu")
    catalog = Catalog(settings, bundled=root / "no-bundled-sequences")
    scheduler = Scheduler(settings, catalog)
    server = create_app(settings, catalog=catalog, scheduler=scheduler)
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(server, "http://127.0.0.1:8080", headers=bearer) as client:
        saver = RunSaver(catalog, settings.run_dir, scheduler.start_now)
        ids = make_runs_by_server(client, saver, data)
        links = record_links(client, ids)
        name, picture = smallest_picture(client, data)
        answers = record_answers(client, ids, data)
        reached = record_surface(server, client, ids["grasp"])
    # Nothing starts it any more, so it waits in the folder as it does when a server has stopped.
    ids["waiting"] = scheduler.launch(["sheet"], "quick", "Waits for the next server").id
    answers["ids"] = answers["ids"] | ids
    shutil.rmtree(data / "cache" / "previews")
    (data / "cache" / "previews").mkdir()
    (data / "cache" / "previews" / name).write_bytes(picture)
    shutil.rmtree(data / "cache" / "exports", ignore_errors=True)
    export_files(root, links)
    pack((data, root / "exports"), root / "data.tar.xz")
    records = {"expected": answers, "permalinks": links, "surface": reached}
    for name, content in records.items():
        text = json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False)
        (root / f"{name}.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
