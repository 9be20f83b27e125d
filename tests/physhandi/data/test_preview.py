"""What is shown of a running fit: small, whole, seldom and true to what was simulated."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from support.server.run_world import make_run

from physhandi.data import attempt as preview_module
from physhandi.data.attempt import PREVIEW, PreviewFile, encode
from physhandi.progress import NullProgress, Preview


def read_preview(run_folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a preview shows, and the points of each kind [m], as docs/viewer.md has them."""
    with safe_open(run_folder / PREVIEW, framework="numpy") as stream:
        about = json.loads(stream.metadata()["about"])
        arrays = {kind: stream.get_tensor(kind) for kind in stream.keys()}  # noqa: SIM118
    points = {
        kind: np.where(
            whole == 65535, np.nan, np.asarray(about["low"]) + whole / 65534 * about["side"]
        )
        for kind, whole in arrays.items()
    }
    return about, points


def make(count: int = 60, nodes: int = 2000) -> Preview:
    """Nodes on a line that rise by 1 cm a frame, beside a hand that is seen in odd frames only."""
    node = np.zeros((count, nodes, 3), np.float32)
    node[..., 0] = np.linspace(0.0, 0.5, nodes)
    node[..., 2] = 0.01 * np.arange(count)[:, None]
    seen = node[:, :10].copy()
    seen[::2] = np.nan
    return Preview(
        stage="first_order",
        sequence="lift",
        loss=0.25,
        frame_rate=30.0,
        points={"object": node, "seen": seen},
    )


def test_what_is_read_back_is_what_moved_to_a_hundredth_of_a_millimetre(tmp_path: Path) -> None:
    shown = make(count=24)
    PreviewFile(tmp_path).write(lambda: shown)
    about, points = read_preview(tmp_path)
    assert about["stage"] == "first_order"
    assert (about["sequence"], about["loss"], about["frame_rate"]) == ("lift", 0.25, 30.0)
    assert about["frames"] == list(range(24))
    kept = np.rint(np.linspace(0, 1999, 400)).astype(int)
    assert points["object"].shape == (24, 400, 3)
    assert np.abs(points["object"] - shown.points["object"][:, kept]).max() < 1e-5
    assert np.isnan(points["seen"][::2]).all()
    assert np.abs(points["seen"] - shown.points["seen"])[1::2].max() < 1e-5
    assert points["object"][10, 0, 2] == pytest.approx(0.1, abs=1e-5)


def test_a_long_motion_of_many_nodes_stays_small_and_keeps_both_ends(tmp_path: Path) -> None:
    content = encode(make(count=300, nodes=5000), 7)
    assert 20_000 < len(content) < 100_000
    (tmp_path / PREVIEW).write_bytes(content)
    about, points = read_preview(tmp_path)
    assert len(about["frames"]) == 24
    assert (about["frames"][0], about["frames"][-1], about["number"]) == (0, 299, 7)
    # What leaves the box of frame 0 and of what was seen stops at its wall.
    assert points["object"][0, 0, 2] == pytest.approx(0.0, abs=1e-4)
    # The layout is that of safetensors, which the page reads by itself.
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    assert header["object"]["dtype"] == "U16"
    assert json.loads(header["__metadata__"]["about"])["sequence"] == "lift"


def test_one_that_runs_away_neither_hides_the_rest_nor_breaks_the_file(tmp_path: Path) -> None:
    shown = make(count=5)
    node = np.array(shown.points["object"])
    node[3:, 7] = 1e9
    node[4, 9] = np.inf
    wild = Preview(
        stage="s", sequence="lift", loss=np.inf, frame_rate=30.0, points={"object": node[:, :300]}
    )
    PreviewFile(tmp_path).write(lambda: wild)
    about, points = read_preview(tmp_path)
    assert about["loss"] is None
    assert about["side"] < 1.0
    assert np.isnan(points["object"][4, 9]).all()
    assert np.abs(points["object"][:3] - node[:3, :300]).max() < 1e-5


def test_previews_are_seldom_and_together_take_a_small_share_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(preview_module.time, "monotonic", lambda: clock[0])

    def slow() -> Preview:
        clock[0] += 0.05
        return make(count=3)

    file = PreviewFile(tmp_path)
    due: Callable[[], bool] = file.is_due
    assert due()
    file.write(lambda: make(count=3))
    clock[0] = 101.4
    assert not due()
    clock[0] = 102.0
    assert due()
    # 0.05 s are 0.8 % of 6.25 s since the begin.
    file.write(slow)
    clock[0] = 106.2
    assert not due()
    clock[0] = 106.3
    assert due()
    # In a minute enough is saved up for several of them, but not at once.
    clock[0] = 160.0
    for _ in range(5):
        assert due()
        file.write(slow)
        assert not due()
        clock[0] += 1.5
    assert file.spent_s == pytest.approx(0.3)
    # Then the share is used up: 0.6 s of previews are allowed after 75 s and not before.
    for _ in range(6):
        file.write(slow)
    clock[0] = 174.9
    assert not due()
    clock[0] = 175.1
    assert due()


def test_a_run_takes_previews_and_nobody_else_wants_any(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview_module, "INTERVAL_S", 1e6)  # However long this test takes.
    assert not NullProgress().wants_preview()
    run = make_run(tmp_path / "run")
    with run.begin_attempt() as attempt:
        progress = attempt.progress()
        assert progress.wants_preview()
        progress.preview(make)
        assert not progress.wants_preview()
        attempt.publish()
    assert read_preview(run.folder)[0]["number"] == 1
    run.verify()
    with run.begin_attempt() as attempt:
        attempt.progress()
        assert not (run.folder / PREVIEW).exists()
        attempt.publish()
