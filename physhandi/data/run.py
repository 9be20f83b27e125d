"""A run folder: what was asked for, how far it is, and what came out."""

import os
import secrets
import shutil
from collections.abc import Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any, Literal, TypeVar

from numpy import ndarray
from safetensors import SafetensorError

from physhandi.data.arrays import read_array, read_tensors
from physhandi.data.attempt import Attempt, prune
from physhandi.data.files import (
    named_fields,
    plain,
    require_plain,
    temporary_name,
    write_bytes,
    write_yaml,
)
from physhandi.data.layout import SequenceFiles
from physhandi.data.lease import Lease, live_holder, locked
from physhandi.data.run_folder import (
    ATTEMPTS,
    CANCEL,
    CURRENT,
    EXIT,
    JOB,
    MANIFEST,
    OUT,
    PROGRESS,
    RUN,
    RUN_FORMAT,
    SAFE_ID,
    STAGES_FILE,
    AboutFile,
    Checked,
    EventLine,
    ExitFile,
    JobFile,
    ManifestFile,
    RecordingFile,
    RunEnd,
    RunKind,
    StageEntry,
    artefacts,
    attempt_numbers,
    checked,
    find_damage,
    inside,
    is_filled,
    now,
    read_json,
    read_number,
    read_record,
    read_yaml,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE, read_meta
from physhandi.errors import RunError

RunState = Literal["queued", "running"] | RunEnd
_Kind = TypeVar("_Kind", bound="RunFolder")
_VANISHED = "The process that worked on this run is gone without a word. Start it again to go on."


class RunFolder:
    """One execution of the pipeline, as its folder tells it; read anew each time it is asked.

    Use `RunFolder.create` or `RunFolder.open`.

    Relative paths of sequences in ``job.yaml`` start at the run's folder, so that a run and its
    sequences can be moved together.
    """

    def __init__(self, folder: Path, job: JobFile, about: AboutFile) -> None:
        self.folder = folder
        self.id = folder.name
        self.kind: RunKind = job["kind"]
        self.sequences: list[str] = [str(_absolute(folder / path)) for path in job["sequences"]]
        self.sequence_names: list[str] = list(job["sequence_names"])
        self.config: dict[str, Any] = dict(job["config"])
        self.name: str = about["name"]
        self.label: str = about.get("label", "")
        self.note: str = about.get("note", "")
        self.created: str = about["created"]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.folder)!r})"

    @classmethod
    def create(
        cls: type[_Kind],
        folder: Path | str,
        *,
        name: str,
        kind: RunKind,
        sequences: Many[str],
        config: Mapping[str, Any],
    ) -> _Kind:
        """Make a run that waits for its first attempt.

        Args:
            folder: Where the run shall be; its last part is the run's id.
            name: What the user calls it.
            kind: What is to be done.
            sequences: Folders of the sequences.
            config: Settings, in plain data.

        Raises:
            RunError: If the folder is in use, its name is unsafe, there is no sequence, two of them
                share a name, or the settings are no plain data.
            SequenceError: If a sequence folder has a damaged ``sequence.yaml``.
        """
        target = _absolute(folder)
        if not SAFE_ID.fullmatch(target.name):
            raise RunError(
                f"'{target.name}' cannot name a run; use 1-64 letters, digits, '_' or '-'."
            )
        if not sequences:
            raise RunError(f"Run '{target.name}' needs a sequence; name at least one.")
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
        try:
            require_plain(job)
        except ValueError as error:
            raise RunError(f"Run '{target.name}' cannot be described: {error}.") from None
        run = cls.of_content(target, job, about)
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
        return run

    @classmethod
    def open(cls: type[_Kind], folder: Path | str) -> _Kind:
        """Open a run's folder.

        Raises:
            RunError: If the folder is not a run or is damaged; names the file.
        """
        path = _absolute(folder)
        if not (path / RUN).is_file() or not (path / JOB).is_file():
            raise RunError(f"{path} is not a run: it needs {RUN} and {JOB}.")
        job, about = read_yaml(path / JOB), read_yaml(path / RUN)
        for file, content in ((JOB, job), (RUN, about)):
            file_format = (named_fields(content) or {}).get("format")
            if file_format != RUN_FORMAT:
                advice = ""
                if isinstance(file_format, str) and file_format.startswith(
                    RUN_FORMAT.partition("/")[0]
                ):
                    advice = f", but {file_format[:40]}: update the program to read it"
                raise RunError(f"{path / file} is not in format {RUN_FORMAT}{advice}.")
        return cls.of_content(path, job, about)

    @classmethod
    def of_content(cls: type[_Kind], folder: Path, job: Any, about: Any) -> _Kind:
        """Make a run of what its files hold.

        Raises:
            RunError: If a field of them is missing or wrong; names it.
        """
        job = checked(job, JobFile, folder / JOB)
        if len(job["sequences"]) != len(job["sequence_names"]):
            raise RunError(
                f"{folder / JOB} is damaged: it has {len(job['sequences'])} sequences, but "
                f"{len(job['sequence_names'])} sequence_names."
            )
        return cls(folder, job, checked(about, AboutFile, folder / RUN))

    def asked(self, name: str, kind: type[Checked]) -> Checked:
        """Give a part of the configuration without which the run cannot be computed.

        Args:
            name: Name of the part.
            kind: What it has to be.

        Raises:
            RunError: If it is missing or wrong; names file and field.
        """
        path = self.folder / JOB
        if name not in self.config:
            raise RunError(f"{path} is damaged: field 'config.{name}' is missing.")
        return checked(self.config[name], kind, f"{path}, 'config.{name}',")

    @property
    def state(self) -> RunState:
        """State of the run."""
        # Looked for before the lease, which an attempt takes first: one that begins between the two
        # looks has not failed.
        was_begun = bool(attempt_numbers(self.folder))
        if live_holder(self.folder) is not None:
            return "running"
        end = read_record(self.folder / EXIT, ExitFile)
        if end is not None:
            return end["state"]
        if is_filled(self.folder):
            return "succeeded"
        if (self.folder / CANCEL).exists():
            return "cancelled"
        return "failed" if was_begun else "queued"

    @property
    def error(self) -> str | None:
        """Error of a failed run."""
        if self.state != "failed":
            return None
        end = read_record(self.folder / EXIT, ExitFile) or {}
        return str(end.get("error") or _VANISHED)

    @property
    def is_published(self) -> bool:
        """Whether there are published results."""
        return self._published() is not None

    @property
    def attempt(self) -> int | None:
        """Number of the latest attempt; none if no attempt was begun yet."""
        return max(attempt_numbers(self.folder), default=None)

    def stages(self) -> list[dict[str, Any]]:
        """Give the finished stages of the latest attempt, in the order in which they ended.

        Returns:
            For each stage ``name``, ``time`` of its end, ``seconds`` that it took (where they were
            measured), ``summary`` (what `Attempt.finish_stage` was told) and ``files``.

        Raises:
            RunError: If their list is damaged.
        """
        path = self.folder / ATTEMPTS / str(self.attempt) / STAGES_FILE
        return [dict(stage) for stage in read_record(path, list[StageEntry]) or ()]

    @property
    def out(self) -> Path:
        """Folder of the published outputs, else of the latest attempt.

        Raises:
            RunError: If no attempt was begun yet.
        """
        out = self._newest_out()
        if out is None:
            raise RunError(f"Run '{self.id}' has no outputs yet: it is {self.state}.")
        return out

    def has(self, rel: str) -> bool:
        """Tell whether there is an output of that name."""
        out = self._newest_out()
        return out is not None and inside(out, rel).is_file()

    def array(self, rel: str, *, mmap: bool = True) -> ndarray:
        """Open an array; mapped ones are read-only.

        Raises:
            RunError: If it is missing or damaged.
        """
        path = self._existing(rel)
        try:
            return read_array(path, mmap=mmap)
        except (ValueError, OSError) as error:
            raise RunError(f"Run '{self.id}': {rel} is not a readable array: {error}.") from error

    def tensors(self, rel: str) -> dict[str, ndarray]:
        """Read named arrays.

        Raises:
            RunError: If the file is missing or damaged.
        """
        path = self._existing(rel)
        try:
            return read_tensors(path)
        except (SafetensorError, ValueError, OSError) as error:
            raise RunError(f"Run '{self.id}': {rel} is damaged: {error}. Run it again.") from error

    def yaml(self, rel: str) -> dict[str, Any]:
        """Read named fields from YAML.

        Raises:
            RunError: If the file is missing or damaged.
        """
        path = self._existing(rel)
        return checked(read_yaml(path), dict[str, Any], path)

    def recording(self, name: str) -> RecordingFile:
        """Read what a viewer needs of one of the run's recordings.

        Raises:
            RunError: If the file is missing or damaged.
        """
        path = self._existing(SequenceFiles(name).meta)
        return checked(read_yaml(path), RecordingFile, path)

    def json(self, rel: str) -> Any:
        """Read plain data from JSON."""
        return read_json(self._existing(rel))

    def holds(self, sequence: Sequence) -> bool:
        """Whether a recording is one that the run's results are about, by what was recorded.

        Another recording may have the same name. Runs of version 0.1 kept no fingerprint; there the
        recording must lie where the run found it.
        """
        if sequence.name not in self.sequence_names:
            return False
        meta = SequenceFiles(sequence.name).meta
        fingerprint = self.recording(sequence.name).get("fingerprint") if self.has(meta) else None
        if fingerprint is not None:
            return fingerprint == sequence.content_fingerprint()
        folder = Path(self.sequences[self.sequence_names.index(sequence.name)])
        return folder.resolve() == sequence.folder

    def verify(self, *, allows_more: bool = False) -> None:
        """Compare all published files with the hashes of their manifest.

        Args:
            allows_more: Whether files may lie among the results that the manifest does not know,
                such as a user's notes.

        Raises:
            RunError: If nothing is published, or a file is missing, changed or unknown; names it.
        """
        number = self._published()
        if number is None:
            if self.state == "succeeded":
                raise RunError(not_whole(self.id))
            raise RunError(
                f"Run '{self.id}' is {self.state}: there is nothing published to read yet."
            )
        folder = self.folder / ATTEMPTS / str(number)
        manifest = checked(read_json(folder / MANIFEST), ManifestFile, folder / MANIFEST)
        files: dict[str, Any] = dict(manifest["files"])
        damage = find_damage(folder / OUT, files)
        if damage is None and not allows_more:
            unknown = [rel for rel, _ in artefacts(folder / OUT) if rel not in files]
            damage = f"{unknown[0]} is not in {MANIFEST}" if unknown else None
        if damage is not None:
            raise RunError(
                f"Run '{self.id}': {damage}. Its results cannot be trusted; run it again."
            )

    @property
    def progress(self) -> dict[str, Any]:
        """The latest report: ``stage iteration total loss message eta_s time``; empty at first.

        Raises:
            RunError: If it is damaged.
        """
        return dict(read_record(self.folder / PROGRESS, EventLine) or {})

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

    def start_over(self) -> None:
        """Give up what attempts have computed, so that the next one begins with the first stage.

        What was published stays until the next attempt publishes.

        Raises:
            RunError: If a process works on the run.
        """
        with locked(self.folder):
            if live_holder(self.folder) is not None:
                raise RunError(f"Run '{self.id}' is running. Cancel it before you start it anew.")
            # The next attempt goes on from the latest one, so that one has to be empty.
            latest = self.attempt
            if latest is not None:
                (self.folder / ATTEMPTS / str(latest + 1) / OUT).mkdir(parents=True)
                prune(self.folder, keep={latest + 1})

    def forget_attempts(self) -> None:
        """Remove all attempts of an ended run but the one that has published its results.

        Raises:
            RunError: If a process works on the run.
        """
        with locked(self.folder):
            if live_holder(self.folder) is not None:
                raise RunError(f"Run '{self.id}' is running, so its attempts stay.")
            prune(self.folder, keep=set())

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

    def _newest_out(self) -> Path | None:
        number = self._published() or self.attempt
        return None if number is None else self.folder / ATTEMPTS / str(number) / OUT

    def _published(self) -> int | None:
        number = read_number(self.folder / CURRENT)
        is_whole = (self.folder / ATTEMPTS / str(number) / MANIFEST).is_file()
        return number if is_whole else None

    def _existing(self, rel: str) -> Path:
        path = inside(self.out, rel)
        if not path.is_file():
            raise RunError(f"Run '{self.id}' has no {rel}; it is {self.state}.")
        return path


def not_whole(run_id: str) -> str:
    """Say what is wrong with a run that has ended well, and has no results."""
    return (
        f"Run '{run_id}' has ended, but its results are not whole: '{CURRENT}' does not lead to an "
        f"attempt with a {MANIFEST}. Run it again."
    )


def _sequence_name(folder: Path) -> str:
    """Give a sequence's own name; where the folder cannot be read from here, the folder's."""
    return read_meta(folder).name if (folder / FILE).is_file() else folder.name


def _absolute(path: Path | str) -> Path:
    """Make a path absolute and drop ``..``; links stay as the user wrote them."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() would follow links
