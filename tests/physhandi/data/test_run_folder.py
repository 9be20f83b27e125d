"""Run folders: names, listings, and what is refused."""

import json
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.server.run_world import fill, make_run

from physhandi.data.lease import live_holder
from physhandi.data.run_folder import new_run_id, read_events
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


JOB = {
    "format": "physhandi-run/1",
    "kind": "reconstruction",
    "sequences": ["/data/lift"],
    "sequence_names": ["lift"],
    "config": {},
}
RUN = {"format": "physhandi-run/1", "name": "a", "created": "now"}
WRONG = {
    "no YAML": ("job.yaml", "kind: [", "cannot be read as YAML: line 2"),
    "no UTF-8": ("run.yaml", b"\xff", "cannot be read as YAML"),
    "deep": ("job.yaml", "[" * 3000, "nested too deeply"),
    "endless": (
        "job.yaml",
        "".join(f"a{n}: &a{n} [{f'*a{n - 1}, ' * 9 if n else 'x'}]\n" for n in range(9)),
        "more than 200000 values",
    ),
    "other format": ("job.yaml", JOB | {"format": "a"}, "is not in format physhandi-run/1.$"),
    "newer format": (
        "run.yaml",
        RUN | {"format": "physhandi-run/2"},
        "is not in format physhandi-run/1, but physhandi-run/2: update the program",
    ),
    "number for a kind": ("job.yaml", JOB | {"kind": 3}, r"'kind' is wrong \(expected text, got"),
    "other kind": ("job.yaml", JOB | {"kind": "dream"}, "'kind' is wrong .*dream"),
    "number for a path": ("job.yaml", JOB | {"sequences": [1]}, r"'sequences\[0\]' is wrong"),
    "no sequence": ("job.yaml", JOB | {"sequences": []}, "'sequences' is wrong"),
    "two for one name": ("job.yaml", JOB | {"sequences": ["a", "b"]}, "2 sequences, but 1"),
    "zero in a path": ("job.yaml", JOB | {"sequences": ["a\0b"]}, r"'sequences\[0\]' is wrong"),
    "list for settings": ("job.yaml", JOB | {"config": [1]}, r"'config' is wrong .*named fields"),
    "NaN": ("job.yaml", JOB | {"config": {"a": {"b": float("nan")}}}, "'config.a.b' is nan"),
    "huge": ("job.yaml", JOB | {"config": {"a": 10**400}}, "'config.a' is a number that is too"),
    "date": ("job.yaml", JOB | {"config": {"a": date(2026, 1, 1)}}, "'config.a' is a date"),
    "number for a name": ("job.yaml", JOB | {"config": {1: 2}}, "name in field 'config' is no te"),
    "no name": ("run.yaml", {k: v for k, v in RUN.items() if k != "name"}, "'name' is missing"),
    "list for a label": ("run.yaml", RUN | {"label": [1, 2]}, "'label' is wrong .*text, got a l"),
    "number for a note": ("run.yaml", RUN | {"note": 7}, "'note' is wrong"),
    "nothing for a time": ("run.yaml", RUN | {"created": None}, "'created' is wrong .*nothing"),
}


@pytest.mark.parametrize(("file", "content", "words"), WRONG.values(), ids=list(WRONG))
def test_a_damaged_run_is_refused_by_file_and_field(
    tmp_path: Path, file: str, content: Any, words: str
) -> None:
    run = make_run(tmp_path / "bad")
    text = content if isinstance(content, str | bytes) else yaml.safe_dump(content)
    (run.folder / file).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(RunError, match=words) as error:
        Run.open(run.folder)
    assert str(run.folder / file) in str(error.value)


DAMAGED: dict[str, tuple[str, Any, str, str]] = {
    # file, content, what is asked for, words
    "no end": ("exit.json", {"time": "now"}, "state", "field 'state' is missing"),
    "other end": ("exit.json", {"state": "asleep"}, "state", "'state' is wrong .*asleep"),
    "no stage": ("progress.json", {"time": 1.0}, "progress", "field 'stage' is missing"),
    "no number": ("progress.json", {"stage": "a", "attempt": "b"}, "progress", "'attempt' is wron"),
    "NaN": ("progress.json", b'{"stage": "a", "loss": NaN}', "progress", "as JSON"),
    "deep": ("progress.json", b"[" * 100_000, "progress", "nested too deeply"),
    "huge": (
        "progress.json",
        b'{"stage": "a", "a": [1%s]}' % (b"0" * 400),
        "progress",
        "too large",
    ),
    "walls": ("progress.json", b"[" * 500 + b"]" * 500, "progress", "nested too deeply"),
    "no list": ("attempts/1/stages.json", {}, "stages", "expected a list, got named fields"),
    "no name of a stage": ("attempts/1/stages.json", [{}], "stages", r"'\[0\].name' is missing"),
    "time of a stage": (
        "attempts/1/stages.json",
        [{"name": "a", "seconds": "long"}],
        "stages",
        r"'\[0\].seconds' is wrong \(expected a number, got text\)",
    ),
    "no files": ("attempts/1/MANIFEST.json", {"files": 3}, "verify", "'files' is wrong"),
    "no hash": (
        "attempts/1/MANIFEST.json",
        {"files": {"a": {"size": 1}}},
        "verify",
        "sha256' is m",
    ),
    "no name of a file": (
        "attempts/1/MANIFEST.json",
        {"files": {"": {"size": 1, "sha256": ""}}},
        "verify",
        "'' is not a file name inside a run",
    ),
    "a folder": ("progress.json", None, "progress", "it is not a file"),
}


