"""Small pictures of sequences and runs: what they show, how they are made and kept."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image, ImageSequence
from support.server.server_world import World
from support.waiting import LIMIT_S, until

from app.previews import store, worker
from app.previews.camera import fitting_camera
from app.previews.clip import clip_of_run, clip_of_sequence
from app.previews.draw import HEIGHT, WIDTH, PreviewMotion, draw_motion
from app.previews.store import Previews
from app.settings import BUNDLED
from physhandi.child import PACKAGE_ROOT, ChildEndedError
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.simulation.object_surface import lay_surface

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


def colored(picture: np.ndarray, channel: int) -> np.ndarray:
    """Pixels (y, x) in which a channel is much stronger than the other two."""
    solid = picture[picture[..., 3] > 200].astype(int)
    where = np.argwhere(picture[..., 3] > 200)
    others = [c for c in range(3) if c != channel]
    return where[solid[:, channel] > solid[:, others].max(axis=1) + 40]


def test_a_camera_fills_the_picture_from_above_and_in_front() -> None:
    rng = np.random.default_rng(0)
    point = rng.uniform([-0.2, 0.3, 0.0], [0.4, 0.5, 0.1], (4000, 3))
    camera = fitting_camera(point, 384, 240)
    pixel = camera.project(point)
    low, high = pixel.min(axis=0), pixel.max(axis=0)
    assert (low > -2).all()
    assert (high < [386, 242]).all()
    assert ((high - low) / [384, 240]).max() > 0.8
    np.testing.assert_allclose((low + high) / 2, [192, 120], atol=6)
    top, bottom = camera.project(np.array([[0.1, 0.4, 0.1], [0.1, 0.4, 0.0]]))
    assert top[1] < bottom[1] - 5
    assert camera.T_world_camera[2, 3] > 0.1
    assert np.isfinite(fitting_camera(np.zeros((1, 3)), 384, 240).project(np.zeros((1, 3)))).all()


def test_a_point_is_drawn_where_the_camera_sees_it_on_a_clear_ground() -> None:
    moved = np.stack([SQUARE, SQUARE + np.array([0.0, 0.0, 0.5])])
    first, second = draw_motion(PreviewMotion(marker=moved), [0, 1])
    assert first.shape == (HEIGHT, WIDTH, 4)
    assert (first[..., 3] == 0).mean() > 0.9
    camera: PinholeCamera = fitting_camera(moved.reshape(-1, 3), WIDTH, HEIGHT)
    for picture, point in ((first, moved[0]), (second, moved[1])):
        green = colored(picture, 1)
        seen = camera.project(point)[:, ::-1]
        nearest = np.linalg.norm(green[:, None] - seen[None], axis=-1).min(axis=0)
        assert nearest.max() < 3.0
        assert np.linalg.norm(green[:, None] - seen[None], axis=-1).min(axis=1).max() < 12.0
    assert colored(second, 1)[:, 0].mean() < colored(first, 1)[:, 0].mean() - 10


def test_the_surface_of_an_object_is_drawn_in_its_own_colors_in_place_of_its_nodes() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 8))
    node = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    surface = lay_surface(node, kind="sheet")
    red = np.tile(np.array([220, 20, 20], np.uint8), (surface.vertex_count, 1))
    pairs = np.stack([np.arange(63), np.arange(1, 64)], axis=1)
    motion = PreviewMotion(node=node[None], spring=pairs, surface=replace(surface, color=red))
    picture = draw_motion(motion, [0])[0]
    covered = int((picture[..., 3] > 200).sum())
    assert len(colored(picture, 0)) > 0.98 * covered > 10_000
    assert len(colored(draw_motion(replace(motion, surface=surface), [0])[0], 2)) > 10_000


def test_a_surface_hides_what_lies_behind_it_and_not_what_lies_before() -> None:
    face = np.array([[0, 1, 2], [0, 2, 3]])
    wall = SQUARE[:, [0, 2, 1]][None]
    spots = {"before": [0.2, -0.5, 0.0], "behind": [-0.2, 0.5, 0.0]}
    counts = {}
    for name, spot in spots.items():
        motion = PreviewMotion(hands=((wall, face),), control=np.array([[spot]]))
        counts[name] = len(colored(draw_motion(motion, [0])[0], 0))
    assert counts["behind"] == 0
    assert counts["before"] > 20


def test_nothing_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        draw_motion(PreviewMotion(marker=np.full((2, 3, 3), np.nan)), [0])


def test_clips_keep_the_pace_and_show_video_points_or_what_was_fitted(world: World) -> None:
    towel = clip_of_sequence(BUNDLED / "towel_fold")
    assert towel is not None
    assert len(towel.frames) == 28
    assert towel.frame_ms * len(towel.frames) == pytest.approx(2000, rel=0.05)
    view = Sequence.load(BUNDLED / "towel_fold").views[0]
    half = view.color(0)[:, :, :].mean(axis=(0, 1))
    np.testing.assert_allclose(towel.frames[0].mean(axis=(0, 1)), half, atol=8)
    sheet = clip_of_sequence(world.settings.sequence_dir / "sheet")
    assert sheet is not None
    assert (len(sheet.frames), sheet.frame_ms) == (10, 40)
    assert len(colored(sheet.frames[0], 1)) > 50
    fitted = clip_of_run(world.settings.run_dir / "fitted", is_still=True)
    assert fitted is not None
    assert len(fitted.frames) == 1
    assert len(colored(fitted.frames[0], 2)) > 50
    assert len(colored(fitted.frames[0], 0)) > 10


def test_depth_is_shown_where_there_is_no_color(tmp_path: Path) -> None:
    folder = tmp_path / "towel_fold"
    shutil.copytree(BUNDLED / "towel_fold", folder, ignore=shutil.ignore_patterns("color.mp4"))
    clip = clip_of_sequence(folder, is_still=True)
    assert clip is not None
    assert clip.frames[0].reshape(-1, 3).std(axis=0).min() > 10


def until_ready(previews: Previews, kind: str, name: str) -> None:
    until(lambda: previews.look(kind, name).state != "pending")


def pretend(previews: Previews, folder: Path, *shown: tuple[str, str]) -> None:
    """Have pictures of some, as if they had been drawn."""
    folder.mkdir(parents=True)
    for kind, name in shown:
        assert previews.look(kind, name).state == "pending"
        _, source = previews._waiting.popitem()
        for ending in (worker.STILL, worker.MOVING):
            (folder / f"{source.key}{ending}").write_bytes(b"RIFF")
        assert previews.look(kind, name).state == "ready"


def test_pictures_are_made_beside_the_server_kept_and_made_again(world: World) -> None:
    kept, sequences = world.settings.preview_dir, world.settings.sequence_dir
    shutil.copytree(sequences / "sheet", sequences / "other")
    (sequences / "empty").mkdir()
    about = yaml.safe_load((sequences / "sheet/sequence.yaml").read_text()) | {"name": "empty"}
    (sequences / "empty/sequence.yaml").write_text(yaml.safe_dump(about))
    before = sorted(world.settings.run_dir.rglob("*"))
    sheet, other, fitted = ("sequence", "sheet"), ("sequence", "other"), ("run", "fitted")
    empty = "sequence", "empty"
    previews = Previews(world.settings, world.catalog)
    assert previews.file(*sheet, is_moving=True) is None
    pretend(previews, kept, fitted, other)
    files = [previews.file(*fitted, is_moving=moves) for moves in (False, True)]
    still, moving = (path for path in files if path is not None)
    old = previews.file(*other, is_moving=True)

    # Of which one picture was cleared away both are drawn again, and what has changed.
    moving.unlink()
    os.utime(sequences / "other/sequence.yaml", ns=(1, 1))
    for of in (sheet, empty, fitted, other):
        assert previews.look(*of).state == "pending"
    previews.start()
    try:
        for of in (sheet, empty, fitted, other):
            until_ready(previews, *of)
        assert previews.look(*empty).state == "none"
        until(lambda: len(list(kept.glob("sequence-other-*.moving.webp"))) == 1)
    finally:
        previews.shutdown()
    assert previews.file(*other, is_moving=True) not in {None, old}
    assert previews.look(*sheet).still.startswith("sequences/sheet/still?v=")
    assert previews.look(*fitted).moving.startswith("runs/fitted/preview?v=")
    drawn = [previews.file(*sheet, is_moving=moves) for moves in (False, True)]
    see_what_is_shown(*(path for path in drawn if path is not None))
    see_what_is_shown(still, moving)
    assert sorted(world.settings.run_dir.rglob("*")) == before


def see_what_is_shown(still: Path, moving: Path) -> None:
    """See that a picture moves, and both have the size of previews."""
    with Image.open(moving) as image:
        assert (image.size, image.n_frames) == ((WIDTH, HEIGHT), 10)
        frames = [np.asarray(f.convert("RGBA"), dtype=int) for f in ImageSequence.Iterator(image)]
    assert np.abs(frames[0] - frames[-1]).mean() > 1
    with Image.open(still) as image:
        assert image.size == (WIDTH, HEIGHT)


def test_a_file_that_vanishes_meanwhile_does_not_keep_the_oldest_ones(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "_MOST_FILES", 1)
    folder = world.settings.preview_dir
    folder.mkdir(parents=True)
    for age, name in ((2, "older"), (1, "newer")):
        (folder / name).touch()
        os.utime(folder / name, (1e9 - age, 1e9 - age))
    (folder / "vanished").symlink_to("nowhere")  # It is listed, and then is not there.
    Previews(world.settings, world.catalog)._tidy([])
    assert sorted(path.name for path in folder.iterdir()) == ["newer", "vanished"]


def test_what_ends_its_process_is_noted_and_the_others_are_drawn(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    previews = Previews(world.settings, world.catalog)
    drawn: list[str] = []

    def break_at_the_first(batch: list) -> None:
        note = world.settings.preview_dir / f"{batch[0].key}.none"
        if not note.exists():  # Whoever asks meanwhile puts it in line once more.
            drawn.append(batch[0].id)
            note.write_text("crashed")

    monkeypatch.setattr(previews, "_draw", break_at_the_first)
    previews.look("sequence", "sheet")
    previews.start()
    try:
        until_ready(previews, "sequence", "sheet")
    finally:
        previews.shutdown()
    assert drawn == ["sheet"]
    assert previews.look("sequence", "sheet").state == "none"


def test_what_computes_for_too_long_is_ended_and_what_waits_is_not() -> None:
    code = (
        "import app.previews.worker as worker, signal\n"
        "from physhandi.child import run_child\n"
        "worker.SECONDS_EACH = 0.1\n"
        "def draw(order, *, is_still):\n"
        "    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)\n"
        "    print(order['kind'], flush=True)\n"
        "    while order['kind'] == 'endless': pass\n"
        "worker.draw = draw\n"
        "run_child(worker.draw_all)\n"
    )
    orders = [json.dumps({"kind": kind}) + "\n" for kind in ("sequence", "endless", "late")]
    ended = subprocess.run(
        [sys.executable, "-c", code],
        input="".join(orders),
        stderr=subprocess.PIPE,
        text=True,
        cwd=PACKAGE_ROOT,
        timeout=LIMIT_S,
        check=False,
    )
    assert ended.stderr.split() == ["sequence", "endless"]
    assert ended.returncode in {-signal.SIGKILL, -signal.SIGXCPU}


def test_a_folder_that_is_deleted_while_pictures_are_drawn_ends_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The note that it crashed cannot be written; there is nothing to tidy; at last it is drawn.
    codes = iter((1, -signal.SIGTERM, 0))

    class FakeChild:
        def __init__(self, *_: object, **__: object) -> None:
            self.code = next(codes)
            self.orders: list[Any] = []
            self.send = self.orders.append

        def __enter__(self) -> "FakeChild":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def end_requests(self) -> None:
            pass

        def messages(self) -> Iterator[dict[str, Any]]:
            if self.code:
                shutil.rmtree(world.settings.preview_dir)
                raise ChildEndedError("worker", self.code, "")
            for order, ending in product(self.orders, (worker.STILL, worker.MOVING)):
                Path(f"{order['target']}{ending}").write_bytes(b"RIFF")
            yield from ()

        def kill(self) -> None:
            pass

    monkeypatch.setattr(store, "Child", FakeChild)
    monkeypatch.setattr(store, "_PAUSE_S", 0.0)
    previews = Previews(world.settings, world.catalog)
    previews.start()

    def is_drawn() -> bool:
        assert previews._thread.is_alive()
        return previews.look("sequence", "sheet").state == "ready"

    try:
        until(is_drawn)
    finally:
        previews.shutdown()
    assert next(codes, None) is None


def test_waiting_after_a_failure_does_not_delay_the_end(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    previews = Previews(world.settings, world.catalog)
    is_waiting = threading.Event()
    wait_for = previews._lock.wait_for

    def note_wait(is_so: Callable[[], bool], timeout: float) -> Any:
        is_waiting.set()  # The lock is held, so nobody says that it ends before it waits.
        return wait_for(is_so, timeout)

    def fail(_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(previews._lock, "wait_for", note_wait)
    monkeypatch.setattr(previews, "_draw", fail)
    monkeypatch.setattr(store, "_PAUSE_S", 3600.0)
    previews.look("sequence", "sheet")
    previews.start()
    assert is_waiting.wait(LIMIT_S)
    previews.look("sequence", "sheet")  # Asking does not end the pause.
    previews.shutdown()
    previews._thread.join(LIMIT_S)
    assert not previews._thread.is_alive()


def test_a_picture_that_cannot_be_drawn_leaves_a_note_that_says_why(tmp_path: Path) -> None:
    order = {"kind": "run", "folder": str(tmp_path / "gone"), "target": str(tmp_path / "run-x")}
    worker.draw(order, is_still=True)
    assert "is not a run" in (tmp_path / "run-x.none").read_text()
    (tmp_path / "run-x.none").write_text("kept")
    worker.draw(order, is_still=False)
    assert (tmp_path / "run-x.none").read_text() == "kept"


def test_a_run_without_results_shows_its_sequence(world: World) -> None:
    client = world.script()
    run_id = client.post("/api/v1/runs", json={"sequences": ["sheet"]}).json()["id"]
    waiting = client.get(f"/runs/{run_id}/picture")
    assert waiting.json() == {"state": "pending", "still": "", "moving": ""}
    assert client.get(f"/runs/{run_id}/still").status_code == 202
    previews = Previews(world.settings, world.catalog)
    previews.look("sequence", "sheet")
    (source,) = previews._waiting.values()
    world.settings.preview_dir.mkdir(parents=True)
    for ending in (worker.STILL, worker.MOVING):
        (world.settings.preview_dir / f"{source.key}{ending}").write_bytes(b"RIFF")
    told = client.get(f"/runs/{run_id}/picture").json()
    assert told["state"] == "ready"
    assert told["moving"].startswith("sequences/sheet/preview?v=")
    answer = client.get(told["moving"])
    assert (answer.content, answer.headers["content-type"]) == (b"RIFF", "image/webp")
    assert "immutable" in answer.headers["cache-control"]
    assert client.get("/sequences/sheet/still?v=old").headers["cache-control"] == "no-store"
    page = client.get("/sequences").text
    assert f'<img class="still" src="{told["still"]}"' in page.replace("&amp;", "&")
    for missing in ("/runs/nothing/still", "/sequences/nothing/preview"):
        assert client.get(missing).status_code == 404


def test_a_picture_that_is_cleared_away_while_it_is_asked_for_is_pending(
    world: World, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Previews, "file", lambda *_, **__: tmp_path / "cleared_away.still.webp")
    assert world.browser().get("/sequences/sheet/still").status_code == 202
    (tmp_path / "cleared_away.still.webp").write_bytes(b"a picture")
    answer = world.browser().get("/sequences/sheet/still")
    assert (answer.status_code, answer.content) == (200, b"a picture")
    assert answer.headers["content-type"] == "image/webp"
