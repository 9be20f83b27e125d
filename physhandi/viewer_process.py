"""`physhandi serve` as a child process, which is also how a script shows the viewer of a run.

The library itself knows no web framework.
"""

import atexit
import subprocess
import tempfile
import threading
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from urllib.parse import urlsplit, urlunsplit

from physhandi.child import start_module
from physhandi.data.run import RunFolder
from physhandi.errors import RunError

_TAIL = 2000
_PATIENCE_S = 120.0
_GRACE_S = 20.0


class ServerProcess:
    """A running ``physhandi serve`` on a free port that only this machine can reach."""

    def __init__(
        self, data_dir: Path, *options: str, environment: Mapping[str, str] | None = None
    ) -> None:
        """Start it and wait until it answers.

        Args:
            data_dir: Its data folder.
            options: More options of ``physhandi serve``.
            environment: More environment variables.

        Raises:
            RunError: If it does not start; says what it wrote.
        """
        self._errors = tempfile.TemporaryFile(  # noqa: SIM115  # closed with the server
            "w+", encoding="utf-8", errors="replace"
        )
        address = ["--host", "127.0.0.1", "--port", "0", "--data-dir", str(data_dir.resolve())]
        self._process = start_module(
            "app.cli",
            "serve",
            *address,
            *options,
            environment=environment,
            without_settings=True,
            outlives_parent=True,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            # What the keyboard sends to this program, or a notebook's kernel, is not meant for it.
            start_new_session=True,
        )
        self.url = ""
        """Address that it printed, with the token."""
        try:
            self.url = self._printed_address()
        except BaseException:
            self.stop()
            raise

    @property
    def process_id(self) -> int:
        """Process id of the server."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End it; nothing happens if it has ended."""
        if self.is_running:
            self._process.terminate()
        try:
            self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    def _printed_address(self) -> str:
        timer = threading.Timer(_PATIENCE_S, self._process.kill)
        timer.daemon = True
        timer.start()
        try:
            for line in self._process.stdout or ():
                if line.startswith("http://"):
                    return line.strip()
            self._process.wait()
        finally:
            timer.cancel()
        self._errors.seek(0)
        reason = self._errors.read()[-_TAIL:].strip() or "it said nothing"
        raise RunError(f"The server could not be started: {reason}")


class ViewerProcess:
    """The viewer of a run, which only this machine can reach; ends with this program.

    What is saved in the viewer goes to a temporary folder, which is deleted with it: download what
    shall stay, or serve the data folder with ``physhandi serve`` instead.
    """

    def __init__(self, run: RunFolder) -> None:
        """Start it and wait until it answers.

        Args:
            run: The run to show.

        Raises:
            RunError: If it does not start; says what it wrote.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="physhandi-show-")
        data_dir = Path(self._folder.name)
        for kind, name, target in (
            ("runs", run.id, run.folder),
            *(
                ("sequences", name, Path(folder))
                for name, folder in zip(run.sequence_names, run.sequences, strict=True)
            ),
        ):
            (data_dir / kind).mkdir(exist_ok=True)
            if target.is_dir():
                (data_dir / kind / name).symlink_to(target.resolve())
        try:
            self._server = ServerProcess(data_dir)
        except BaseException:
            self._folder.cleanup()
            raise
        atexit.register(self.stop)
        address = urlsplit(self._server.url)
        self.url = urlunsplit(address._replace(path=f"/runs/{run.id}/view"))
        """Address of the run's scene; whoever knows it may open it on this machine."""

    def __repr__(self) -> str:
        return f"ViewerProcess({self.url!r})" if self.is_running else "ViewerProcess(stopped)"

    def __enter__(self) -> "ViewerProcess":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def is_running(self) -> bool:
        """Whether the viewer can be opened."""
        return self._server.is_running

    def stop(self) -> None:
        """End the viewer and delete its temporary folder; nothing happens if it has ended."""
        atexit.unregister(self.stop)
        self._server.stop()
        self._folder.cleanup()


def show_run(run: RunFolder, *, opens_browser: bool) -> ViewerProcess:
    """Start the viewer of a run; see `physhandi.run.Run.show`."""
    viewer = ViewerProcess(run)
    if opens_browser:
        webbrowser.open(viewer.url)
    return viewer