@pytest.mark.parametrize(("file", "content", "asked", "words"), DAMAGED.values(), ids=list(DAMAGED))
def test_a_damaged_file_of_a_run_is_told_by_file_and_field(
    tmp_path: Path, file: str, content: Any, asked: str, words: str
) -> None:
    run = make_run(tmp_path / "bad")
    fill(run)
    path = run.folder / file
    path.unlink(missing_ok=True)
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(RunError, match=words) as error:
        getattr(run, asked)() if asked in {"stages", "verify"} else getattr(run, asked)
    assert str(path) in str(error.value) or f"Run '{run.id}'" in str(error.value)


@pytest.mark.parametrize("content", [b"\xff", "²".encode(), b"", b"the last", b"1" * 5000])
def test_what_is_no_number_of_an_attempt_publishes_nothing(tmp_path: Path, content: bytes) -> None:
    run = make_run(tmp_path / "bad")
    fill(run)
    (run.folder / "current").write_bytes(content)
    (run.folder / "attempts" / "²").mkdir()
    assert not run.is_published
    assert run.attempt == 1
    with pytest.raises(RunError, match="'current' does not lead"):
        run.verify()


@pytest.mark.parametrize(
    "claim",
    [
        *({"pid": pid} for pid in (True, -1, 0, 2**70, "1", [1], None)),
        *({"host": 3}, {"nonce": None}, {"time": "now"}, {"process": 5}),
    ],
)
def test_a_damaged_claim_protects_nobody_and_can_be_replaced(tmp_path: Path, claim: Any) -> None:
    run = make_run(tmp_path / "bad")
    with run.begin_attempt() as first:
        path = run.folder / "lease.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | claim))
        assert live_holder(run.folder) is None
        with pytest.raises(RunError, match=r"lease\.json (is damaged|cannot be read)"):
            first.heartbeat()
        with run.begin_attempt() as second:
            second.publish()
        assert (run.state, run.attempt) == ("succeeded", 2)


def test_lines_that_are_no_reports_are_skipped(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    lines = [
        b'{"stage": "a", "seq": 0, "iteration": 1}',
        *(b"[" * 3000, b"\xff", b'{"seq": 1}', b'{"stage": "a", "seq": "2"}', b"7", b""),
        b'{"stage": "b", "seq": 3, "loss": null}',
    ]
    (run.folder / "events.jsonl").write_bytes(b"\n".join(lines) + b"\n")
    events, offset = read_events(run.folder)
    assert [(event["stage"], event["seq"]) for event in events] == [("a", 0), ("b", 3)]
    assert offset == sum(len(line) + 1 for line in lines)


def test_a_part_of_the_configuration_that_is_needed_is_told_by_name(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit", config={"source": 3, "parameters": {"drag": 1.0}})
    assert run.asked("parameters", dict[str, Any]) == {"drag": 1.0}
    with pytest.raises(RunError, match=r"job\.yaml, 'config\.source', is damaged: expected text"):
        run.asked("source", str)
    with pytest.raises(RunError, match=r"job\.yaml is damaged: field 'config\.profile' is miss"):
        run.asked("profile", dict[str, Any])


def test_what_could_not_be_read_again_is_not_made(tmp_path: Path) -> None:
    for changes, words in (
        ({"sequences": []}, "needs a sequence"),
        ({"config": {"a": float("inf")}}, "'config.a' is inf"),
        ({"name": "a\0b"}, "'name' is wrong"),
    ):
        with pytest.raises(RunError, match=words):
            make_run(tmp_path / "fit", **changes)
    assert list(tmp_path.iterdir()) == []


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
    with pytest.raises(RunError, match=r"'kind' is wrong \('shell' is not known"):
        Run.open(run.folder)
