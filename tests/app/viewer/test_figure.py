import csv
import io
import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import (
    FRAMES,
    PARAMETERS,
    FakeSettings,
    FolderCatalog,
    content_of,
    hear_all,
    sheet,
)

from app.exports.permalink import state_from_query
from app.viewer.compare.camera import ComparisonCameras, Eye
from app.viewer.compare.drawing import ARROWS, CompareDrawing, Look, legend_force
from app.viewer.compare.sides import ComparedSide
from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose
from app.viewer.export.snapshot import Snapshot, snapshot_csv, snapshot_npz
from app.viewer.scene.framing import frame_content
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

FRAME = 12
SIDES = {"ours": "a", "phystwin": "b"}
"""Names of both sides in files, and their keys in the scene."""
TURNED = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""A camera whose right hand is the world's y axis."""


@pytest.fixture(scope="module")
def session(root: Path) -> Iterator[Session]:
    """A run that rests at a frame, and in which PhysTwin's side is simulated once."""
    sessions = Sessions(FakeSettings(), FolderCatalog(root))
    at_rest = state_from_query({"f": str(FRAME)})
    session = sessions.get(sessions.open("run", "sheet", "me", state=at_rest))
    assert isinstance(session, Session)
    yield session
    sessions.shutdown()


@pytest.fixture
def client(session: Session) -> Iterator[ViewerClient]:
    """A browser with the figure; the scene comes back after it."""
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        enter(client)
        yield client
        # While it is connected: viser warns of cameras that are moved back for nobody.
        session._comparison.stop()


def enter(client: ViewerClient) -> None:
    client.set("Compare with PhysTwin", True)
    done = f"PhysTwin-style: simulated {FRAMES}/{FRAMES} frames"
    client.until(lambda: done in said(client) and "/compare/b/figure/forces" in client.nodes)
    # The arrow scale is chosen anew when both rollouts are known.
    client.until(lambda: shown_force(client) > 0)
    # The camera is moved before the figure is drawn, but in messages of its own.
    client.until(lambda: client.camera["fov"] < 0.3 and client.camera["position"][0] != 1.0)


def said(client: ViewerClient) -> str:
    return "\n".join(str(p["content"]) for p in client.gui.values() if "content" in p)


def shown_force(client: ViewerClient) -> float:
    return float(text_of(client, "legend/text_3").removeprefix("force, ")[:-2] or 0)


def text_of(client: ViewerClient, label: str) -> str:
    return str(client.nodes.get(f"/compare/{label}", {}).get("text", ""))


def place_of(client: ViewerClient, name: str) -> ndarray:
    return np.array(client.positions.get(f"/compare/{name}", (np.nan,) * 3))


def arrows(client: ViewerClient, name: str) -> ndarray:
    return client.nodes.get(name, {}).get("points", np.zeros(0)).reshape(-1, 2, 3)


def lengths_of(client: ViewerClient, name: str) -> ndarray:
    arrow = arrows(client, name)
    return np.linalg.norm(arrow[:, 1] - arrow[:, 0], axis=1)


def rolled_out(run: Run) -> ObjectRollout:
    """Simulate PhysTwin's way without the live process."""
    control = run.array("sequences/lift/control.npy")
    values = PARAMETERS.replace(
        virtual_connection_radius=0.04,
        virtual_max_neighbors=50,
        virtual_stiffness=PARAMETERS.stiffness,
        virtual_rest_length_floor=1e-4,
        use_control_velocity=False,
    )
    model = build_model(sheet(), control[0], values)
    motion = Simulator(model, values).rollout(control)
    return ObjectRollout(
        model=model,
        parameters=values,
        control=control,
        position=motion.position,
        velocity=motion.velocity,
        ready=FRAMES,
    )


def test_both_sides_are_shown_in_one_scale_and_the_scene_comes_back(
    client: ViewerClient, session: Session, run: Run
) -> None:
    session._playback.redraw()
    rival = session._comparison._phystwin.newest
    ours = run.array("sequences/lift/rollout.npy")[FRAME]
    for side, expected in (("a", ours), ("b", rival.position[FRAME])):
        name = f"/compare/{side}/figure/object/nodes"
        client.until(
            lambda name=name, expected=expected: np.array_equal(
                client.array(name, "batched_positions"), expected
            )
        )
    assert np.abs(rival.position[FRAME] - ours).max() > 1e-3
    client.until(lambda: text_of(client, "title_a") == "ours")
    detail = f"δ 40 mm · d_max 50 · {recount(run, 0.04, 50)} virtual springs"
    client.until(lambda: text_of(client, "detail_b") == detail)
    other = f"δ 20 mm · d_max 3 · {recount(run, 0.02, 3)} virtual springs"
    client.until(lambda: text_of(client, "detail_a") == other)
    client.until(lambda: "both sides use them" in said(client))
    strengths = {
        side: np.sort(np.linalg.norm(rollout.forces(FRAME), axis=1))[::-1]
        for side, rollout in (("a", session._content.fitted), ("b", rival))
    }

    def is_to_scale() -> bool:
        """Whether one length means one force on both sides, and in the legend."""
        units = [lengths_of(client, "/compare/legend/force") / shown_force(client)]
        for side, strength in strengths.items():
            length = lengths_of(client, f"/compare/{side}/figure/forces")
            if len(length) <= 10:
                return False
            units.append(length / strength[: len(length)])
        unit = np.concatenate(units)
        return len(units[0]) == 1 and np.allclose(unit, unit[0], rtol=1e-3, atol=0)

    client.until(is_to_scale)
    client.until(lambda: client.visible.get("/object/surface") is False)
    client.tell_camera()
    client.set("Back to the scene", True)
    client.until(lambda: client.visible["/object/surface"] and client.camera["fov"] > 0.5)
    client.until(lambda: client.camera["look_at"] == pytest.approx([0, 0, 0]))
    client.until(lambda: client.camera["position"] == pytest.approx([1, 1, 1]))
    assert session._comparison._view is None
    assert client.camera["fov"] == pytest.approx(0.8)


