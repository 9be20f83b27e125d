"""Which simulations are held, and how many frames those may still go on, one step at a time."""

from app.viewer.wire import Message

PAUSE, RESUME, STEP = "pause", "resume", "step"
CONTROLS = frozenset({PAUSE, RESUME, STEP})
"""Messages that change the pace of a simulation and leave what is simulated alone."""


class Holds:
    """The pace of every session's simulation.

    A held one computes its first frame, the state it starts from, and then one frame a step.
    """

    def __init__(self) -> None:
        self._steps: dict[str, int] = {}
        self._frames: dict[str, int] = {}

    def start(self, session: str, *, is_held: bool) -> None:
        """A session's simulation begins anew; steps that were left over are forgotten."""
        self._frames[session] = 0
        if is_held:
            self._steps[session] = 0
        else:
            self._steps.pop(session, None)

    def hear(self, message: Message) -> None:
        """Take in a message of `CONTROLS`."""
        session = message["session"]
        if message.kind == RESUME:
            self._steps.pop(session, None)
        elif message.kind == STEP:
            self._steps[session] = self._steps.get(session, 0) + 1
        else:
            self._steps[session] = 0

    def may_go_on(self, session: str) -> bool:
        """Tell whether a session's next frame may be computed."""
        return self._steps.get(session, 1) > 0 or self._frames.get(session, 0) == 0

    def count(self, session: str, frames: int) -> None:
        """Count the frames that a session's simulation has computed since it began."""
        before = self._frames.get(session, 0)
        self._frames[session] = frames
        if session in self._steps and before > 0:
            self._steps[session] = max(self._steps[session] - (frames - before), 0)

    def forget(self, session: str) -> None:
        """Forget a session that was closed."""
        self._steps.pop(session, None)
        self._frames.pop(session, None)
