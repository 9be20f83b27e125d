"""The process that unpacks an upload, looks at what it is, and puts it in place: all or nothing."""

import shutil
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

from app.jobs.recordings.ordered import work_on_order
from app.jobs.recordings.upload_names import MOST_FILES, check_names, is_left_out, quoted_name
from physhandi.data.files import sync_folder, write_yaml
from physhandi.data.importers.bag import BAG_SUFFIXES
from physhandi.data.run_folder import (
    ATTEMPTS,
    CURRENT,
    EVENTS,
    EXIT,
    JOB,
    LOG,
    MANIFEST,
    OUT,
    PROGRESS,
    RUN,
    SAFE_ID,
    STAGES_FILE,
    JobFile,
    checked,
    read_yaml,
)
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE
from physhandi.data.untrusted.pickles import limit_data
from physhandi.errors import UsageError
from physhandi.progress import Progress
from physhandi.run import Run

_MOST_MEMORY = 6 << 30
_STEP = 1 << 20
_MOST_RATIO = 100
"""Unpacked bytes of an archive for each of its own, on average."""
_LONGEST_LIST = 400 * MOST_FILES
"""Size of an archive's list of entries at most: names are short, see `upload_names` [bytes]."""
_END, _END_64, _FAR = b"PK\x05\x06", b"PK\x06\x06", 0xFFFFFFFF
_KINDS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_OF_RUNS = {JOB, RUN, CURRENT, EVENTS, EXIT, LOG, PROGRESS, ATTEMPTS}
"""Unpacked files of a run; a ticket of another server's queue, say, would start it here."""
_OF_ATTEMPTS = {OUT, MANIFEST, STAGES_FILE}


def unpack(archive: Path, folder: Path, most_bytes: int, progress: Progress) -> None:
    """Unpack a zip archive.

    Args:
        archive: The archive, of which nothing is believed.
        folder: Where to; made here.
        most_bytes: Size of its files at most [bytes].
        progress: Told how far it is; may ask to stop.

    Raises:
        UsageError: If it is damaged, or holds what no recording, sequence or run has: links, names
            that lead elsewhere, or far more than it seems; says what.
    """
    _check_list(archive)
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [one for one in opened.infolist() if not is_left_out(one.filename)]
            _check_entries(archive, entries, most_bytes)
            files = [one for one in entries if not one.is_dir()]
            folder.mkdir()
            for number, one in enumerate(files):
                progress.check_cancelled()
                progress.report("unpack", number, len(files), message=one.filename)
                _unpack_one(opened, one, folder / one.filename)
    except (zipfile.BadZipFile, EOFError, RuntimeError, zlib.error, struct.error) as error:
        raise UsageError(f"The archive is damaged: {error}. Pack it anew.") from None


def _check_list(archive: Path) -> None:
    """Refuse a list of entries that is too long to be read, which `zipfile` would read whole."""
    with archive.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 2**16 - 100))
        tail = stream.read()
        at = tail.rfind(_END)
        if at < 0 or len(tail) < at + 22:
            raise UsageError("It is no whole zip archive. Pack it anew, or send its files.")
        length = struct.unpack_from("<I", tail, at + 12)[0]
        far = tail.rfind(_END_64)
        if length == _FAR:
            length = struct.unpack_from("<Q", tail, far + 40)[0] if far >= 0 else _LONGEST_LIST + 1
    if length > _LONGEST_LIST:
        raise UsageError(f"The archive has more than {MOST_FILES:,} files; leave some out.")


def _check_entries(archive: Path, entries: list[zipfile.ZipInfo], most_bytes: int) -> None:
    for one in entries:
        kind = stat.S_IFMT(one.external_attr >> 16)
        if kind not in {0, stat.S_IFREG, stat.S_IFDIR}:
            raise UsageError(f"{quoted_name(one.filename)} is a link or a device, not a file.")
        if one.flag_bits & 1:
            raise UsageError(
                f"{quoted_name(one.filename)} is encrypted. Pack it without a password."
            )
        if one.compress_type not in _KINDS:
            raise UsageError(f"{quoted_name(one.filename)} is packed in a rare way. Use plain zip.")
    check_names(one.filename.rstrip("/") for one in entries)
    total = sum(one.file_size for one in entries)
    if total > most_bytes:
        raise UsageError(
            f"Unpacked it has {total / 2**30:.1f} GiB, more than the {most_bytes / 2**30:.1f} GiB "
            "that there is room for."
        )
    if total > _MOST_RATIO * max(archive.stat().st_size, _STEP):
        raise UsageError(f"Unpacked it is more than {_MOST_RATIO} times as large. Send its files.")


def _unpack_one(opened: zipfile.ZipFile, one: zipfile.ZipInfo, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    left = one.file_size
    with opened.open(one) as packed, path.open("xb") as out:
        while piece := packed.read(_STEP):
            left -= len(piece)
            if left < 0:  # Its size is what the limits were held against.
                raise UsageError(f"{quoted_name(one.filename)} is larger than the archive says.")
            out.write(piece)


def settle(folder: Path, name: str, places: dict[str, Path], progress: Progress) -> dict[str, str]:
    """Look what a folder holds, check all of it, and put it in place.

    Args:
        folder: The files.
        name: What it is to be called.
        places: Folders of ``captures``, ``sequences`` and ``runs``.
        progress: Told how far it is; may ask to stop.

    Returns:
        ``kind`` (captures, sequences or runs) and ``name`` (its folder there, and for a single bag
        its file in that folder).

    Raises:
        PhysHandiError: If something is wrong with it; then nothing is in place.
    """
    while len(inner := list(folder.iterdir())) == 1 and inner[0].is_dir():
        folder = inner[0]  # Archives often hold one folder with everything.
    if not inner:
        raise UsageError("It holds no files.")
    if (folder / FILE).is_file():
        kind = "sequences"
        checks = list(Sequence.load(folder).checks())
        for number, check in enumerate(checks):
            progress.check_cancelled()
            progress.report("check", number, len(checks))
            check()
    elif (folder / JOB).is_file():
        kind = "runs"
        _strip(folder)
        _settle_places(folder / JOB, places)
        Run.open(folder).verify()
    else:
        kind = "captures"
    target = places[kind] / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        raise UsageError(f"There is a '{name}' in {kind} already. Send it with another name.")
    folder.rename(target)
    sync_folder(target.parent)
    bags = [path for path in target.iterdir() if path.suffix.lower() in BAG_SUFFIXES]
    is_bag = kind == "captures" and len(inner) == len(bags) == 1
    return {"kind": kind, "name": f"{name}/{bags[0].name}" if is_bag else name}


def _strip(run: Path) -> None:
    """Remove of a run what is not results: tickets of a queue, leases, checkpoints."""
    attempts = run / ATTEMPTS
    within = [path for one in attempts.glob("*") for path in one.glob("*")]
    unknown = [path for path in within if path.name not in _OF_ATTEMPTS]
    unknown += [path for path in run.iterdir() if path.name not in _OF_RUNS]
    for path in unknown:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def _settle_places(job: Path, places: dict[str, Path]) -> None:
    """Look for a run's recordings where this server has its own, not where another one had them.

    Else a run that is sent could show what lies anywhere on this machine.
    """
    content = checked(read_yaml(job), JobFile, job)
    content["sequences"] = [str(places["sequences"] / _last(path)) for path in content["sequences"]]
    if "source" in content["config"]:
        content["config"]["source"] = str(places["runs"] / _last(content["config"]["source"]))
    write_yaml(job, content)


def _last(path: object) -> str:
    name = str(path).replace("\\", "/").rstrip("/").rpartition("/")[2]
    if not SAFE_ID.fullmatch(name):
        raise UsageError(f"{JOB}: {quoted_name(str(path))} is no place of a sequence or run.")
    return name


def settle_upload(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Do what the order says; see `app.jobs.recordings.uploads`."""
    limit_data(_MOST_MEMORY)
    folder = Path(order["folder"])
    files, unpacked = folder / "files", folder / "unpacked"
    if unpacked.exists():
        shutil.rmtree(unpacked)  # Of a try that was stopped.
    sent = [path for path in files.rglob("*") if path.is_file()]
    if len(sent) == 1 and sent[0].suffix.lower() == ".zip":
        unpack(sent[0], unpacked, order["most_bytes"], progress)
    else:
        files.rename(unpacked)
    places = {kind: Path(path) for kind, path in order["places"].items()}
    try:
        settled = settle(unpacked, order["name"], places, progress)
    except BaseException:
        if unpacked.exists() and not files.exists():
            unpacked.rename(files)  # It can be tried again, with another name, say.
        raise
    shutil.rmtree(folder)
    return settled


if __name__ == "__main__":
    work_on_order(settle_upload)
