import shlex
import sys

from support.random_pauses import Pauses

from app.viewer.ui.plot import rounded_up


def test_only_functions_of_the_application_are_held_up() -> None:
    pauses: list[float] = []
    before = sys.getprofile()
    sys.setprofile(Pauses(1.0, 0.25, pauses.append))
    try:
        shlex.split("a b")
        elsewhere = len(pauses)
        end = rounded_up(0.055)
    finally:
        sys.setprofile(before)
    assert elsewhere == 0
    assert len(pauses) >= 2
    assert all(0.0 <= pause < 0.25 for pause in pauses)
    assert end == 0.1
    never = Pauses(0.0, 0.25, pauses.append)
    count = len(pauses)
    never(sys._getframe(), "call", None)
    assert len(pauses) == count
