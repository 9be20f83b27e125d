"""Child processes: how our modules are started in one, told what to do, heard, limited and ended.

A module that can be started this way ends with `run_child`. It and its parent exchange lines of
JSON: requests on standard input, messages on standard output, of which the last one of a child
that failed says why (``error``, and ``kind``, the name of the error's class). Everything else that
is printed goes to standard error, of which the parent keeps a bounded log.
"""

import atexit
import ctypes
import gc
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NoReturn, cast

from physhandi import errors
from physhandi.errors import CancelledError, PhysHandiError, RunError, describe

logger = logging.getLogger(__name__)

PACKAGE_ROOT = Path(__file__).resolve().parent.parent
"""Folder of the packages and, in a checkout and in a wheel alike, of the data beside them."""
LOG_START = 49 * 2**20
"""Bytes of a log file that are kept from its start."""
LOG_END = 2**20
"""Bytes that are kept from the end of a log that is longer."""
_LAST_WORDS = 4_000
_LONGEST_MESSAGE = 2**20
_PATIENCE_S = 5.0
_SETTINGS_PREFIX = "PHYSHANDI_"
_SECRETS = ("PHYSHANDI_TOKEN", "PHYSHANDI_ENGINE_TOKEN", "RAY_AUTH_TOKEN")
_PARENT = "PHYSHANDI_PARENT"
"""Environment variable that tells a child the process with which it has to end."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PR_SET_PDEATHSIG = 1


def thread_limits(threads: int) -> dict[str, str]:
    """Give the environment variables that limit the threads of numeric libraries."""
    return dict.fromkeys(_THREADS, str(threads))


def start_module(
    module: str,
    *arguments: str,
    threads: int | None = None,
    environment: Mapping[str, str] | None = None,
    outlives_parent: bool = False,
    without_settings: bool = False,
    stdin: int = subprocess.DEVNULL,
    stdout: int = subprocess.DEVNULL,
    stderr: int | IO[Any] | None = None,
    pass_fds: Collection[int] = (),
    start_new_session: bool = False,
) -> "subprocess.Popen[str]":
    """Run ``python -m module`` in a process that is told none of our secrets.

    Args:
        module: One of our modules, which calls `run_child`.
        arguments: What it is called with; paths must be absolute.
        threads: How many threads its numeric libraries may start; none for one each processor,
            which hinder each other badly where several such processes work side by side.
        environment: More variables.
        outlives_parent: Whether it goes on when the thread that started it has ended.
        without_settings: Whether variables of the user that set up a server are kept from it.
        stdin: See `subprocess.Popen`; text in UTF-8, as are the others.
        stdout: See `subprocess.Popen`.
        stderr: See `subprocess.Popen`; None for this process's.
        pass_fds: Descriptors that it inherits.
        start_new_session: Whether it is spared what the keyboard sends to this process.
    """
    inherited = {
        name: value
        for name, value in os.environ.items()
        if name not in {*_SECRETS, _PARENT}
        and not (without_settings and name.startswith(_SETTINGS_PREFIX))
    }
    limits = {} if threads is None else thread_limits(threads)
    bond = {} if outlives_parent else {_PARENT: str(os.getpid())}
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        encoding="utf-8",
        errors="replace",
        pass_fds=pass_fds,
        start_new_session=start_new_session,
        # `-m` searches the working directory first, so it must be the one of our packages.
        cwd=PACKAGE_ROOT,
        env=inherited | {"PYTHONIOENCODING": "utf-8"} | limits | bond | dict(environment or {}),
    )


class ChildEndedError(RunError):
    """A child process ended without saying why; its log may tell."""

    def __init__(self, module: str, code: int, last_words: str, *, is_late: bool = False) -> None:
        """Say how it ended.

        Args:
            module: What ran in it.
            code: Its exit code; negative for a signal.
            last_words: End of its log.
            is_late: Whether it was ended because its time was over.
        """
        super().__init__(f"The process of {module} ended with code {code}. {last_words}".rstrip())
        self.code = code
        self.last_words = last_words
        self.is_late = is_late


class Child:
    """One of our modules at work in a process of its own, which ends with this one.

    Use it as a context manager: what is left of the process afterwards is killed.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        threads: int | None = None,
        environment: Mapping[str, str] | None = None,
        time_limit_s: float | None = None,
        log: Path | None = None,
        pass_fds: Collection[int] = (),
    ) -> None:
        """Start it.

        Args:
            module: See `start_module`.
            arguments: See `start_module`.
            threads: See `start_module`.
            environment: See `start_module`.
            time_limit_s: Time after which it is killed [s]; None for no limit.
            log: File that what it prints is appended to; None keeps only the end, in memory.
            pass_fds: See `start_module`.
        """
        self._module = module
        self._process = start_module(
            module,
            *arguments,
            threads=threads,
            environment=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=pass_fds,
            start_new_session=True,
        )
        self._requests = cast("IO[str]", self._process.stdin)
        self._messages = cast("IO[str]", self._process.stdout)
        self._last_words = b""
        self._is_late = False
        self._listener = threading.Thread(target=self._keep_log, args=(log,), daemon=True)
        self._listener.start()
        self._timer = threading.Timer(time_limit_s or 0.0, self._end_late)
        self._timer.daemon = True
        if time_limit_s is not None:
            self._timer.start()

    def __enter__(self) -> "Child":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, request: object) -> None:
        """Send a request as a line of JSON; one that has ended, or is closed, does not read it."""
        line = json.dumps(request) + "\n"
        # `messages` tells that it has ended, and why; another thread may have closed it by now.
        with suppress(BrokenPipeError, ValueError):
            self._requests.write(line)
            self._requests.flush()

    def end_requests(self) -> None:
        """Say that no further request comes."""
        with suppress(BrokenPipeError):
            self._requests.close()

    def messages(self) -> Iterator[dict[str, Any]]:
        """Give the messages of the process as they come, until it ends.

        Raises:
            PhysHandiError: If it failed; the error that it told.
            ChildEndedError: If it ended without telling one, or took too long.
        """
        error: PhysHandiError | None = None
        is_understood = True
        while line := self._messages.readline(_LONGEST_MESSAGE):
            try:
                message = json.loads(line)
            except ValueError:
                message = None
            if not isinstance(message, dict):
                self.kill()
                is_understood = False
                self._last_words += b"\n" + line[:200].encode()
                break
            fields = cast("dict[str, Any]", message)
            if "error" in fields:
                error = error_of(fields)
            else:
                yield fields
        code = self._process.wait()
        self._listener.join(_PATIENCE_S)
        if error is not None and is_understood and not self._is_late:
            raise error
        if code != 0 or not is_understood or self._is_late:
            words = self._last_words[-_LAST_WORDS:].decode(errors="replace").strip()
            raise ChildEndedError(self._module, code, words, is_late=self._is_late)

    def terminate(self) -> None:
        """Ask the process to end."""
        self._process.terminate()

    def kill(self) -> None:
        """Kill the process and all that it started in its session."""
        if self._process.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Kill what is left of the process and wait until it is gone."""
        self._timer.cancel()
        self.kill()
        self._process.wait()
        self._listener.join(_PATIENCE_S)
        self.end_requests()
        self._messages.close()

    @contextmanager
    def limited(self, time_limit_s: float) -> Generator[None]:
        """Kill the process unless what is done meanwhile ends in time.

        Args:
            time_limit_s: That time [s].

        Raises:
            ChildEndedError: If it did not.
        """
        timer = threading.Timer(time_limit_s, self._end_late)
        timer.daemon = True
        begin = time.monotonic()
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()
        # On a busy machine an answer may come while the timer still waits for a processor, or is
        # about to kill what has answered and would be asked again.
        if self._is_late or time.monotonic() - begin > time_limit_s:
            self._end_late()
            raise ChildEndedError(self._module, -signal.SIGKILL, "", is_late=True)

    def _end_late(self) -> None:
        self._is_late = True
        self.kill()

    def _keep_log(self, path: Path | None) -> None:
        with cast("IO[str]", self._process.stderr) as source:
            if path is not None:
                copy_log(source, path)
                return
            while chunk := os.read(source.fileno(), 65536):
                self._last_words = (self._last_words + chunk)[-_LAST_WORDS:]


class AnsweringChild:
    """A child that answers one request after another; when it has ended a new one is started.

    One thread at a time may use it.
    """

    def __init__(self, module: str, *arguments: str, **options: Any) -> None:
        """Prepare; the process starts with the first request.

        Args:
            module: See `Child`.
            arguments: See `Child`.
            options: See `Child`.
        """
        self._module = module
        self._start = partial(Child, module, *arguments, **options)
        self._child: Child | None = None
        self._messages: Iterator[dict[str, Any]] = iter(())

    def ask(self, request: object, time_limit_s: float) -> dict[str, Any]:
        """Send a request and give the answer, its next message.

        If the process ends, which may be another's doing, a new one is asked once more.

        Args:
            request: See `Child.send`.
            time_limit_s: Time for the answer, after which the process is killed [s].

        Raises:
            ChildEndedError: If the second process ended, too, or the time was over.
            PhysHandiError: What the process said before it ended.
        """
        try:
            return self._ask(request, time_limit_s)
        except ChildEndedError as end:
            if end.is_late:
                raise
        return self._ask(request, time_limit_s)

    def tell(self, request: object) -> None:
        """Send a request that has no answer; a process that has not started need not know."""
        if self._child is not None:
            self._child.send(request)

    def close(self) -> None:
        """End the process."""
        if self._child is not None:
            self._child.close()
        self._child = None

    def _ask(self, request: object, time_limit_s: float) -> dict[str, Any]:
        if self._child is None:
            self._child = self._start()
            self._messages = self._child.messages()
        try:
            with self._child.limited(time_limit_s):
                self._child.send(request)
                answer = next(self._messages, None)
        except BaseException:  # An answer that nobody waits for is not that to the next request.
            self.close()
            raise
        if answer is None:
            self.close()
            raise ChildEndedError(self._module, 0, "")
        return answer


def copy_log(source: IO[Any], path: Path) -> None:
    """Append what a process prints to a file; of too much, keep the start and the end.

    The process never waits: what cannot be written, as on a full disk, waits here for room, and of
    that the oldest is left out.
    """
    log = _CappedLog(path)
    while chunk := os.read(source.fileno(), 65536):
        log.append(chunk)
    log.end()


class _CappedLog:
    """A file of at most `LOG_START` bytes, and `LOG_END` more in memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting = b""
        self._room: int | None = None

    def append(self, chunk: bytes) -> None:
        self._waiting += chunk
        with suppress(OSError):
            if self._room is None:
                self._room = self._find_room()
            if self._room > 0:
                with self._path.open("ab", buffering=0) as log:
                    count = log.write(self._waiting[: self._room])
                self._room -= count
                self._waiting = self._waiting[count:]
        self._waiting = self._waiting[-LOG_END:]

    def end(self) -> None:
        if not self._waiting:
            return
        is_full = self._room is None or self._room <= 0
        mark = b"\n[the log is too long; this is its end]\n" if is_full else b""
        with suppress(OSError), self._path.open("ab") as log:
            log.write(mark + self._waiting)

    def _find_room(self) -> int:
        """Leave out the end of the attempt before, if that has filled the log."""
        size = self._path.stat().st_size if self._path.exists() else 0
        if size > LOG_START:
            os.truncate(self._path, LOG_START)
        return max(0, LOG_START - size)


