"""The server's log: for people, or a JSON object a line, and never a secret."""

import json
import logging
import re
from datetime import UTC, datetime

from app.settings import ServerSettings

_SECRET = re.compile(r"(?i)(token=|bearer\s+|physhandi_\d+=)[^\s&\"'<>]+")
_PLAIN = "%(levelname)s %(name)s: %(message)s"


class _SafeFormatter(logging.Formatter):
    """Leaves out what would let a reader of the log in."""

    def format(self, record: logging.LogRecord) -> str:
        return _SECRET.sub(r"\1…", super().format(record))


class _JsonFormatter(_SafeFormatter):
    """Writes ``time level logger message`` and, of an error, ``error``."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _SECRET.sub(r"\1…", record.getMessage()),
        }
        if record.exc_info:
            line["error"] = _SECRET.sub(r"\1…", self.formatException(record.exc_info))
        return json.dumps(line, ensure_ascii=False)


def write_logs(settings: ServerSettings) -> None:
    """Have everything logged as the settings say, in the place of what was set up before."""
    handler = logging.StreamHandler()
    as_json = settings.log_format == "json"
    handler.setFormatter(_JsonFormatter() if as_json else _SafeFormatter(_PLAIN))
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
