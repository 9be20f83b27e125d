"""A process in the place of the one that decodes, which fails at files by what their names say."""

import os
import time
from pathlib import Path
from typing import Any

from physhandi.child import run_child
from physhandi.data.untrusted import media


def decode(request: dict[str, Any], videos: Any) -> Any:
    name = Path(request["path"]).stem
    if name == "crash" or (name == "second" and request.get("index") == 1):
        os.abort()
    if name == "later" and videos._open.get(request["path"], (None, 0))[1] > 0:
        os.abort()
    if name == "once" and not Path(f"{request['path']}.tried").exists():
        Path(f"{request['path']}.tried").touch()
        os.abort()
    if name == "hang":
        time.sleep(300)
    if name == "greedy":
        bytearray(8 << 30)
    return ORIGINAL(request, videos)


ORIGINAL = media.decode

if __name__ == "__main__":
    media.decode = decode
    run_child(media.answer_requests)
