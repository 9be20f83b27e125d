"""Plain data as typed objects."""

import subprocess
import sys
from typing import Annotated

import msgspec
import pytest
from msgspec import Meta

from physhandi.typed import decode_json, to_typed

AT_ONCE = """
import dataclasses, sys, threading, typing
import msgspec
from physhandi.typed import decode_json, to_typed

sys.setswitchinterval(1e-6)
NUMBER = typing.Annotated[float, msgspec.Meta(ge=0)]
NAMES = [f"field_{number}" for number in range(20)]
MAKERS = {
    "Struct": lambda name: msgspec.defstruct(name, [(field, NUMBER) for field in NAMES]),
    "dataclass": lambda name: dataclasses.make_dataclass(name, [(f, NUMBER) for f in NAMES]),
    "TypedDict": lambda name: typing.TypedDict(name, dict.fromkeys(NAMES, NUMBER)),
}
content = dict.fromkeys(NAMES, 1.0)
text = msgspec.json.encode(content)
read = []
for number in range(60):
    kind = MAKERS[sys.argv[1]](f"Kind{number}")
    begin = threading.Barrier(8)

    def go(by_text):
        begin.wait()
        read.append(decode_json(text, kind) if by_text else to_typed(content, kind))

    threads = [threading.Thread(target=go, args=(n % 2,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
print(sum(len(msgspec.to_builtins(item)) for item in read))
"""


@pytest.mark.parametrize("kind", ["Struct", "dataclass", "TypedDict"])
def test_threads_read_into_a_new_class_at_once(kind: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", AT_ONCE, kind], capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.returncode) == (f"{60 * 8 * 20}\n", 0), done.stderr


class Chair(msgspec.Struct, forbid_unknown_fields=True):
    legs: Annotated[int, Meta(ge=3)]


def test_what_is_wrong_is_told_as_msgspec_tells_it() -> None:
    assert to_typed({"legs": 4}, Chair).legs == decode_json(b'{"legs": 4}', Chair).legs == 4
    with pytest.raises(msgspec.ValidationError, match=r"`int` >= 3 - at `\$.legs`"):
        to_typed({"legs": 2}, Chair)
    with pytest.raises(msgspec.ValidationError, match="missing required field `legs`"):
        decode_json("{}", Chair)
    with pytest.raises(msgspec.DecodeError, match="malformed"):
        decode_json(b"{legs", Chair)
