"""A small run: a sheet held by 30 control points, in two sequences of 20 frames."""

import itertools
from collections.abc import Sequence as Listing
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import viser
from numpy import ndarray

from app.benchmarks.viewer_client import ViewerClient
from app.viewer.content.content import Content, ShownHand
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.data.view import View
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

FRAMES = 20
_MARKS = itertools.count()
PARAMETERS = SimulationParameters(
    connection_radius=0.035,
    max_neighbors=12,
    virtual_connection_radius=0.02,
    virtual_max_neighbors=3,
    stiffness=500.0,
    virtual_stiffness=800.0,
    damping=2.0,
    substeps_per_frame=30,
)


@dataclass(frozen=True)
class FolderCatalog:
    """Finds runs and sequences below a folder."""

    root: Path

    def run(self, run_id: str, /) -> Run:
        return Run.open(self.root / "runs" / run_id)

    def sequence(self, sequence_id: str, /) -> Sequence:
        return Sequence.load(self.root / "sequences" / sequence_id)

    def sequences_of(self, run: Run, /) -> list[SimpleNamespace]:
        """Give where recordings of a run would be."""
        return [SimpleNamespace(folder=self.root / name) for name in run.sequence_names]


@dataclass
class FakeSettings:
    live_sessions: int = 3
    live_sessions_each: int = 100
    live_idle_s: float = 900.0
    live_device: str = "cpu"


def show_parts(client: ViewerClient) -> None:
    """Show nodes and springs of the object in place of its surface."""
    client.set("Surface", False)
    for part in ("Object nodes", "Control nodes", "Virtual springs", "Object springs"):
        client.set(part, True)
    client.until(lambda: {"/object/nodes", "/springs/virtual"} <= set(client.nodes))


def rest_at(client: ViewerClient, frame: int) -> None:
    """Stop the clock at a frame, once it plays as it does when somebody looks."""
    client.until(lambda: client.find("Pause"))
    client.set("Pause", True)
    client.until(lambda: client.find("Play"))
    # A slider that stands at a value already is not heard: by way of another frame it is.
    client.set("Frame", frame - 1 if frame else 1)
    client.set("Frame", frame)


def hear_all(server: viser.ViserServer, client: ViewerClient) -> None:
    """Take in all that a server has said until now, and one message more."""
    mark = f"all until mark {next(_MARKS)}."
    server.gui.set_panel_label(mark)
    client.until(lambda: any(message.get("label") == mark for message in client.messages))


def sheet() -> ndarray:
    line = np.linspace(-0.1, 0.1, 9)
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], axis=1).astype(np.float32)


def controls(direction: tuple[float, float, float]) -> ndarray:
    rng = np.random.default_rng(7)
    start = np.concatenate([rng.uniform(-0.05, 0.05, (30, 2)), np.full((30, 1), 0.055)], axis=1)
    way = 0.08 * np.sin(np.linspace(0, np.pi / 2, FRAMES))[:, None, None]
    return (start + way * np.array(direction)).astype(np.float32)


def make_run(folder: Path) -> Run:
    run = Run.create(
        folder,
        name="a sheet <b>bold</b>",
        kind="reconstruction",
        sequences=["lift", "drag"],
        config={},
    )
    with run.begin_attempt() as attempt:
        attempt.save_yaml("object/parameters.yaml", PARAMETERS.to_dict())
        attempt.save_tensors("object/material.safetensors", {"rest_node": sheet()})
        for name, direction in (("lift", (0.0, 0.0, 1.0)), ("drag", (1.0, 0.0, 0.2))):
            control = controls(direction)
            model = build_model(sheet(), control[0], PARAMETERS)
            position = Simulator(model, PARAMETERS).rollout(control).position
            at = f"sequences/{name}"
            attempt.save_array(f"{at}/rollout.npy", position)
            attempt.save_array(f"{at}/control.npy", control)
            attempt.save_tensors(f"{at}/model.safetensors", model.to_tensors())
            attempt.save_array(f"{at}/observation/point.npy", position[:, ::4])
            seen = np.ones(position[:, ::4].shape[:2], dtype=bool)
            attempt.save_array(f"{at}/observation/is_visible.npy", seen)
            attempt.save_yaml(
                f"{at}/meta.yaml",
                {
                    "frame_rate": 30.0,
                    "frame_count": FRAMES,
                    "metric": True,
                    "length_unit": "m",
                    "ground_height": 0.0,
                    "gravity": 9.81,
                    "reconstruction_frames": 15,
                },
            )
        attempt.publish()
    return Run.open(folder)


def content_of(
    hands: dict[str, tuple[ndarray, ndarray]], control: ndarray, views: Listing[View] = ()
) -> Content:
    """A resting sheet with these hands, each with its vertices and faces, and control nodes."""
    model = build_model(sheet(), control[0], PARAMETERS)
    position = np.repeat(sheet()[None], len(control), axis=0)
    fitted = ObjectRollout(
        model=model, parameters=PARAMETERS, control=control, position=position, ready=len(control)
    )
    surfaces = tuple(
        ShownHand(side=side, vertex=np.repeat(vertex[None], len(control), axis=0), face=face)
        for side, (vertex, face) in hands.items()
    )
    return Content(
        title="t",
        sequence_name="lift",
        frame_count=len(control),
        frame_rate=30.0,
        reconstruction_count=len(control),
        length_unit="m",
        ground_height=0.0,
        hands=surfaces,
        control=control,
        fitted=fitted,
        views=views,
    )


def look_at(eye: tuple[float, float, float]) -> PinholeCamera:
    ahead = -np.array(eye) / np.linalg.norm(eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, np.array(eye)], axis=1)
    K = np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    return PinholeCamera(K, pose, 64, 48, np.array([0.05, 0.0, 0.0, 0.0, 0.0]))


@dataclass(frozen=True)
class Recording:
    """A sequence of which the truth is known."""

    sequence: Sequence
    keypoint: ndarray = field(repr=False)


def make_sequence(folder: Path) -> Recording:
    rng = np.random.default_rng(3)
    keypoint = rng.uniform(-0.1, 0.1, (4, 1, 21, 3))
    cameras = [look_at((0.5, 0.1, 0.3)), look_at((-0.2, 0.6, 0.2))]
    with SequenceWriter(folder) as writer:
        for index, camera in enumerate(cameras):
            seen = np.concatenate([camera.project(keypoint), np.ones((4, 1, 21, 1))], axis=-1)
            seen[3, 0, 5] = np.nan
            writer.save_array(f"views/view{index}/keypoint.npy", seen.astype(np.float32))
            for frame in range(4):
                at = f"views/view{index}/{{}}/{frame:05d}.png"
                depth = np.zeros((48, 64), np.uint16)
                depth[20:28, 30:34] = 400 + 10 * frame
                writer.save_image(at.format("depth"), depth)
                writer.save_image(at.format("color"), np.full((48, 64, 3), 40 * frame, np.uint8))
        views = tuple(ViewMeta(name=f"view{i}", camera=c) for i, c in enumerate(cameras))
        meta = SequenceMeta(
            name=folder.name, frame_rate=30.0, frame_count=4, hands=("right",), views=views
        )
        sequence = writer.finish(meta)
    return Recording(sequence, keypoint[:, 0])
