"""Settings of the server, from arguments or ``PHYSHANDI_*`` environment variables."""

import ipaddress
import os
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from physhandi.child import PACKAGE_ROOT

BUNDLED = PACKAGE_ROOT / "sequences"
WEB_ASSETS = PACKAGE_ROOT / "web_assets"


def is_loopback(host: str) -> bool:
    """Tell whether an address can only be reached from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def is_private(host: str) -> bool:
    """Tell whether an IP address can only be reached from this machine or its own network."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_private
    except ValueError:
        return False


LOCAL = "local"
"""The engine that runs fits on this machine."""
OWN_PATHS = frozenset(
    {"api", "assets", "compare", "diff", "healthz", "import", "launch", "live", "metrics", "readyz"}
    | {"recovery", "runs", "sequences", "shared", "suites", "system", "viewer"}
)
"""With what the addresses of the application begin."""
_ROOT_PATH = re.compile(r"(/(?!\.{1,2}(?:/|$))[A-Za-z0-9._~-]+)*")
_CLUSTER = re.compile(r"ray://([A-Za-z0-9.-]+|\[[0-9A-Fa-f:]+\]):([0-9]{1,5})")


class ServerSettings(BaseSettings):
    """Settings of a server; every default is safe on one machine."""

    model_config = SettingsConfigDict(env_prefix="PHYSHANDI_", extra="forbid", frozen=True)

    data_dir: Path = Path("data")
    """Folder with ``sequences/`` and ``runs/``; made when missing."""
    captures: Annotated[tuple[Path, ...], NoDecode] = ()
    """Folders, besides ``captures/`` of the data folder, from which browsers may import
    recordings (separated by colons, as in PATH)."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = Field(default=8080, ge=0, le=65535)
    """Port to listen on; 0 takes a free one."""
    root_path: str = ""
    """Path below which a reverse proxy serves the application, such as ``/physhandi``."""
    device: str = "cpu"
    """Warp devices of fits, separated by commas; the first one also runs the live simulation."""
    auth: bool = True
    """Whether requests need the token; only a loopback server may go without."""
    token: SecretStr | None = Field(default=None, min_length=16)
    """Token to use instead of a new random one at each start."""
    token_file: Path | None = None
    """File that keeps the token over restarts; made, for its owner alone, when missing."""
    read_only_token_file: Path | None = None
    """File with another token, with which everything can be looked at and nothing changed; made
    alike when missing."""
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = ()
    """Further host names that browsers may use, as behind a reverse proxy (comma separated)."""
    parallel_fits: int | None = Field(default=None, ge=1, le=64)
    """Fits that run side by side, each with its share of threads; others wait. None for one each
    device."""
    fit_memory_gib: float = Field(default=2.0, ge=0, le=1024)
    """Least free memory of a GPU for a fit to be started on it [GiB]."""
    engine: str = LOCAL
    """Where fits run: local, or ray://HOST:PORT, the address of the Jobs API of a Ray cluster."""
    engine_token: SecretStr | None = Field(default=None, min_length=16)
    """Token of the cluster, without which its Jobs API lets everybody execute what they like."""
    cluster_python: str = Field(default="python", pattern=r"^[^\x00-\x1f]+$")
    """Python on the nodes of the cluster in whose environment PhysHanDI is installed."""
    cluster_cpus: int = Field(default=1, ge=1, le=1024)
    """Processors that a fit asks of the cluster, which are its threads, too."""
    cluster_gpus: int = Field(default=0, ge=0, le=1)
    """GPUs that a fit asks of the cluster; without one it runs on the CPU."""
    cluster_memory_gib: float = Field(default=0.0, ge=0, le=65_536)
    """Memory that a fit asks of the cluster [GiB]; 0 asks for none in particular."""
    store: str = Field(default="", pattern=r"^[^\x00-\x1f]*$")
    """Address, as fsspec understands it, of a store where results are published, too."""
    waiting_fits: int = Field(default=100, ge=1, le=10_000)
    """Fits that may wait in line."""
    waiting_fits_each: int | None = Field(default=None, ge=1, le=10_000)
    """Most of them that one client, a browser or all scripts together, may have; None for all."""
    running_fits_each: int | None = Field(default=None, ge=1, le=1024)
    """Fits of one client that run at a time; further ones let others pass. None for all."""
    data_gib: float | None = Field(default=None, gt=0, le=1_000_000)
    """Size of the data folder above which nothing new is begun in it [GiB]; None for any."""
    keep_free_gib: float = Field(default=1.0, ge=0, le=100_000)
    """Free space of its disk below which nothing new is begun in it [GiB]."""
    upload_gib: float = Field(default=20.0, gt=0, le=10_000)
    """Size of an upload at most, unpacked [GiB]; 5 % of the disk stay free in any case."""
    keep_attempts_days: float | None = Field(default=None, ge=0, le=100_000)
    """Days after its end for which a run keeps attempts that have not published its results; None
    for ever. A failed fit that has none begins afresh when it is resumed."""
    keep_logs_days: float | None = Field(default=None, ge=0, le=100_000)
    """Days after its end for which a run keeps its log; None for ever."""
    keep_cache_days: float | None = Field(default=None, ge=0, le=100_000)
    """Days without use for which small pictures and exports are kept; None for ever."""
    cache_gib: float | None = Field(default=None, ge=0, le=100_000)
    """Size of both above which the oldest go [GiB]; None for any."""
    keep_uploads_days: float | None = Field(default=7.0, ge=0, le=100_000)
    """Days after its last piece for which an unfinished upload is kept; None for ever."""
    cancel_grace_s: float = Field(default=8.0, gt=0, le=600)
    """Time that a cancelled fit has to stop by itself before it is killed [s]."""
    hung_after_s: float = Field(default=120.0, ge=0.1, le=86_400)
    """Time without a sign of life after which an idle fit is ended and started once more [s]; one
    that computes has 20 times as long."""
    log_level: Literal["debug", "info", "warning", "error"] = "warning"
    """What is logged: at ``info`` also every request, and what the queue does."""
    log_format: Literal["text", "json"] = "text"
    """Lines of the log: for people, or a JSON object each."""
    live_sessions: int = Field(default=20, ge=1, le=100)
    """Most live scenes at a time."""
    live_sessions_each: int = Field(default=10, ge=1, le=100)
    """Most of them that one browser, or all scripts together, may have."""
    live_idle_s: float = Field(default=900.0, gt=0)
    """Seconds after which a live scene that nobody looks at is closed."""

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Read arguments and variables, not also a file that nobody may name."""
        del settings_cls, dotenv_settings, file_secret_settings
        return init_settings, env_settings

    @field_validator("data_dir")
    @classmethod
    def _absolute(cls, value: Path) -> Path:
        folder = value.expanduser().resolve()
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file; name a folder, which is made when missing")
        return folder

    @field_validator("captures", mode="before")
    @classmethod
    def _split_paths(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(part for part in value.split(os.pathsep) if part)
        return value

    @field_validator("captures")
    @classmethod
    def _are_folders(cls, value: tuple[Path, ...]) -> tuple[Path, ...]:
        folders = tuple(path.expanduser().resolve() for path in value)
        for folder in folders:
            if not folder.is_dir():
                raise ValueError(f"{folder} is not a folder; name folders that hold recordings")
        return folders

    @field_validator("allowed_hosts", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(part.strip().lower() for part in value.split(",") if part.strip())
        return value

    @field_validator("root_path")
    @classmethod
    def _is_root_path(cls, value: str) -> str:
        path = value.rstrip("/")
        if _ROOT_PATH.fullmatch(path) is None:
            raise ValueError(
                f"{value!r} is no path below which it could be served; give one such as /physhandi "
                "(letters, digits, and . _ ~ - within its parts)"
            )
        if (first := path[1:].partition("/")[0]) in OWN_PATHS:
            raise ValueError(
                f"{value!r} cannot be told from the application's own addresses, which begin with "
                f"/{first}, too; choose another path"
            )
        return path

    @field_validator("engine")
    @classmethod
    def _is_engine(cls, value: str) -> str:
        match = _CLUSTER.fullmatch(value)
        if value != LOCAL and (match is None or not 0 < int(match[2]) < 65_536):
            raise ValueError(
                f"{value!r} is no engine; give local, or ray://HOST:PORT with the address of a "
                "cluster's Jobs API"
            )
        # A name may stand for another address by then, so it is looked at when it is called.
        host = "localhost" if match is None else match[1]
        is_name = host[-1].isalpha()
        if not is_name and not is_private(host):
            raise ValueError(
                f"{host} is no address of a private network, so the cluster's token would cross "
                "the internet in plain text. Lay a tunnel and name its near end"
            )
        return value

    @model_validator(mode="after")
    def _protect_cluster(self) -> "ServerSettings":
        if self.engine != LOCAL and self.engine_token is None:
            raise ValueError(
                f"{self.engine} needs a token (PHYSHANDI_ENGINE_TOKEN): without one everybody who "
                "reaches the cluster may execute programs on it. Start Ray with "
                "RAY_AUTH_MODE=token, and give its token here"
            )
        return self

    @model_validator(mode="after")
    def _protect(self) -> "ServerSettings":
        if self.token and self.token_file:
            raise ValueError("token and token_file are both set; leave one out")
        if self.read_only_token_file and not self.auth:
            raise ValueError("read_only_token_file protects nothing while auth is switched off")
        if not self.auth and not is_loopback(self.host):
            raise ValueError(
                f"auth cannot be switched off on {self.host}, which other machines can reach. "
                "Listen on 127.0.0.1 or keep the token."
            )
        return self

    @property
    def devices(self) -> tuple[str, ...]:
        """Warp devices of fits."""
        return tuple(name.strip() for name in self.device.split(","))

    @property
    def live_device(self) -> str:
        """Warp device of the live simulation."""
        return self.devices[0]

    @property
    def slots(self) -> int:
        """Number of fits that run side by side."""
        return self.parallel_fits or len(self.devices)

    @property
    def run_dir(self) -> Path:
        """Folder of runs."""
        return self.data_dir / "runs"

    @property
    def sequence_dir(self) -> Path:
        """Folder of imported sequences."""
        return self.data_dir / "sequences"

    @property
    def capture_dir(self) -> Path:
        """Folder of raw recordings that wait to be imported."""
        return self.data_dir / "captures"

    @property
    def model_dir(self) -> Path:
        """Folder of networks that users have; whoever may write to it decides what is executed."""
        return self.data_dir / "models"

    @property
    def suite_dir(self) -> Path:
        """Folder of suites; the runs of their cells are found by id, but not listed."""
        return self.data_dir / "suites"

    @property
    def damaged_dir(self) -> Path:
        """Folder of what could not be read and was moved out of the way, by kind."""
        return self.data_dir / "damaged"

    @property
    def audit_dir(self) -> Path:
        """Folder of the log of who changed what."""
        return self.data_dir / "audit"

    @property
    def launches_path(self) -> Path:
        """File that says which run was launched by which key of a client."""
        return self.data_dir / "launches.json"

    @property
    def index_path(self) -> Path:
        """File of the index of runs; made again when it is deleted."""
        return self.data_dir / "cache" / "runs.json"

    @property
    def preview_dir(self) -> Path:
        """Folder of previews; made again when they are deleted."""
        return self.data_dir / "cache" / "previews"