def recount(run: Run, radius: float, most: int) -> int:
    """Count the virtual springs by looking at every control node alone."""
    control = run.array("sequences/lift/control.npy")[0]
    distance = np.linalg.norm(control[:, None] - sheet()[None], axis=2)
    return int(np.minimum((distance < radius).sum(axis=1), most).sum())


def test_the_halves_stay_left_and_right_as_the_camera_turns(client: ViewerClient) -> None:
    # The camera looks along z with the world's x to its right.
    client.tell_camera(wxyz=(1.0, 0.0, 0.0, 0.0))
    client.until(lambda: place_of(client, "b")[0] > 0.05)
    client.until(lambda: np.allclose(place_of(client, "b")[1:], 0, atol=1e-6))
    right = place_of(client, "b")
    client.until(lambda: np.allclose(place_of(client, "a"), -right, atol=1e-6))
    client.tell_camera(wxyz=TURNED)
    client.until(lambda: place_of(client, "b")[1] > 0.05)
    x, _, z = place_of(client, "b")
    assert (x, z) == pytest.approx((0, 0), abs=1e-6)
    up = Eye.of(np.array(TURNED)).up
    client.until(
        lambda: (place_of(client, "title_a") - place_of(client, "legend/text_0")) @ up > 0.05
    )


def test_the_live_process_holds_the_object_in_phystwins_way(run) -> None:
    expected = rolled_out(run)
    fitted = FittedObject.of(run, "lift")
    rollout = fitted.begin(expected.parameters, controls=range(30))
    model, control = rollout.model, rollout.control
    assert model.object_spring_count == fitted.model.object_spring_count
    np.testing.assert_array_equal(model.spring_nodes, expected.model.spring_nodes)
    np.testing.assert_allclose(model.rest_length, expected.model.rest_length, rtol=1e-6)
    np.testing.assert_array_equal(model.stiffness, expected.model.stiffness)
    motion = Simulator(model, expected.parameters).rollout(control)
    np.testing.assert_allclose(motion.position, expected.position, atol=1e-5)
    some = fitted.begin(expected.parameters, controls=[3, 17])
    np.testing.assert_array_equal(some.control, fitted.fitted.control[:, [3, 17]])
    held = some.model.spring_nodes[model.object_spring_count :, 1]
    assert set(held.tolist()) == {81, 82}
    everything = fitted.begin(PARAMETERS)
    assert everything.control.shape[1] == 30
    assert everything.model is fitted.model


def test_the_downloads_hold_positions_springs_and_forces_of_both_sides(run) -> None:
    content = content_of({}, run.array("sequences/lift/control.npy"))
    ours, rival = replace_rollout(content.fitted, run), rolled_out(run)
    snapshot = Snapshot(
        content=content,
        frame=FRAME,
        rollout=ours,
        rollout_frame=FRAME,
        compared={"ours": (ours, FRAME), "phystwin": (rival, FRAME)},
    )
    with np.load(io.BytesIO(snapshot_npz(snapshot))) as saved:
        for name, rollout in (("ours", ours), ("phystwin", rival)):
            np.testing.assert_array_equal(saved[f"{name}_position"], rollout.position)
            np.testing.assert_array_equal(saved[f"{name}_control"], rollout.control)
            np.testing.assert_array_equal(saved[f"{name}_spring_nodes"], rollout.model.spring_nodes)
            np.testing.assert_array_equal(saved[f"{name}_force"][FRAME], rollout.forces(FRAME))
            assert saved[f"{name}_frame"] == FRAME
        forces = {name: saved[f"{name}_force"][FRAME] for name in SIDES}
    rows = list(csv.DictReader(io.StringIO(snapshot_csv(snapshot).decode())))
    for name, rollout in (("ours", ours), ("phystwin", rival)):
        own = [row for row in rows if row["side"] == name]
        kinds = [row["kind"] for row in own]
        assert kinds.count("node") == 81
        assert kinds.count("virtual_spring") == rollout.model.virtual_spring_count > 20
        # The springs' forces, summed over each node, are the node's force.
        total = np.zeros((81, 3))
        for row in own:
            force = [float(row[f"force_{axis}_N"]) for axis in "xyz"]
            if row["kind"] == "virtual_spring":
                total[int(row["node"])] += force
                place = [float(row[f"{axis}_m"]) for axis in "xyz"]
                control = rollout.control[FRAME, int(row["control"])]
                np.testing.assert_allclose(place, control, atol=1e-6)
                stretched = np.linalg.norm(control - rollout.position[FRAME, int(row["node"])])
                assert float(row["length_m"]) == pytest.approx(stretched, rel=1e-5)
        np.testing.assert_allclose(total, forces[name], atol=1e-3)
        assert np.abs(total).max() > 1.0


