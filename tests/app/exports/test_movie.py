"""Films, read back by a decoder and compared with pictures of single frames."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import PIL.Image
import pytest
from support.server.server_world import World

from app.cli import main
from app.exports.files import request_of
from app.exports.making import make
from app.exports.movie import FILMED_PIXELS_PER_SECOND, gif_durations
from app.exports.request import FileRequest
from app.viewer.content.camera_path import (
    PATH_FORMAT,
    CameraPath,
    Turntable,
    read_camera_path,
    turned_pose,
)
from app.viewer.content.session_state import Pose
from physhandi.errors import UsageError
from physhandi.run import Run

RUN = "/api/v1/runs/fitted/export"
LOOK = "show=nodes&width=160&height=120"


def frames_of(path: Path) -> tuple[float, list[np.ndarray]]:
    capture: Any = cv2.VideoCapture(str(path))
    frames = []
    while True:
        is_read, frame = capture.read()
        if not is_read:
            return capture.get(cv2.CAP_PROP_FPS), frames
        frames.append(frame)


def picture(world: World, frame: int) -> np.ndarray:
    content = world.script().get(f"{RUN}?format=png&f={frame}&{LOOK}").content
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image.astype(int)


def middle(image: np.ndarray) -> np.ndarray:
    """Mean row and column of the nodes, which are blue [px]."""
    blue = np.maximum(image[..., 0].astype(float) - image[..., 2] - 20.0, 0.0)
    return np.array([np.average(np.indices(blue.shape)[axis], weights=blue) for axis in (0, 1)])


def test_a_film_shows_every_frame_at_its_time(
    world: World, made: list[FileRequest], tmp_path: Path
) -> None:
    (tmp_path / "a.mp4").write_bytes(world.script().get(f"{RUN}?format=mp4&{LOOK}").content)
    rate, frames = frames_of(tmp_path / "a.mp4")
    count = len(world.catalog.run("fitted").array("sequences/sheet/rollout.npy"))
    assert (rate, len(frames), frames[0].shape) == (30.0, count, (120, 160, 3))
    (tmp_path / "a.gif").write_bytes(world.script().get(f"{RUN}?format=gif&{LOOK}").content)
    with PIL.Image.open(tmp_path / "a.gif") as gif:
        assert (gif.n_frames, gif.info["loop"], gif.size) == (count, 0, (160, 120))
        gif.seek(count - 1)
        last = np.asarray(gif.convert("RGB"))[..., ::-1].astype(int)
    first, end = middle(picture(world, 0)), middle(picture(world, count - 1))
    before = middle(picture(world, count - 2))
    assert min(np.linalg.norm(first - end), np.linalg.norm(before - end)) > 4.0
    for seen, exact in ((frames[0], first), (frames[-1], end), (last, end)):
        np.testing.assert_allclose(middle(seen), exact, atol=1.0)


def test_a_film_shows_the_part_that_is_played(
    world: World, made: list[FileRequest], tmp_path: Path
) -> None:
    film = world.script().get(f"{RUN}?format=mp4&{LOOK}&part=4,6&speed=0.5")
    (tmp_path / "a.mp4").write_bytes(film.content)
    rate, frames = frames_of(tmp_path / "a.mp4")
    assert (rate, len(frames)) == (15.0, 3)
    for frame, seen in zip((4, 5, 6), frames, strict=True):
        np.testing.assert_allclose(middle(seen), middle(picture(world, frame)), atol=1.0)
    for bad, word in (("4", "later last"), ("6,4", "later last"), ("4,10", "frames 0 to 9")):
        refused = world.script().get(f"{RUN}?format=mp4&{LOOK}&part={bad}")
        assert (refused.status_code, word in refused.text) == (422, True), refused.text


def test_the_progress_of_a_film_is_told_until_it_can_be_fetched(
    world: World, made: list[FileRequest]
) -> None:
    query = f"format=gif&turn=90&{LOOK}"
    answer = world.script().post(f"{RUN}?{query}")
    told = answer.json()
    assert told["url"] == f"{RUN}?{query}", answer.text
    assert told["state"] in {"making", "ready"}
    film = world.script().get(told["url"])
    assert film.headers["content-type"] == "image/gif"
    assert film.headers["content-disposition"] == 'attachment; filename="fitted.gif"'
    assert [order.turn for order in made] == [90.0]
    ready = world.script().post(f"{RUN}?{query}").json()
    assert (ready["state"], ready["bytes"]) == ("ready", len(film.content))
    table = json.dumps({"format": PATH_FORMAT, "kind": "turntable", "turn": 90})
    way = f"format=gif&{LOOK}&camera_path={quote(table)}"
    film = world.script().get(world.script().post(f"{RUN}?{way}").json()["url"])
    assert film.headers["content-type"] == "image/gif"
    assert [order.camera_path for order in made] == ["", table]
    # The path of a link is followed, too, unless something else is asked for.
    link = replace(made[0], turn=0.0, query={"path": "2,1,-2,0.5,0.1,0.2,0.3,0,0,1,40"})
    assert isinstance(link.motion, CameraPath)
    assert list(link.motion.at(7).position) == [1.0, -2.0, 0.5]
    assert replace(link, turn=90.0).motion == Turntable(90.0)
    refused = world.script().post(f"{RUN}?{way[:-3]}")
    assert (refused.status_code, "this is not JSON" in refused.text) == (422, True)
    for bad in ("format=png", f"{query}&turn=3601", f"{query}&turn=nan", "format=mp4&color=magic"):
        assert world.script().post(f"{RUN}?{bad}").status_code == 422


def test_the_command_films(world: World, tmp_path: Path) -> None:
    out, data = tmp_path / "a.mp4", str(world.settings.data_dir)
    order = ["export", "fitted", "--format", "mp4", "--out", str(out), "--data-dir", data]
    with pytest.raises(SystemExit) as end:
        main([*order, "--width", "97", "--height", "65", "--turn", "-45"])
    assert end.value.code in {0, None}
    _, frames = frames_of(out)
    assert frames[0].shape == (64, 96, 3)


def test_the_camera_of_a_film_passes_through_key_frames(
    world: World, made: list[FileRequest], tmp_path: Path
) -> None:
    file, out, data = tmp_path / "way.json", tmp_path / "a.mp4", str(world.settings.data_dir)
    keys = [
        {"frame": 1, "position": [0.5, -0.4, 0.5], "look_at": [0.05, 0.05, 0.0], "fov": 50},
        {"frame": 7, "position": [0.1, -0.6, 0.4], "look_at": [-0.05, 0.0, 0.05], "fov": 40},
    ]
    file.write_text(json.dumps({"format": PATH_FORMAT, "kind": "keys", "keys": keys}))
    order = ["export", "fitted", "--format", "mp4", "--out", str(out), "--data-dir", data]
    look = ["--link", "show=nodes", "--width", "160", "--height", "120"]
    with pytest.raises(SystemExit) as end:
        main([*order, *look, "--camera-path", str(file)])
    assert end.value.code in {0, None}
    _, frames = frames_of(out)
    path = read_camera_path(file)
    seen = []
    for frame in (0, 4, 9):
        pose = path.pose(frame, None, range(10))
        cam = ",".join(f"{x:.9g}" for x in (*pose.position, *pose.look_at))
        up = ",".join(f"{x:.9g}" for x in pose.up)
        view = f"cam={cam}&up={up}&fov={np.degrees(pose.fov):.9g}"
        content = world.script().get(f"{RUN}?format=png&f={frame}&{LOOK}&{view}").content
        image: Any = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        seen.append(middle(image.astype(int)))
        np.testing.assert_allclose(middle(frames[frame]), seen[-1], atol=1.0)
    assert min(np.linalg.norm(seen[0] - seen[1]), np.linalg.norm(seen[2] - seen[1])) > 3.0


def test_a_camera_path_that_does_not_fit_is_refused(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, data = tmp_path / "way.json", str(world.settings.data_dir)
    key = {"frame": 10, "position": [0.5, -0.4, 0.5], "look_at": [0.0, 0.0, 0.0]}
    table = {"format": PATH_FORMAT, "kind": "turntable", "turn": 90}
    for content, more, suffix, told in (
        (
            {"format": PATH_FORMAT, "kind": "keys", "keys": [key]},
            (),
            "mp4",
            "key frame 0: frame: 'sheet",
        ),
        (table, ("--turn", "5"), "mp4", "turn: a film has a camera path or a turn, not both"),
        (table, (), "png", "camera_path: mp4 and gif have one, png has none"),
        (
            {"format": PATH_FORMAT, "kind": "keys", "keys": [{}]},
            (),
            "gif",
            "way.json: key frame 0: frame",
        ),
    ):
        file.write_text(json.dumps(content))
        out = tmp_path / f"a.{suffix}"
        order = ["export", "fitted", "--format", suffix, "--out", str(out), "--data-dir", data]
        with pytest.raises(SystemExit) as end:
            main([*order, *more, "--camera-path", str(file)])
        assert end.value.code not in {0, None}
        assert told in capsys.readouterr().err
        assert not out.exists()


def test_a_film_that_takes_longer_than_there_is_time_is_refused_at_once(
    world: World, run: Run, tmp_path: Path
) -> None:
    order = replace(request_of(world.catalog, run, "mp4", {"part": "3,6"}), width=100, height=50)
    out, seconds = tmp_path / "a.mp4", 4 * 100 * 50 / FILMED_PIXELS_PER_SECOND
    make(order, out, time_limit_s=seconds)
    film = out.read_bytes()
    with pytest.raises(UsageError, match=r"4 frames of 'sheet' with 102 x 50 .* most 5,000 pixels"):
        make(replace(order, width=102), out, time_limit_s=seconds)
    assert out.read_bytes() == film
    assert list(tmp_path.glob("*.mp4")) == [out]


def test_the_camera_goes_round_the_upward_axis() -> None:
    start = Pose(
        position=np.array([3.0, 1.0, 2.0]),
        look_at=np.array([1.0, 1.0, 0.5]),
        up=np.array([0.0, 0.0, 2.0]),
        fov=0.8,
    )
    quarter = turned_pose(start, np.pi / 2)
    np.testing.assert_allclose(quarter.position, [1.0, 3.0, 2.0], atol=1e-12)
    np.testing.assert_array_equal(quarter.look_at, start.look_at)
    np.testing.assert_allclose(turned_pose(start, 2 * np.pi).position, start.position, atol=1e-12)


@pytest.mark.parametrize(("rate", "whole"), [(30.0, 2000), (24.0, 2500), (120.0, 1200)])
def test_a_gif_lasts_as_long_as_its_sequence_unless_that_is_too_fast(
    rate: float, whole: int
) -> None:
    durations = gif_durations(60, rate)
    assert sum(durations) == whole
    assert all(20 <= duration <= 50 and duration % 10 == 0 for duration in durations)
