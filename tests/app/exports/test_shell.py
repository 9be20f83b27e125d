"""Exports as the command line makes them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file
from support.server.server_world import World
from support.viewer.viser_file import Recording

from app.cli import main
from app.exports.shell import ExportOptions, export, read_link
from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.splats import Splats
from physhandi.data.layout import SPLATS_FILE
from physhandi.errors import RunError, UsageError
from physhandi.run import Run


def test_the_command_paints_what_a_link_shows(world: World, tmp_path: Path) -> None:
    out, data = tmp_path / "new" / "view.png", str(world.settings.data_dir)
    link = "http://127.0.0.1:8080/runs/fitted/view?f=3&show=nodes&theme=dark"
    size = ["--width", "160", "--height", "120"]
    order = ["export", "fitted", "--format", "png", "--out", str(out), "--data-dir", data]
    with pytest.raises(SystemExit) as end:
        main([*order, "--link", link, *size])
    assert end.value.code in {0, None}
    image = cv2.imread(str(out))
    assert image is not None
    assert image.shape == (120, 160, 3)
    assert image[0, 0].max() < 40
    assert ((image[..., 0].astype(int) - image[..., 2]) > 100).any()


def test_a_link_that_changes_parameters_is_simulated(
    world: World, run: Run, tmp_path: Path
) -> None:
    options = ExportOptions(format="npz", out=tmp_path / "a.npz", link="drag=9&f=3&show=nodes")
    with np.load(export(run, options, world.catalog)) as arrays:
        changed = arrays["rollout"]
    plain = replace(options, link="f=3", out=tmp_path / "b.npz")
    with np.load(export(run, plain, world.catalog)) as arrays:
        fitted = arrays["rollout"]
    np.testing.assert_array_equal(fitted, run.array("sequences/sheet/rollout.npy"))
    assert np.abs(changed - fitted).max() > 1e-3
    one = replace(options, format="ply", out=tmp_path / "a.ply", frame=9)
    body = export(run, one, world.catalog).read_bytes().partition(b"end_header\n")[2]
    assert body.startswith(changed[9, 0].astype("<f4").tobytes())
    replay = replace(options, format="viser", out=tmp_path / "a.viser")
    recording = Recording.read(export(run, replay, world.catalog).read_bytes())
    shown = recording.at(9)["/object/nodes"]["points"].reshape(-1, 3)
    np.testing.assert_allclose(shown, changed[-1], atol=2e-4)


def splat_places(content: bytes) -> np.ndarray:
    """Read where the splats of a PLY file are, which begins each of 17 numbers."""
    body = content.partition(b"end_header\n")[2]
    return np.frombuffer(body, "<f4").reshape(-1, 17)[:, :3]


def test_splats_are_written_where_the_nodes_of_a_rollout_carry_them(
    world: World, run: Run, tmp_path: Path
) -> None:
    rollout = run.array("sequences/sheet/rollout.npy")
    random = np.random.default_rng(2)
    splats = Splats(
        center=rollout[0] + np.float32(0.001),
        scale=np.full(rollout.shape[1], 0.004, np.float32),
        color=random.uniform(0, 1, rollout[0].shape).astype(np.float32),
        opacity=np.full(rollout.shape[1], 0.8, np.float32),
        rest_node=rollout[0],
    )
    plain = ExportOptions(format="splat-ply", out=tmp_path / "a.ply")
    with pytest.raises(RunError, match=r"holds no splats; .*appearance\.enabled=true"):
        export(run, plain, world.catalog)
    save_file(splats.to_tensors(), run.out / SPLATS_FILE)
    for link in ("", "drag=9"):
        options = replace(plain, link=link, out=tmp_path / f"start{link}.ply")
        found = splat_places(export(run, options, world.catalog).read_bytes())
        np.testing.assert_array_equal(found, splats.center)
        motion = replace(options, format="npz", out=tmp_path / f"motion{link}.npz")
        with np.load(export(run, motion, world.catalog)) as arrays:
            node = arrays["rollout"][9]
        later = replace(options, frame=9, out=tmp_path / f"later{link}.ply")
        found = splat_places(export(run, later, world.catalog).read_bytes())
        np.testing.assert_array_equal(found, SplatBinding.of(splats).carry(node[None])[0])
        # They stay beside their nodes, which have moved.
        assert np.linalg.norm(found - node, axis=1).max() < 0.02
        assert np.linalg.norm(found - splats.center, axis=1).max() > 0.05
    answer = world.script().get("/api/v1/runs/fitted/export?format=splat-ply&f=9")
    assert answer.status_code == 200
    np.testing.assert_array_equal(
        splat_places(answer.content), splat_places((tmp_path / "later.ply").read_bytes())
    )
    assert 'filename="fitted_00009.ply"' in answer.headers["content-disposition"]
    with pytest.raises(UsageError, match="frames 0 to 9, not 10"):
        export(run, replace(plain, frame=10), world.catalog)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"link": "drag=-1"}, "drag"),
        ({"link": "f=1&f=2"}, "f: the link has this field twice"),
        ({"format": "yaml", "link": "drag=1"}, "yaml describes the run"),
        ({"format": "html", "frame": 1}, "not as html"),
        ({"format": "png", "frame": 10}, "frames 0 to 9"),
        ({"format": "png", "width": 5_000}, "width"),
        ({"format": "png", "out": "x.jpg"}, "does not end in '.png'"),
        ({"format": "png", "sequence": "walk"}, "walk"),
    ],
)
def test_what_cannot_be_made_is_refused_and_writes_nothing(
    world: World, run: Run, tmp_path: Path, changes: dict[str, object], word: str
) -> None:
    named = {"format": "png", "out": tmp_path / "x.png"} | changes
    named["out"] = tmp_path / str(named["out"])
    with pytest.raises(UsageError, match=word):
        export(run, ExportOptions(**named), world.catalog)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_nothing_is_overwritten_unasked(world: World, run: Run, tmp_path: Path) -> None:
    options = ExportOptions(format="png", out=tmp_path / "x.png", width=32, height=32)
    options.out.write_text("precious")
    with pytest.raises(UsageError, match="exists already"):
        export(run, options, world.catalog)
    assert options.out.read_text() == "precious"
    export(run, replace(options, overwrite=True), world.catalog)
    assert options.out.read_bytes().startswith(b"\x89PNG")


def test_a_token_in_a_link_is_dropped() -> None:
    link = "https://host/runs/x/view?token=secret&f=3&show="
    assert dict(read_link(link)) == {"f": "3", "show": ""}
    assert dict(read_link("f=3")) == {"f": "3"}
    assert dict(read_link("")) == {}