def replace_rollout(rollout: ObjectRollout | None, run: Run) -> ObjectRollout:
    assert rollout is not None
    rollout.position = run.array("sequences/lift/rollout.npy")
    return rollout


def test_no_side_streams_more_than_300_arrows_or_too_many_bytes(server_client) -> None:
    rng = np.random.default_rng(5)
    node = rng.uniform(-0.1, 0.1, (2_000, 3)).astype(np.float32)
    control = np.repeat(rng.uniform(-0.1, 0.1, (1, 900, 3)).astype(np.float32), 3, axis=0)
    control += np.linspace(0, 0.02, 3, dtype=np.float32)[:, None, None]
    content = content_of({}, control)
    model = build_model(node, control[0], PARAMETERS)
    assert model.object_spring_count > 4_000
    position = node + np.linspace(0, 0.01, 3, dtype=np.float32)[:, None, None]
    rollout = ObjectRollout(
        model=model, parameters=PARAMETERS, control=control, position=position, ready=3
    )
    assert (np.linalg.norm(rollout.forces(2), axis=1) > 1e-6).sum() > 2 * ARROWS
    server, client = server_client
    look = Look(tint="parts")
    drawing = CompareDrawing(server, content, frame_content(content), [rollout], look)
    sides = {
        key: ComparedSide(
            name=name,
            title=name,
            detail="",
            rollout=rollout,
            frame=1,
            content=content,
            content_frame=1,
        )
        for name, key in SIDES.items()
    }
    layers = Layers(object_springs=True)
    drawing.draw(sides, layers, "nodes", is_playing=True)
    hear_all(server, client)
    before = client.bytes_received
    later = {key: replace(side, frame=2, content_frame=2) for key, side in sides.items()}
    drawing.draw(later, layers, "nodes", is_playing=True)
    hear_all(server, client)
    for side in "ab":
        assert 100 < len(arrows(client, f"/compare/{side}/figure/forces")) <= ARROWS == 300
    assert 60_000 < client.bytes_received - before < 100_000


def test_a_picture_is_centered_on_what_is_seen_beside_the_panel(server_client) -> None:
    server, _ = server_client
    (seen,) = (c for c in server.get_clients().values())
    camera = seen.camera
    box = (np.zeros(3), 0.4, 0.1)
    view = ComparisonCameras(lambda: 1.0).picture(seen, box)
    # 640 pixels are too few for the panel to be taken into account: all of the width is kept.
    assert (view["width"], view["position"].tolist()) == (1600, camera.position.tolist())
    camera_high = 2 * np.tan(0.4) * np.sqrt(3)
    eye = Eye.of(camera.wxyz)
    reach = abs(camera.look_at @ eye.up) + 0.05
    assert view["height"] == pytest.approx(1600 * 480 / 640 * 2 * reach / camera_high, abs=1)
    kept = np.tan(view["fov"] / 2) / np.tan(0.4)
    assert kept == pytest.approx(view["height"] / 1200, abs=1e-3)


def test_the_panel_covers_more_pixels_of_a_sharper_screen(server_client) -> None:
    server, client = server_client
    box, views = (np.zeros(3), 0.4, 0.1), list[dict[str, Any]]()
    (seen,) = server.get_clients().values()
    pose = Pose.of(seen.camera)
    for ratio in (1, 2):
        width, height = 1280 * ratio, 720 * ratio
        client.tell_camera(image_width=width, image_height=height)
        client.until(lambda width=width: seen.camera.image_width == width)
        cameras = ComparisonCameras(lambda ratio=ratio: ratio)
        cameras.aim(seen, pose, box)
        views.append(cameras.picture(seen, box) | {"stands": seen.camera.position})
    one, two = views
    for name in ("position", "stands", "width", "height", "fov"):
        assert two[name] == pytest.approx(one[name], rel=1e-9)
    # The middle of both sides is left of the picture's, by half of the panel's 345 pixels.
    eye = Eye.at(pose)
    aside = (one["stands"] - one["position"]) @ eye.right
    distance = (seen.camera.look_at - one["stands"]) @ eye.ahead
    assert aside / distance / (2 * np.tan(np.deg2rad(14) / 2)) * 720 == pytest.approx(345 / 2)


def test_the_force_of_the_legend_is_round() -> None:
    for exponent, step in itertools.product(range(-3, 4), (1.0, 1.7, 3.3, 9.9)):
        force = legend_force(0.16 * 0.7 / (step * 10.0**exponent), 0.7) / 10.0**exponent
        assert force == pytest.approx(max(s for s in (1, 2, 5) if s <= step))
    assert legend_force(0.0, 0.7) == 0.0
