"""The generator from end to end, and what it refuses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.physics.synthetic_world import hand_pose

from app import cli
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import CancelledError, SequenceError, UsageError
from physhandi.perception.lifting import observe_object
from physhandi.perception.shape import shape_of_observation
from physhandi.progress import Progress
from physhandi.synthetic import synthesize as generator
from physhandi.synthetic.bodies.bodies import Body
from physhandi.synthetic.engines.truth import PhysicalTruth
from physhandi.synthetic.hands.true_hand import load_true_hand
from physhandi.synthetic.synthesize import synthesize

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def rope(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A rope that is pushed, the quickest to simulate."""
    out = tmp_path_factory.mktemp("synthesize") / "rope"
    return synthesize("rope", "push", out=out, seed=4, frames=5, images="none", resolution="tiny")


def test_a_sequence_is_whole_and_says_how_to_make_it_again(rope):
    rope.validate()
    assert rope.label == "SynthHDI"
    assert rope.description.startswith("Push: a right hand, and a rope of ")
    assert (rope.frame_count, rope.reconstruction_frames) == (5, range(4))
    assert rope.provenance["synthesize"]["seed"] == 4
    assert rope.provenance["synthesize"]["preset"] == "default"
    assert rope.provenance["degradations"]["depth_noise"] == 0.08
    assert len(rope.views) == 3
    assert rope.missing("object", "keypoint", "validation_track") == []


def test_what_is_seen_is_near_what_happened(rope):
    known, observation = read_truth(rope.folder), observe_object(rope)
    for frame in (0, 4):
        near = cKDTree(known.object_point[frame]).query(observation.cloud[frame])[0]
        # Default errors: 1 mm and 0.1° of calibration, 10 ms, 1 mm of depth; the skin is coarse.
        assert 0.0005 < np.median(near) < 0.012
    node = shape_of_observation(observation, 0.012, rope).node
    assert 30 < len(node) < 400


def lying(body: Body, _scripts: Any, hands: Any, *, frame_count: int, **_how: Any) -> PhysicalTruth:
    """What MuJoCo would tell if the hands kept away and the body lay still."""
    far = {side: load_true_hand(side).bone_transforms(hand_pose(0.4, 0.2)) for side in hands}
    return PhysicalTruth(
        body=body,
        position=np.repeat(body.node[None], frame_count, axis=0).astype(np.float32),
        contact=np.zeros((frame_count, len(body.node)), dtype=bool),
        hold="friction",
        hands={side: np.repeat(bones[None], frame_count, axis=0) for side, bones in far.items()},
    )


def test_actions_share_a_seed_s_body_but_not_its_cameras(rope, tmp_path, monkeypatch):
    monkeypatch.setattr(generator, "simulate_truth", lying)
    changes = {"depth_noise": 0.05, "track_noise": 0.5}
    lift = synthesize(
        *("rope", "lift"),
        out=tmp_path / "lift",
        seed=4,
        frames=2,
        cameras=1,
        preset="clean",
        changes=changes,
        images="none",
        image_size="quarter",
        held_out_view=True,
        resolution="tiny",
    )
    assert lift.description.split("rope of")[1] == rope.description.split("rope of")[1]
    turn = (
        lift.views[0].camera.T_world_camera[:3, :3].T @ rope.views[0].camera.T_world_camera[:3, :3]
    )
    assert np.trace(turn) < 2.99  # 6 degrees
    # What was chosen for it.
    assert lift.provenance["synthesize"]["preset"] == "clean"
    assert lift.provenance["synthesize"]["changes"] == changes
    assert lift.provenance["degradations"]["depth_noise"] == 0.05
    assert [view.camera.width for view in lift.views] == [212]
    assert [view.camera.width for view in lift.held_out_views] == [212]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object_": "anvil"}, "no object named 'anvil'. Choose one of: cloth"),
        ({"action": "juggle"}, "no action 'juggle'. Choose one of: lift"),
        ({"cameras": 0}, "cameras is 0; expected 1 to 4"),
        ({"cameras": 5}, "cameras is 5"),
        ({"frames": 1}, "frames is 1; expected 2 to 1000"),
        ({"seed": -1}, "seed is -1"),
        ({"preset": "foggy"}, "no preset named 'foggy'"),
        ({"changes": {"fog": 1.0}}, "no degradation named 'fog'"),
        ({"hold": "glue"}, "hold is 'glue'; expected one of: friction, attachment"),
        ({"frames": 30, "set_out": 0.5}, "have hold of the object at 2.00 s"),
        ({"images": "some"}, "images is 'some'; expected one of: all, none"),
        ({"image_size": "tiny"}, "image_size is 'tiny'; expected one of: full, half, quarter"),
        ({"resolution": "coarse"}, "no resolution named 'coarse'"),
    ],
)
def test_bad_input_is_named_and_leaves_nothing(tmp_path, arguments, message):
    whole = {"object_": "rope", "action": "push"} | arguments
    with pytest.raises(UsageError, match=message):
        synthesize(whole.pop("object_"), whole.pop("action"), out=tmp_path / "bad", **whole)
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_that_is_there_is_kept(rope):
    before = rope.fingerprint()
    with pytest.raises(SequenceError, match="exists already"):
        synthesize("cloth", "lift", out=rope.folder)
    assert Sequence.load(rope.folder).fingerprint() == before


