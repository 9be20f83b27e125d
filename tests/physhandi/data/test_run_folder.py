"""Run folders: names, listings, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from run_world import fill, make_run

from physhandi.data.run_folder import new_run_id
from physhandi.errors import RunError
from physhandi.run import Run


@pytest.mark.parametrize("rel", ["../x.npy", "/x.npy", "a/../../x", ".x", "a b", ""])
def test_files_cannot_leave_the_run(tmp_path: Path, rel: str) -> None:
    run = make_run(tmp_path / "fit")
    with run.begin_attempt() as attempt:
        with pytest.raises(RunError, match="not a file name inside"):
            attempt.save_json(rel, {})
        with pytest.raises(RunError, match="not a file name inside"):
            run.has(rel)
        attempt.publish()


def test_pickled_objects_are_neither_written_nor_read(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    objects = np.array([{"a": 1}], dtype=object)
    with run.begin_attempt() as attempt:
        with pytest.raises(RunError, match=r"a\.npy cannot be stored"):
            attempt.save_array("a.npy", objects)
        np.save(attempt.out / "a.npy", objects, allow_pickle=True)
        attempt.publish()
    with pytest.raises(RunError, match=r"a\.npy is not a readable array"):
        run.array("a.npy")


def test_unusable_folders_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is not a run"):
        Run.open(tmp_path)
    with pytest.raises(RunError, match="'a b' cannot name a run"):
        make_run(tmp_path / "a b")
    with pytest.raises(RunError, match="Two sequences are named 'lift'"):
        make_run(tmp_path / "fit", sequences=["/a/lift", "/b/lift"])
    run = make_run(tmp_path / "fit")
    with pytest.raises(RunError, match="exists already"):
        make_run(tmp_path / "fit")
    with pytest.raises(RunError, match="has no outputs yet"):
        _ = run.out
    with pytest.raises(RunError, match="nothing published to read yet"):
        run.verify()
    fill(run)
    with pytest.raises(RunError, match=r"has no video\.mp4"):
        run.json("video.mp4")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fit"]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("kind: [", r"job\.yaml cannot be read as YAML"),
        ("format: physhandi-run/1\nkind: 3", "field 'kind' is missing or wrong"),
    ],
)
def test_a_damaged_run_is_refused_by_file_and_field(tmp_path: Path, text: str, error: str) -> None:
    run = make_run(tmp_path / "bad")
    (run.folder / "job.yaml").write_text(text)
    with pytest.raises(RunError, match=error):
        Run.open(run.folder)


def test_rename_and_delete(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    run.rename("Better name", label="paper")
    again = Run.open(run.folder)
    assert (again.name, again.label, again.created) == ("Better name", "paper", run.created)
    attempt = run.begin_attempt()
    with pytest.raises(RunError, match="is running"):
        run.delete()
    attempt.publish()
    run.delete()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RunError, match="was deleted or moved"):
        run.begin_attempt()


def test_ids_sort_by_time_and_never_repeat() -> None:
    ids = [new_run_id() for _ in range(500)]
    assert len(set(ids)) == 500
    assert all(len(name) == 26 and name.isalnum() for name in ids)
    assert ids[0][:9] <= ids[-1][:9]


def test_job_yaml_is_plain(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit", config={"a": (1, 2), "b": np.float32(0.5), "c": Path("/x")})
    stored = yaml.safe_load((run.folder / "job.yaml").read_text())
    assert stored["config"] == {"a": [1, 2], "b": 0.5, "c": "/x"} == Run.open(run.folder).config


def test_relative_sequences_start_at_the_run(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs" / "fit")
    path = run.folder / "job.yaml"
    job = yaml.safe_load(path.read_text()) | {"sequences": ["../../sequences/lift"]}
    path.write_text(yaml.safe_dump(job))
    assert Run.open(run.folder).sequences == [str(tmp_path / "sequences" / "lift")]


def test_an_unknown_kind_of_run_is_refused(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    path = run.folder / "job.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"kind": "shell"}))
    with pytest.raises(RunError, match="kind is 'shell'; expected reconstruction or simulation"):
        Run.open(run.folder)
