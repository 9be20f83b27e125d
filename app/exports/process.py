"""The child process that makes one file: ``python -m app.exports.process PARENT FILE``.

It reads its order from standard input and writes one JSON object a line to standard output:
``{"done": 3, "of": 60}`` and, if it cannot go on, ``{"error": "…", "kind": "UsageError"}``.
"""

import json
import os
import sys
from pathlib import Path
from typing import TextIO

from app.child_modules import die_with_parent
from physhandi.errors import PhysHandiError, describe

_NICENESS = 5


def main(arguments: list[str], orders: TextIO, answers: TextIO) -> int:
    """Make the file; returns the exit code."""
    parent, out = int(arguments[0]), Path(arguments[1])
    die_with_parent(parent)
    os.nice(_NICENESS)  # Live scenes go first.
    from app.exports.making import make
    from app.exports.order import Order

    def tell(**about: object) -> None:
        answers.write(json.dumps(about) + "\n")
        answers.flush()

    try:
        order = Order.from_text(orders.read())
        make(order, out, lambda done, of: tell(done=done, of=of))
    except (PhysHandiError, OSError, MemoryError) as error:
        tell(error=describe(error), kind=type(error).__name__)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], sys.stdin, sys.stdout))
