"""Settings of the server: from the command line, or from PHYSHANDI_* variables."""

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """What one server is told before it starts."""

    model_config = SettingsConfigDict(env_prefix="PHYSHANDI_", frozen=True, extra="forbid")

    data_dir: Path = Path("data")
    """Folder with `sequences/` and `runs/`."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = Field(default=8080, ge=0, le=65535)
    """Port to listen on; 0 takes a free one."""
    device: str = "cpu"
    """Warp device of fits and of the live simulation."""
    live_sessions: int = Field(default=10, ge=1, le=100)
    """Most live scenes at a time."""
    live_idle_s: float = Field(default=900.0, gt=0)
    """Seconds after which a live scene that nobody looks at is closed."""
    parallel_fits: int = Field(default=1, ge=1, le=64)
    """Fits that run side by side; others wait."""
    cancel_grace_s: float = Field(default=10.0, gt=0)
    """Seconds that a cancelled fit has to stop by itself before it is killed."""

    @property
    def sequence_dir(self) -> Path:
        """Where imported sequences lie."""
        return self.data_dir / "sequences"

    @property
    def run_dir(self) -> Path:
        """Where runs are written."""
        return self.data_dir / "runs"