def error_of(message: Mapping[str, Any]) -> PhysHandiError:
    """Make the error that a child told; those of other libraries become a `RunError`."""
    kind: Any = getattr(errors, str(message.get("kind")), None)
    if not (isinstance(kind, type) and issubclass(kind, PhysHandiError)):
        kind = RunError
    # These two are made of more than a sentence.
    if kind is errors.SettingsError:
        kind = errors.UsageError
    elif kind is errors.SimulationDivergedError:
        kind = errors.SimulationError
    return kind(str(message["error"]))


class Channel:
    """Messages between a child process and its parent, as the child sees them."""

    def __init__(self) -> None:
        self.arguments = sys.argv[1:]
        # Libraries print to standard output; messages have that place to themselves.
        # Written without a buffer, which a thread that ends with the process might hold locked.
        self._messages = os.dup(1)
        self._telling = threading.Lock()
        self._steps = 0
        os.dup2(2, 1)

    def requests(self) -> Iterator[Any]:
        """Give the requests of the parent as they come, until it says that there are no more."""
        for line in sys.stdin:
            yield json.loads(line)

    def tell(self, **fields: object) -> None:
        """Send a message; from any thread."""
        content = memoryview(json.dumps(fields).encode() + b"\n")
        with self._telling:
            while content:
                content = content[os.write(self._messages, content) :]

    def beat(self, interval_s: float) -> None:
        """Tell from now on that this process is alive, and how far it is (``beat``).

        Args:
            interval_s: Time between two signs [s].
        """

        def tell() -> None:
            with suppress(OSError):  # A parent that has gone takes this process along, or need not.
                while True:
                    self.tell(beat=self._steps)
                    time.sleep(interval_s)

        threading.Thread(target=tell, name="beat", daemon=True).start()

    def step(self) -> None:
        """Note that the work got on."""
        self._steps += 1