def test_without_mujoco_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(generator, "find_spec", lambda _: None)
    with pytest.raises(UsageError, match=r"pip install 'physhandi\[synth\]'"):
        synthesize("rope", "push", out=tmp_path / "none")


def test_warnings_of_the_engine_go_to_the_log_and_into_no_file(tmp_path, monkeypatch, caplog):
    import mujoco

    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qvel[0] = 1e12
    with caplog.at_level("INFO"), generator.engine_warnings_logged():
        mujoco.mj_step(model, data)
    assert "huge value in QVEL" in caplog.text
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is None


class StopsAtOnce(Progress):
    def __init__(self) -> None:
        self.told: list[str] = []

    def report(self, stage: str, *_told: object, **_more: object) -> None:
        self.told.append(stage)

    def check_cancelled(self) -> None:
        if self.told:
            raise CancelledError("stopped")


def test_stopping_leaves_nothing_behind(tmp_path):
    progress = StopsAtOnce()
    with pytest.raises(CancelledError):
        synthesize(
            *("rope", "push"),
            out=tmp_path / "half",
            frames=60,
            set_out=0.0,  # The first frame comes before the hand does.
            images="none",
            resolution="tiny",
            progress=progress,
        )
    assert progress.told == ["simulate"]
    assert list(tmp_path.iterdir()) == []


def call(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli.main(["synthesize", *arguments])
    return int(end.value.code or 0)


def test_the_command_makes_the_same_sequence_as_the_same_call(
    rope: Sequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rope"
    fixed = ("--object", "rope", "--action", "push", "--seed", "4")
    quick = ("--frames", "5", "--images", "none", "--resolution", "tiny")
    assert call(*fixed, *quick, "--out", str(out)) == 0
    assert str(out) in capsys.readouterr().out
    assert Sequence.load(out).fingerprint() == rope.fingerprint()


def test_the_command_hands_on_what_is_chosen(
    rope: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def made(*named: str, **chosen: Any) -> Sequence:
        asked.update(chosen, named=named)
        return rope

    monkeypatch.setattr(generator, "synthesize", made)
    fixed = ("--object", "rope", "--action", "push", "--preset", "clean", "--cameras", "1")
    change = ("--change", "depth_noise=0.05", "track_noise=0.5")
    aside = ("--image-size", "quarter", "--held-out-view")
    assert call(*fixed, *change, *aside, "--out", str(tmp_path / "rope")) == 0
    expected = {
        "named": ("rope",),
        "action": "push",
        "preset": "clean",
        "cameras": 1,
        "changes": {"depth_noise": 0.05, "track_noise": 0.5},
        "image_size": "quarter",
        "held_out_view": True,
    }
    assert asked | expected == asked


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--object", "anvil", "--action", "lift"), "no object named 'anvil'"),
        (("--object", "rope", "--action", "push", "--cameras", "0"), "cameras is 0"),
        (("--object", "rope", "--action", "push", "--change", "holes"), "write it like"),
        (
            ("--object", "rope", "--action", "push", "--set-out", "-0.2", "--frames", "30"),
            "have hold of the object at 1.30 s",
        ),
    ],
)
def test_the_command_refuses_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    assert call(*arguments, "--out", str(tmp_path / "bad")) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []
