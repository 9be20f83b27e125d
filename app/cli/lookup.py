"""Finding what a command names: settings, sequences and runs."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from app.jobs.catalog import Catalog, UnknownRunError, UnknownSequenceError
from app.settings import ServerSettings
from app.wrong_fields import wrong_fields
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError, UsageError
from physhandi.run import Run


def read_settings(**given: Any) -> ServerSettings:
    """Read the settings; where an argument is None, the environment speaks, then the default.

    Raises:
        UsageError: If a value is out of range; names it.
    """
    try:
        return ServerSettings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        where, why = wrong_fields(error.errors())[0]
        raise UsageError(f"{where or 'settings'}: {why}.") from None


def cluster_settings(settings: ServerSettings, device: str) -> ServerSettings:
    """Choose what is asked of a cluster by the ``--device`` of a command.

    Raises:
        UsageError: If a cluster cannot be asked for that.
    """
    gpus = {"auto": settings.cluster_gpus, "cpu": 0, "cuda": 1}.get(device)
    if gpus is None:
        raise UsageError(f"--device {device} makes no sense on a cluster; take auto, cpu or cuda.")
    return settings.model_copy(update={"cluster_gpus": gpus})


def open_catalog(data_dir: Path | None) -> Catalog:
    """Find sequences and runs in a data folder and among the bundled ones."""
    return Catalog(read_settings(data_dir=data_dir))


def folder_of_sequence(name: str, data_dir: Path | None) -> Path:
    """Find the folder of a sequence by folder or by name, whether or not it can be opened.

    Raises:
        UsageError: If there is no such sequence.
    """
    if (Path(name) / "sequence.yaml").is_file():
        return Path(name)
    catalog = open_catalog(data_dir)
    try:
        return catalog.sequence_item(name).folder
    except UnknownSequenceError:  # Only now all are opened, of which there may be many.
        names = [entry.id for entry in catalog.sequences()]
        raise UsageError(
            f"'{name}' is neither a folder with a sequence.yaml nor a known sequence. "
            f"Known are: {', '.join(names) or 'none'}."
        ) from None


def find_sequence(name: str, data_dir: Path | None) -> Sequence:
    """Open a sequence by folder or by name.

    Raises:
        UsageError: If there is no such sequence.
        SequenceError: If it breaks the format.
    """
    return Sequence.load(folder_of_sequence(name, data_dir))


def find_run(name: str, data_dir: Path | None) -> Run:
    """Open a run by folder or by id.

    Raises:
        RunError: If there is no such run.
    """
    if (Path(name) / "run.yaml").is_file():
        return Run.open(Path(name))
    catalog = open_catalog(data_dir)
    try:
        return catalog.run(name)
    except UnknownRunError:  # As above.
        ids = [entry.id for entry in catalog.runs()]
        raise RunError(
            f"'{name}' is neither a run folder nor a known run. "
            f"Known are: {', '.join(ids) or 'none'}."
        ) from None


def find_result(name: str, data_dir: Path | None) -> Run:
    """Open a finished run whose files are all as they were published.

    Raises:
        RunError: If there is no such run, it is not finished, or a file is missing or changed.
    """
    run = find_run(name, data_dir)
    run.verify(allows_more=True)
    return run


def sequence_of(run: Run, name: str | None) -> str:
    """Choose a sequence of a run; its first one if none is named.

    Raises:
        UsageError: If the run has no such sequence.
    """
    if name is None:
        return run.sequence_names[0]
    if name not in run.sequence_names:
        raise UsageError(
            f"Run '{run.id}' has no sequence '{name}', but {', '.join(run.sequence_names)}."
        )
    return name
