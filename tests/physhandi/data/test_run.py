"""Run folders: publication is all or nothing, and damage is named."""

import errno
import json
import multiprocessing
import os
import resource
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
from support.server.run_world import fill, make_run
from support.waiting import LIMIT_S

from physhandi.data import attempt as attempt_module
from physhandi.data import lease
from physhandi.data import run as run_module
from physhandi.data.arrays import write_array
from physhandi.data.run_folder import read_events
from physhandi.errors import CancelledError, RunError
from physhandi.progress import Preview, Progress
from physhandi.run import Run


def test_everything_written_comes_back(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit-1")
    assert run.state == "queued"
    assert not run.has("metrics.json")
    fill(run)
    again = Run.open(tmp_path / "fit-1")
    assert (again.id, again.name, again.kind, again.state) == (
        "fit-1",
        "My fit",
        "reconstruction",
        "succeeded",
    )
    assert again.config == {"radius": 0.02, "search": {"iterations": 3}}
    assert again.sequences == ["/data/lift"]
    assert again.sequence_names == ["lift"]
    assert again.is_published
    assert again.out == tmp_path / "fit-1" / "attempts" / "1" / "out"
    rollout = again.array("sequences/lift/rollout.npy")
    assert isinstance(rollout, np.memmap)
    np.testing.assert_array_equal(rollout, np.full((4, 2, 3), 1.5))
    np.testing.assert_array_equal(
        again.tensors("object/material.safetensors")["stiffness"], [0, 2, 4]
    )
    assert again.yaml("object/parameters.yaml") == {"drag": 3.0}
    assert again.json("metrics.json") == {"track": 0.5, "bad": None}
    assert again.json("losses.json")["first_order"]["after"] == 0.5
    again.verify()


def test_a_flipped_byte_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    fill(run)
    path = run.out / "sequences/lift/rollout.npy"
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(RunError, match=r"'fit': sequences/lift/rollout.npy has changed"):
        run.verify()
    path.write_bytes(bytes(content[:-1]))
    with pytest.raises(RunError, match=r"rollout.npy has \d+ bytes instead of \d+"):
        run.verify()
    with pytest.raises(RunError, match=r"rollout.npy is not a readable array"):
        run.array("sequences/lift/rollout.npy")
    path.unlink()
    with pytest.raises(RunError, match=r"rollout.npy is missing"):
        run.verify()


def test_a_file_that_the_manifest_does_not_know_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    fill(run)
    (run.out / "extra.npy").write_bytes(b"x")
    with pytest.raises(RunError, match=r"extra.npy is not in MANIFEST.json"):
        run.verify()


def test_a_stolen_lease_forbids_publication(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    first = run.begin_attempt()
    first.save_array("a.npy", np.zeros(3))
    assert run.state == "running"
    with pytest.raises(RunError, match="is being written by process"):
        run.begin_attempt()
    second = run.begin_attempt(take_over=True)
    for action in (first.publish, first.heartbeat, first.cancelled, lambda: first.fail("x")):
        with pytest.raises(RunError, match="was taken over by another process"):
            action()
    assert not run.is_published
    assert run.state == "running"
    second.save_array("a.npy", np.ones(3))
    second.publish()
    np.testing.assert_array_equal(run.array("a.npy"), np.ones(3))
    with pytest.raises(RunError, match="taken over"):
        first.publish()
    assert run.out.parent.name == "2"


def test_a_run_that_begins_while_it_is_looked_at_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "fit")
    look = run_module.live_holder

    def begins_after_it(folder: Path) -> object:
        holder = look(folder)
        monkeypatch.setattr(run_module, "live_holder", look)
        run.begin_attempt()
        return holder

    monkeypatch.setattr(run_module, "live_holder", begins_after_it)
    assert run.state == "queued"
    assert run.state == "running"


def test_a_claim_of_a_process_that_is_gone_is_void(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    attempt = run.begin_attempt()
    path = run.folder / "lease.json"
    claim = json.loads(path.read_text())
    boot, _, ticks = claim["process"].rpartition(".")
    for later in (f"{boot}.{int(ticks) + 1}", f"another-boot.{ticks}"):
        path.write_text(json.dumps(claim | {"process": later}))
        assert run.state == "failed"
        assert "gone without a word" in (run.error or "")
    # As earlier versions wrote it.
    created = psutil.Process().create_time()
    old = {name: value for name, value in claim.items() if name != "process"}
    path.write_text(json.dumps(old | {"process_created": created}))
    assert run.state == "running"
    path.write_text(json.dumps(old | {"process_created": created - 100}))
    assert run.state == "failed"
    path.write_text("{torn")
    assert run.state == "failed"
    with run.begin_attempt() as second:
        assert second.number == attempt.number + 1
        second.publish()
    assert run.state == "succeeded"


def test_a_claim_of_another_host_is_void_when_it_is_not_renewed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, late = make_run(tmp_path / "fit"), make_run(tmp_path / "late")
    clock = {"time": 5_000.0, "monotonic": 100.0}
    monkeypatch.setattr(lease, "time", SimpleNamespace(**{k: lambda k=k: clock[k] for k in clock}))

    def claim(of: Run, at: float) -> None:
        content = {"nonce": "n", "host": "elsewhere", "pid": 1, "time": at}
        (of.folder / "lease.json").write_text(json.dumps(content))

    def is_held(of: Run) -> bool:
        return lease.live_holder(of.folder) is not None

    claim(run, at=4_990.0)
    claim(late, at=5_000.0 - lease.REMOTE_TIMEOUT_S)
    assert (is_held(run), is_held(late)) == (True, False)
    # Who has looked before does not care what the clock is set to, only whether it is renewed.
    clock["time"] += 3_600.0
    assert is_held(run)
    for _ in range(3):
        clock["monotonic"] += 0.9 * lease.REMOTE_TIMEOUT_S
        assert is_held(run)
        claim(run, at=clock["monotonic"])
    assert is_held(run)
    clock["monotonic"] += lease.REMOTE_TIMEOUT_S
    assert not is_held(run)


ORIGIN = {"settings": "those of today"}


def fail_in_the_second_stage(run: Run) -> None:
    with run.begin_attempt() as attempt:
        attempt.save_array("hands.npy", np.full(3, 7.0))
        attempt.finish_stage("hands", {"before": 4.0, "after": 1.0})
        attempt.save_array("half.npy", np.zeros(9))
        attempt.checkpointer(ORIGIN).write("search", 4, {"mean": np.array([1.0, 2.0])})
        raise ZeroDivisionError("no luck")


def test_finished_stages_are_taken_over(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    with pytest.raises(ZeroDivisionError):
        fail_in_the_second_stage(run)
    assert run.state == "failed"
    assert run.error == "no luck"
    with run.begin_attempt() as attempt:
        assert attempt.stage_done("hands")
        assert not attempt.stage_done("search")
        assert sorted(p.name for p in attempt.out.iterdir()) == ["hands.npy", "losses.json"]
        state = attempt.checkpointer(ORIGIN).load("search", {"mean": np.zeros(2)})
        assert state is not None
        assert state.iteration == 4
        np.testing.assert_array_equal(state.tensors["mean"], [1.0, 2.0])
        attempt.save_array("object.npy", np.ones(2))
        attempt.finish_stage("search")
        assert list(run.folder.glob("attempts/*/ckpt")) == []
        attempt.publish()
    np.testing.assert_array_equal(run.array("hands.npy"), [7.0, 7.0, 7.0])
    assert list(run.json("losses.json")) == ["hands", "search"]
    run.verify()


def test_a_stage_whose_files_changed_is_done_again(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    attempt = run.begin_attempt()
    for stage in ("one", "two", "three"):
        attempt.save_array(f"{stage}.npy", np.zeros(3))
        attempt.finish_stage(stage)
    (attempt.out / "two.npy").write_bytes(b"broken")
    attempt.fail("power cut")
    with run.begin_attempt() as again:
        assert [again.stage_done(s) for s in ("one", "two", "three")] == [True, False, False]
        assert not (again.out / "two.npy").exists()
        again.publish()


def test_a_later_attempt_leaves_published_files_alone(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    fill(run)
    old = run.out / "metrics.json"
    before = old.read_bytes()
    with run.begin_attempt() as attempt:
        attempt.save_json("metrics.json", {"track": 0.1})
    assert run.state == "failed"
    assert run.error == "The attempt ended without publishing its results."
    assert old.read_bytes() == before
    assert run.json("metrics.json")["track"] == 0.5
    run.verify()
    with run.begin_attempt() as attempt:
        attempt.save_json("metrics.json", {"track": 0.1})
        attempt.publish()
    assert run.json("metrics.json") == {"track": 0.1}
    run.verify()


def cancel_at_the_second_check(run: Run) -> None:
    with run.begin_attempt() as attempt:
        progress = attempt.progress()
        progress.check_cancelled()
        run.request_cancel()
        progress.check_cancelled()


def test_cancel_stops_at_the_next_check_and_resume_goes_on(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    with pytest.raises(CancelledError, match="'fit' was cancelled"):
        cancel_at_the_second_check(run)
    assert run.state == "cancelled"
    with run.begin_attempt() as attempt:
        attempt.progress().check_cancelled()
        attempt.publish()
    assert run.state == "succeeded"


def test_a_cancel_before_the_first_attempt_is_heard(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    run.request_cancel()
    assert run.state == "cancelled"
    with pytest.raises(CancelledError), run.begin_attempt() as attempt:
        attempt.progress().check_cancelled()
    run.clear_cancel()
    assert run.state == "cancelled"


class Recorder(Progress):
    def __init__(self) -> None:
        self.reports: list[tuple[object, ...]] = []

    def report(
        self, stage: str, iteration: int, total: int, loss: float | None = None, message: str = ""
    ) -> None:
        self.reports.append((stage, iteration, total, loss, message))


def test_events_are_numbered_across_attempts(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    recorder = Recorder()
    attempt = run.begin_attempt()
    progress = attempt.progress(recorder)
    for iteration in range(1, 4):
        progress.report("search", iteration, 3, 1.0 / iteration, "größer " + "\U0001f600" * 9000)
    progress.report("fit", 1, 100, float("inf"))
    attempt.fail("stop")
    assert [report[0] for report in recorder.reports] == ["search"] * 3 + ["fit"]
    events, offset = read_events(run.folder)
    assert [event["seq"] for event in events] == [0, 1, 2, 3]
    assert events[2]["loss"] == pytest.approx(1 / 3)
    assert events[3]["loss"] is None
    lines = (run.folder / "events.jsonl").read_bytes().splitlines()
    assert max(len(line) for line in lines) < 4096
    with (run.folder / "events.jsonl").open("a") as stream:
        stream.write('{"seq": 4, "st')
    assert read_events(run.folder, offset) == ([], offset)
    with run.begin_attempt() as second:
        second.progress().report("fit", 2, 100, 0.25)
        second.publish()
    events, _ = read_events(run.folder, offset)
    assert [(event["seq"], event["attempt"], event["loss"]) for event in events] == [(4, 2, 0.25)]
    assert run.progress["iteration"] == 2


def test_a_replaced_process_stops_at_its_next_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physhandi.data.attempt._HEARTBEAT_INTERVAL_S", 0.0)
    run = make_run(tmp_path / "fit")
    progress = run.begin_attempt().progress()
    before = json.loads((run.folder / "lease.json").read_text())["time"]
    progress.report("fit", 1, 9)
    assert json.loads((run.folder / "lease.json").read_text())["time"] > before
    run.begin_attempt(take_over=True)
    with pytest.raises(RunError, match="taken over"):
        progress.report("fit", 2, 9)


def no_room(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_ends_no_fit_by_what_only_tells_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("physhandi.data.attempt._HEARTBEAT_INTERVAL_S", 0.0)
    run = make_run(tmp_path / "fit")
    shown = Preview(
        stage="fit", sequence="a", loss=1.0, frame_rate=30.0, points={"object": np.zeros((2, 3, 3))}
    )
    with run.begin_attempt() as attempt:
        progress = attempt.progress()
        with monkeypatch.context() as full:
            full.setattr("physhandi.data.attempt.write_atomically", no_room)
            full.setattr("physhandi.data.attempt.write_json", no_room)
            full.setattr("physhandi.data.lease.write_json", no_room)
            events = run.folder / "events.jsonl"
            events.symlink_to("/dev/full")
            for iteration in range(3):
                progress.report("fit", iteration, 9)
                progress.preview(lambda: shown)
            events.unlink()
        assert caplog.text.count("can be told: ") == 1
        assert "No space left on device" in caplog.text
        # Half a line was written before the disk was full.
        write = os.write
        with monkeypatch.context() as full:
            full.setattr(os, "write", lambda file, text: write(file, text[: len(text) // 2]))
            progress.report("fit", 3, 9)
        progress.report("fit", 4, 9)
        progress.report("fit", 5, 9)
        attempt.publish()
    run.verify()
    found, _ = read_events(run.folder)
    assert [(event["seq"], event["iteration"]) for event in found] == [(0, 4), (1, 5)]
    # Other errors are no want of room.
    with run.begin_attempt(), monkeypatch.context() as gone:
        gone.setattr(
            "physhandi.data.attempt.write_json", lambda *_, **__: (run.folder / "x").stat()
        )
        with pytest.raises(FileNotFoundError):
            progress.report("other", 1, 9)


def test_the_end_of_a_fit_is_noted_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "fit")
    reserve = run.folder / ".reserve"
    written = attempt_module.write_json

    def write(path: Path, content: object) -> None:
        if reserve.exists():
            no_room()
        written(path, content)

    attempt = run.begin_attempt()
    assert reserve.stat().st_size > 8000
    monkeypatch.setattr(attempt_module, "write_json", write)
    with pytest.raises(OSError, match=r"No space"), attempt:
        attempt.save_json("result.json", {})
    assert (run.state, reserve.exists()) == ("failed", False)
    assert "No space left on device. Free some space" in (run.error or "")


def test_an_array_too_large_for_its_disk_says_so(tmp_path: Path) -> None:
    path = tmp_path / "large.npy"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match=r"large\.npy") as caught:
            write_array(path, np.zeros(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.errno == errno.EFBIG
    assert list(tmp_path.iterdir()) == []
    for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.eye(3)), np.zeros(())):
        write_array(path, array)
        np.testing.assert_array_equal(np.load(path), array)


def try_to_begin(folder: Path, start: Any, results: Any) -> None:
    run = Run.open(folder)
    start.wait()
    try:
        run.begin_attempt()
    except RunError:
        results.put("refused")
    else:
        results.put("begun")
    start.wait()  # The holder stays alive until all have tried.


def test_only_one_of_several_processes_may_begin(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    for trial in range(5):
        run = make_run(tmp_path / f"fit{trial}")
        start, results = context.Barrier(3), context.Queue()
        children = [
            context.Process(target=try_to_begin, args=(run.folder, start, results), daemon=True)
            for _ in range(3)
        ]
        for child in children:
            child.start()
        assert sorted(results.get(timeout=LIMIT_S) for _ in children) == [
            "begun",
            "refused",
            "refused",
        ]
        for child in children:
            child.join()
        assert run.state == "failed"


def test_a_run_that_is_interrupted_again_and_again_keeps_its_stages(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    for number in range(4):
        attempt = run.begin_attempt()
        assert attempt.stage_done("hands") == (number > 0)
        attempt.save_json("environment.json", {"started": number})
        if number == 0:
            attempt.save_array("hands.npy", np.arange(3.0))
            attempt.finish_stage("hands")
        attempt.cancelled()
    assert run.begin_attempt().stage_done("hands")
