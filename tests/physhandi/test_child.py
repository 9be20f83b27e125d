"""Child processes: what they are given, how they are heard, limited and ended."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.waiting import until

from physhandi import child as child_module
from physhandi.child import (
    PACKAGE_ROOT,
    AnsweringChild,
    Child,
    ChildEndedError,
    copy_log,
    error_of,
)
from physhandi.errors import (
    CancelledError,
    MissingInputError,
    RunError,
    SettingsError,
    SimulationDivergedError,
    SimulationError,
    UsageError,
)

SECONDS = 150.0


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let children find `child_deeds`."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))


def start(deed: str, **options: object) -> Child:
    return Child("support.child_deeds", deed, **options)  # type: ignore[arg-type]  # passed on as they are


def test_requests_and_messages_are_lines_of_json_in_every_locale(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("LC_ALL", "POSIX"), ("PYTHONCOERCECLOCALE", "0"), ("PYTHONUTF8", "0")):
        monkeypatch.setenv(name, value)
    with start("echo") as child:
        child.send({"δ": "Hände"})
        child.send(["two\nlines"])
        child.end_requests()
        assert list(child.messages()) == [{"heard": {"δ": "Hände"}}, {"heard": ["two\nlines"]}]


def test_a_child_gets_our_packages_and_few_threads_and_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PHYSHANDI_TOKEN", "do-not-tell-anybody")
    monkeypatch.setenv("PHYSHANDI_DEVICE", "cpu")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with start("about", threads=3) as child:
        (about,) = child.messages()
    environment = about["environment"]
    assert "do-not-tell-anybody" not in environment.values()
    assert environment["PHYSHANDI_DEVICE"] == "cpu"
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    assert [environment[name] for name in names] == ["3", "3", "3"]
    assert about["folder"] == str(PACKAGE_ROOT)
    assert about["session"]
    assert about["arguments"] == ["about"]
    with start("about") as child:
        (about,) = child.messages()
    assert about["environment"]["OMP_NUM_THREADS"] == "7"


@pytest.mark.parametrize(
    ("deed", "kind", "words"),
    [
        ("usage", UsageError, "^width: 3 is too small.$"),
        ("defect", RunError, "^KeyError: 'node'$"),
        ("disk", RunError, "/there: No space left on device. Free some space"),
        ("cancelled", CancelledError, "^stopped$"),
        ("silent", ChildEndedError, "^The process of support.child_deeds ended with code 5.$"),
        ("crash", ChildEndedError, "ended with code 7. the last words$"),
    ],
)
def test_what_went_wrong_is_raised_where_the_child_is_heard(
    deed: str, kind: type[Exception], words: str
) -> None:
    with start(deed) as child, pytest.raises(kind, match=words):
        list(child.messages())


def test_a_child_that_takes_too_long_is_killed_with_all_that_it_started() -> None:
    with start("another") as child:
        other = psutil.Process(next(child.messages())["pid"])
        child.kill()
        with pytest.raises(ChildEndedError) as raised:
            list(child.messages())
        assert (raised.value.code, raised.value.is_late) == (-signal.SIGKILL, False)
    until(lambda: not other.is_running() or other.status() == psutil.STATUS_ZOMBIE)
    with start("forever", time_limit_s=0.01) as late, pytest.raises(ChildEndedError) as raised:
        list(late.messages())
    assert raised.value.is_late


def test_an_answer_that_comes_too_late_is_none_although_the_timer_is_later_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class LaterTimer(threading.Timer):
        """On a busy machine: it waits for a processor until the answer is there."""

        kills = False

        def run(self) -> None:
            self.finished.wait()
            if self.kills:
                self.function()

    monkeypatch.setattr(threading, "Timer", LaterTimer)
    answering = AnsweringChild("support.child_deeds", "echo")
    for LaterTimer.kills, limit_s in ((False, 0.0), (True, 300.0)):
        with pytest.raises(ChildEndedError) as raised:
            answering.ask(1, limit_s)
        assert raised.value.is_late
    LaterTimer.kills = False
    assert answering.ask(2, 300.0) == {"heard": 2}
    answering.close()


def test_a_child_ends_with_its_parent_unless_it_outlives_it() -> None:
    code = (
        "from physhandi.child import start_module\n"
        "import os\n"
        "for outlives in (False, True):\n"
        "    options = {'outlives_parent': outlives, 'start_new_session': True}\n"
        "    print(start_module('support.child_deeds', 'forever', **options).pid, flush=True)\n"
        "input()\n"
    )
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes, cwd=PACKAGE_ROOT) as parent:
        assert parent.stdout is not None
        bound, free = (psutil.Process(int(parent.stdout.readline())) for _ in range(2))
        parent.kill()
    until(lambda: not bound.is_running() or bound.status() == psutil.STATUS_ZOMBIE)
    assert free.is_running()
    free.kill()


def test_modules_are_loaded_without_searches_for_garbage_and_left_out_of_later_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # What counts lines makes garbage, and searches for it.
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
    code = """
import gc
from physhandi.child import loading_modules
searches = []
gc.callbacks.append(lambda phase, _: searches.append(phase))
with loading_modules():
    import tomllib
    kept = [[number] for number in range(10_000)]
assert searches == []
assert gc.isenabled() and gc.get_freeze_count() > len(kept)
frozen = gc.get_freeze_count()
gc.disable()
with loading_modules():
    import tomllib
assert not gc.isenabled() and gc.get_freeze_count() == frozen
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=PACKAGE_ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_what_is_printed_goes_to_the_log_and_not_among_the_messages(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_text("before\n")
    with start("print", log=log) as child:
        assert list(child.messages()) == [{"said": True}]
    assert log.read_text(encoding="utf-8") == "before\nδ\n"


def test_of_too_long_a_log_the_start_and_the_end_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_module, "LOG_START", 10)
    monkeypatch.setattr(child_module, "LOG_END", 5)
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as source, os.fdopen(writing, "wb") as sink:
        sink.write(b"0123456789abcdefghij")
        sink.close()
        copy_log(source, tmp_path / "log.txt")
    assert (tmp_path / "log.txt").read_bytes() == (
        b"0123456789\n[the log is too long; this is its end]\nfghij"
    )


def test_a_log_waits_for_a_disk_and_the_process_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_module, "LOG_END", 6)
    log = child_module._CappedLog(tmp_path / "late" / "log.txt")
    log.append(b"lost")
    log.append(b"kept")
    (tmp_path / "late").mkdir()
    log.append(b" on")
    assert (tmp_path / "late" / "log.txt").read_bytes() == b"stkept on"
    # An attempt that follows one that filled the log leaves out the end of that.
    monkeypatch.setattr(child_module, "LOG_START", 3)
    again = child_module._CappedLog(tmp_path / "late" / "log.txt")
    again.append(b"new")
    again.end()
    mark = b"\n[the log is too long; this is its end]\n"
    assert (tmp_path / "late" / "log.txt").read_bytes() == b"stk" + mark + b"new"
    # A device on which every write fails for want of room.
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as source, os.fdopen(writing, "wb") as sink:
        sink.write(b"x" * 50_000)
        sink.close()
        copy_log(source, Path("/dev/full"))
        assert source.read() == b""


def test_a_message_that_is_none_ends_the_child() -> None:
    with Child("json.tool", "--compact") as child:
        child.send([1])
        child.end_requests()
        with pytest.raises(ChildEndedError, match=r"\[1\]"):
            list(child.messages())


def test_a_child_that_ended_does_not_read_what_it_is_sent() -> None:
    with start("usage") as child:
        with pytest.raises(UsageError):
            list(child.messages())
        for _ in range(3):
            child.send("x" * 2**16)
    child.send("closed as well")


def test_errors_made_of_more_than_a_sentence_come_back_as_their_kind() -> None:
    def passed_on(error: Exception) -> Exception:
        return error_of({"error": str(error), "kind": type(error).__name__})

    assert type(passed_on(MissingInputError("no hands"))) is MissingInputError
    assert type(passed_on(SettingsError({"a": "is wrong"}))) is UsageError
    diverged = SimulationDivergedError("too fast", frame=1, substep=2, node=3)
    assert type(passed_on(diverged)) is SimulationError
    assert type(passed_on(ValueError("x"))) is RunError
    assert type(error_of({"error": "x", "kind": "describe"})) is RunError


def test_a_folder_of_the_user_s_named_like_a_package_is_not_run(tmp_path: Path) -> None:
    for package in ("app", "physhandi"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("raise SystemExit('not ours')")
    code = (
        "from physhandi.child import Child\n"
        "with Child('support.child_deeds', 'about') as child:\n"
        "    print(next(child.messages())['folder'])\n"
    )
    places = [str(PACKAGE_ROOT), os.environ["PYTHONPATH"]]
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(places)},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert (done.stdout, done.returncode) == (f"{PACKAGE_ROOT}\n", 0), done.stderr


def test_a_process_that_ends_searches_nothing_of_what_it_has_loaded() -> None:
    code = (
        "import atexit, gc\n"
        "atexit.register(lambda: print(gc.get_freeze_count(), len(gc.get_objects())))\n"
        "from physhandi.child import run_child\n"
        "run_child(lambda _: print(gc.get_freeze_count()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS, check=True
    )
    at_work, left, searched = (int(word) for word in done.stderr.split())
    assert at_work == 0  # While it works, garbage is found.
    assert left > 10_000 > 100 * searched