def run_child(work: Callable[[Channel], None]) -> NoReturn:
    """Do the work of a child process, tell its parent what went wrong, and exit.

    The process ends with its parent, unless that was started to outlive it.
    """
    end_without_collecting()
    parent = os.environ.pop(_PARENT, "")
    if parent:
        die_with_parent(int(parent))
    channel = Channel()
    try:
        work(channel)
    except CancelledError as error:
        logger.info("%s", error)
        channel.tell(error=str(error), kind="CancelledError")
        sys.exit(1)
    except (PhysHandiError, OSError, MemoryError) as error:
        # The message is for the user; no traceback.
        logger.error("%s", describe(error))  # noqa: TRY400
        channel.tell(error=describe(error), kind=type(error).__name__)
        sys.exit(1)
    except Exception as error:
        defect = f"{type(error).__name__}: {error}"
        logger.exception("stopped by a defect of the program (%s)", defect)
        channel.tell(error=defect, kind=type(error).__name__)
        sys.exit(1)
    sys.exit(0)


def end_without_collecting() -> None:
    """Have this process end without a search for garbage among all that torch and Warp loaded."""
    atexit.register(gc.freeze)


@contextmanager
def loading_modules() -> Generator[None]:
    """Import modules without searches for garbage, and leave what they hold out of later ones.

    It stays until the process ends. Searches were a quarter of the time that torch, Warp and SciPy
    take to load.
    """
    module_count, searches = len(sys.modules), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > module_count:
            gc.freeze()
        if searches:
            gc.enable()


def die_with_parent(parent: int) -> None:
    """Make the kernel kill this process when its parent ends (Linux); end it if that has happened.

    Args:
        parent: Process id that the parent is expected to have.
    """
    set_process_option(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


def set_process_option(option: int, value: int) -> None:
    """Call Linux's ``prctl``; on other systems nothing happens.

    Raises:
        OSError: If the kernel refuses.
    """
    if sys.platform == "linux" and ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl failed")
