"""A run folder: what was asked for, how far it is, and what came out."""

import os
import secrets
import shutil
from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from physhandi.data.attempt import Attempt
from physhandi.data.attempt import RunProgress as RunProgress
from physhandi.data.files import named_fields, plain, temporary_name, write_bytes, write_yaml
from physhandi.data.lease import Lease, live_holder, locked
from physhandi.data.result import RunOutputs
from physhandi.data.result import RunState as RunState
from physhandi.data.run_folder import (
    ATTEMPTS,
    CANCEL,
    JOB,
    LOG,
    PROGRESS,
    RUN,
    RUN_FORMAT,
    SAFE_ID,
    now,
    read_mapping,
    read_yaml,
)
from physhandi.data.run_folder import new_run_id as new_run_id
from physhandi.data.run_folder import read_events as read_events
from physhandi.data.sequence_meta import FILE, read_meta
from physhandi.errors import RunError

RunKind = Literal["reconstruction", "simulation"]


class Run(RunOutputs):
    """One execution of the pipeline, as its folder tells it. Use `Run.create` or `Run.open`.

    Relative paths of sequences in ``job.yaml`` start at the run's folder, so that a run and its
    sequences can be moved together.
    """

    def __init__(self, folder: Path, job: Mapping[str, Any], about: Mapping[str, Any]) -> None:
        super().__init__(folder)
        self.kind: RunKind = job["kind"]
        self.sequences: list[str] = [str(_absolute(folder / path)) for path in job["sequences"]]
        self.sequence_names: list[str] = list(job["sequence_names"])
        self.config: dict[str, Any] = dict(job["config"])
        self.name: str = about["name"]
        self.label: str = about.get("label", "")
        self.note: str = about.get("note", "")
        self.created: str = about["created"]

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @classmethod
    def create(
        cls,
        folder: Path | str,
        *,
        name: str,
        kind: RunKind,
        sequences: Many[str],
        config: Mapping[str, Any],
    ) -> "Run":
        """Make a run that waits for its first attempt.

        Args:
            folder: Where the run shall be; its last part is the run's id.
            name: What the user calls it.
            kind: What is to be done.
            sequences: Folders of the sequences.
            config: Settings, in plain data.

        Raises:
            RunError: If the folder is in use, its name is unsafe, or two sequences share a name.
            SequenceError: If a sequence folder has a damaged ``sequence.yaml``.
        """
        target = _absolute(folder)
        if not SAFE_ID.fullmatch(target.name):
            raise RunError(
                f"'{target.name}' cannot name a run; use 1-64 letters, digits, '_' or '-'."
            )
        names = [_sequence_name(Path(sequence)) for sequence in sequences]
        doubled = [name for name in names if names.count(name) > 1]
        if doubled:
            raise RunError(f"Two sequences are named '{doubled[0]}'. Rename one of them.")
        job = {
            "format": RUN_FORMAT,
            "kind": kind,
            "sequences": [str(_absolute(sequence)) for sequence in sequences],
            "sequence_names": names,
            "config": plain(config),
        }
        about = {"format": RUN_FORMAT, "name": name, "label": "", "created": now()}
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(temporary_name(target.name))
        temporary.mkdir()
        try:
            (temporary / ATTEMPTS).mkdir()
            write_yaml(temporary / JOB, job)
            write_yaml(temporary / RUN, about)
            temporary.replace(target)
        except OSError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            if not target.exists():
                raise
            raise RunError(
                f"{target} exists already and is not empty. Choose another folder."
            ) from error
        return cls(target, job, about)

    @classmethod
    def open(cls, folder: Path | str) -> "Run":
        """Open a run's folder.

        Raises:
            RunError: If the folder is not a run or is damaged; names the file.
        """
        path = _absolute(folder)
        if not (path / RUN).is_file() or not (path / JOB).is_file():
            raise RunError(f"{path} is not a run: it needs {RUN} and {JOB}.")
        job = named_fields(read_yaml(path / JOB)) or {}
        about = named_fields(read_yaml(path / RUN)) or {}
        for file, content, fields in (
            (JOB, job, {"kind": str, "sequences": list, "sequence_names": list, "config": dict}),
            (RUN, about, {"name": str, "created": str}),
        ):
            if content.get("format") != RUN_FORMAT:
                raise RunError(f"{path / file} is not in format {RUN_FORMAT}.")
            for field, kind in fields.items():
                if not isinstance(content.get(field), kind):
                    raise RunError(f"{path / file}: field '{field}' is missing or wrong.")
        if job["kind"] not in get_args(RunKind):
            known = " or ".join(get_args(RunKind))
            raise RunError(f"{path / JOB}: kind is {job['kind']!r}; expected {known}.")
        return cls(path, job, about)

    @property
    def progress(self) -> dict[str, Any]:
        """The latest report: ``stage iteration total loss message eta_s time``; empty at first."""
        return read_mapping(self.folder / PROGRESS)

    @property
    def log_path(self) -> Path:
        """Text log of the worker."""
        return self.folder / LOG

    def begin_attempt(self, *, take_over: bool = False) -> Attempt:
        """Start working on the run; stages that an earlier attempt finished are taken over.

        Args:
            take_over: Whether to replace a process that is still working on the run.

        Raises:
            RunError: If another process works on the run.
        """
        lease = Lease.acquire(self.folder, take_over=take_over)
        try:
            return Attempt(self.folder, lease)
        except BaseException:
            with locked(self.folder):
                lease.release()
            raise

    def request_cancel(self) -> None:
        """Ask the process that works on the run to stop."""
        write_bytes(self.folder / CANCEL, b"")

    def clear_cancel(self) -> None:
        """Withdraw a request to stop, before the run is started again."""
        (self.folder / CANCEL).unlink(missing_ok=True)

    def rename(
        self, name: str | None = None, *, label: str | None = None, note: str | None = None
    ) -> None:
        """Change what the user calls the run, its label (tags with commas between), or its note."""
        self.name = self.name if name is None else name
        self.label = self.label if label is None else label
        self.note = self.note if note is None else note
        about = {"name": self.name, "label": self.label, "note": self.note}
        write_yaml(self.folder / RUN, {"format": RUN_FORMAT} | about | {"created": self.created})

    def delete(self) -> None:
        """Remove the run from disk.

        Raises:
            RunError: If a process works on it.
        """
        holder = live_holder(self.folder)
        if holder is not None:
            raise RunError(f"Run '{self.id}' is running. Cancel it before you delete it.")
        trash = self.folder.with_name(f".{self.id}.{secrets.token_hex(4)}.deleted")
        self.folder.replace(trash)
        shutil.rmtree(trash, ignore_errors=True)


@dataclass(frozen=True)
class RunEntry:
    """One folder of a listing: its run, or why it cannot be used."""

    folder: Path
    run: Run | None
    error: str | None


def find_runs(folder: Path | str) -> list[RunEntry]:
    """List the runs directly below a folder, by name.

    A damaged run is listed with its error; nothing is raised because of one.
    """
    root = Path(folder)
    entries: list[RunEntry] = []
    if not root.is_dir():
        return entries
    for path in sorted(root.iterdir()):
        if path.name.startswith(".") or not ((path / RUN).is_file() or (path / JOB).is_file()):
            continue
        try:
            entries.append(RunEntry(path, Run.open(path), None))
        except (RunError, OSError) as error:
            entries.append(RunEntry(path, None, str(error)))
    return entries


def _sequence_name(folder: Path) -> str:
    """Give a sequence's own name; where the folder cannot be read from here, the folder's."""
    return read_meta(folder).name if (folder / FILE).is_file() else folder.name


def _absolute(path: Path | str) -> Path:
    """Make a path absolute and drop ``..``; links stay as the user wrote them."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() would follow links
