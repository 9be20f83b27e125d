"""Sequences of a suite: made once, taken up again only if they would be made the same way."""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.sheet_sequence import write_sheet

from physhandi.data.sequence import Sequence
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import UsageError
from physhandi.progress import NullProgress
from physhandi.synthetic import code_version as module
from physhandi.synthetic import synthesize as generator
from physhandi.synthetic.bodies.bodies import make_body
from physhandi.synthetic.code_version import code_hash, generator_version, outdated
from physhandi.synthetic.suite.methods import method_settings, parse_method
from physhandi.synthetic.suite.suite import (
    SUITES,
    Suite,
    SuiteScene,
    make_one_by_one,
    make_recordings,
)

SUITE = Suite(
    name="tiny",
    about="Two scenes.",
    scenes=(
        SuiteScene(object_="cloth", action="lift"),
        SuiteScene(object_="rope", action="stretch"),
    ),
    seeds=(0,),
    methods=("static",),
    recording={"preset": "clean", "frames": 30},
)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Let sheets stand in for simulated sequences; names what is made."""
    names: list[str] = []

    @functools.wraps(generator.synthesize)
    def make(object_: str, action: str, *, out: Path, progress: Any, **settings: Any) -> Sequence:
        names.append(out.name)
        plain = write_sheet(tmp_path / "plain" / out.name)
        held = ("control", "marker", "marker_node", "object_node", "rest_node")
        arrays = {f"{name}.npy": np.load(plain.folder / f"{name}.npy") for name in held}
        told = {"cameras": 3, "resolution": "fine", "changes": {}, **settings}
        told |= {"object": object_, "action": action}
        provenance = {"synthesize": told, "generator": generator_version()}
        meta = replace(plain.meta, name=out.name, provenance=provenance)
        return write_sequence(out, meta, arrays)

    monkeypatch.setattr(generator, "synthesize", make)
    return names


def make(folder: Path, suite: Suite = SUITE) -> tuple[Sequence, ...]:
    by_one = functools.partial(make_one_by_one, progress=NullProgress())
    return make_recordings(suite, suite.seeds, folder, by_one)


def test_what_is_there_is_taken_up_and_the_rest_is_made(tmp_path: Path, made: list[str]) -> None:
    first = make(tmp_path / "s", replace(SUITE, scenes=SUITE.scenes[:1]))
    assert made == ["cloth_lift_0"]
    both = make(tmp_path / "s")
    assert made == ["cloth_lift_0", "rope_stretch_0"]
    assert [recording.name for recording in both] == made
    assert both[0].fingerprint() == first[0].fingerprint()
    assert [outdated(recording) for recording in both] == ["", ""]


@pytest.mark.parametrize(
    ("recording", "told"),
    [
        ({"preset": "clean", "frames": 60}, "frames 30 in place of 60"),
        ({"frames": 30}, "preset clean in place of default"),
        ({"preset": "clean", "frames": 30, "resolution": "tiny"}, "resolution fine in place"),
    ],
)
def test_a_sequence_of_other_settings_is_refused_before_any_is_made(
    tmp_path: Path, made: list[str], recording: dict[str, Any], told: str
) -> None:
    make(tmp_path / "s", replace(SUITE, scenes=SUITE.scenes[:1]))
    with pytest.raises(UsageError, match=f"cloth_lift_0 was made with {told}") as error:
        make(tmp_path / "s", replace(SUITE, name="dev", recording=recording))
    assert "delete that folder" in str(error.value)
    assert made == ["cloth_lift_0"]


def test_a_sequence_of_unknown_origin_is_refused(tmp_path: Path, made: list[str]) -> None:
    write_sheet(tmp_path / "s" / "cloth_lift_0")
    with pytest.raises(UsageError, match="not made by `physhandi synthesize`"):
        make(tmp_path / "s")
    assert made == []


def test_a_sequence_of_another_generator_is_told(
    tmp_path: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (recording, _) = make(tmp_path / "s")
    monkeypatch.setattr(module, "generator_version", lambda: "0123456789ab-mujoco-9.9")
    told = outdated(recording)
    assert "another version" in told
    assert generator_version() in told
    assert f"delete {recording.folder}" in told
    nameless = {"synthesize": recording.provenance["synthesize"]}
    before = Sequence(recording.folder, replace(recording.meta, provenance=nameless))
    assert "unknown generator" in outdated(before)
    assert not outdated(Sequence(recording.folder, replace(recording.meta, provenance={})))


def test_the_version_changes_with_any_source_or_asset_of_the_generator(tmp_path: Path) -> None:
    (tmp_path / "engines").mkdir()
    for name in ("one.py", "engines/two.py", "engines/three.npz", "engines/notice.md"):
        (tmp_path / name).write_text(name)
    parts = ("one.py", "engines")
    seen = {code_hash(tmp_path, parts)}
    for name in ("one.py", "engines/two.py", "engines/three.npz"):
        (tmp_path / name).write_text(f"{name}!")
        seen.add(code_hash(tmp_path, parts))
    assert len(seen) == 4
    (tmp_path / "engines/notice.md").write_text("other")
    assert code_hash(tmp_path, parts) in seen
    with pytest.raises(FileNotFoundError):
        code_hash(tmp_path, ("none.py",))


def test_scenes_of_contact_are_told_apart_by_name_and_made_with_their_times(
    tmp_path: Path, made: list[str]
) -> None:
    suite = SUITES["dev_contact"]
    recordings = make(tmp_path / "s", suite)
    assert made == [
        "towel_wipe_0",
        "cloth_wipe_late_0",
        "rope_push_late_0",
        "pouch_lift_released_0",
    ]
    told = [one.provenance["synthesize"] for one in recordings]
    assert [one["set_out"] for one in told] == [-1.5, -0.2, -0.2, -1.5]
    assert [one["release"] for one in told] == [None, None, None, 1.2]
    later = replace(suite, scenes=(replace(suite.scenes[1], set_out=0.3),))
    with pytest.raises(UsageError, match=r"cloth_wipe_late_0 was made with set_out -0\.2 in place"):
        make(tmp_path / "s", later)


@pytest.mark.parametrize(("name", "most"), [("tiny", 441), ("dev", 1000), ("dev_contact", 1000)])
def test_bodies_of_small_suites_have_few_nodes(name: str, most: int) -> None:
    suite = SUITES[name]
    for object_ in {scene.object_ for scene in suite.scenes}:
        for seed in suite.seeds:
            random = np.random.default_rng([seed, 0])
            resolution = suite.recording.get("resolution", "fine")
            body = make_body(object_, random, resolution=resolution)  # type: ignore[arg-type]
            assert 20 < len(body.node) <= most


def test_no_fit_of_dev_makes_more_steps_than_others_may() -> None:
    dev = SUITES["dev"]
    assert "paper" not in dev.methods
    assert "paper" in SUITES["full"].methods
    for name in dev.methods:
        method = parse_method(name)
        own, cut = (method_settings(method, common) for common in ({}, dev.settings))
        steps = [settings["object_"]["first_order"]["iterations"] for settings in (own, cut)]
        assert steps == ([200, 80] if method.profile == "phystwin" else [80, 80])
