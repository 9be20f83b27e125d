"""Decodes images and videos of others in a child process with limits of memory and time.

What decodes them is native code, which a damaged or hostile file can crash, hang, or let fill the
memory. Here that ends the child, and the import says which file did it.
"""

import atexit
import math
import mmap
import os
import tempfile
import threading
from functools import cache
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy import ndarray

from physhandi.child import AnsweringChild, Channel, ChildEndedError, run_child
from physhandi.data.untrusted.exr import decode_exr
from physhandi.data.untrusted.image_header import MOST_PIXELS
from physhandi.data.untrusted.pickles import limit
from physhandi.errors import ImportFailedError

_WORKER = "physhandi.data.untrusted.media"
_MEMORY = 3 << 30
"""Most address space of the process, that of its libraries included [byte]."""
_ROOM = 8 * MOST_PIXELS
"""Size of what both processes share, in which images are handed over [byte]."""
_LONGEST_S = 30.0
"""Time that one image may take [s]."""
_MOST_PASSED = 200
"""Frames of a video that are passed over in one go, for which there is as much time [frame]."""
_LONGEST_CPU_S = 24 * 3600
_NO_MEMORY = -4
"""What OpenCV calls a lack of memory (``StsNoMem``)."""
_CRASHED = "crashed what decodes it"
_OPEN = 8
"""Videos that are kept open."""


class MediaDecoder:
    """A process that decodes what it is asked for; a new one is started when it has ended."""

    def __init__(
        self, *, worker: str = _WORKER, memory: int = _MEMORY, longest_s: float = _LONGEST_S
    ) -> None:
        """Prepare; the process starts with the first question.

        Args:
            worker: Module of the process.
            memory: Most address space that it may take [byte].
            longest_s: Most time for one question [s].
        """
        self._worker, self._memory, self._longest_s = worker, memory, longest_s
        self._lock = threading.Lock()
        self._child: AnsweringChild | None = None
        self._shared: Any = None
        self._area: mmap.mmap | None = None

    def image(self, path: Path, flags: int) -> ndarray | None:
        """Decode an image as ``cv2.imread`` does; None if it cannot be decoded.

        Raises:
            ImportFailedError: If decoding it needs too much memory or time, or crashes.
        """
        return self._ask(str(path), do="image", path=str(path.absolute()), flags=flags)[1]

    def exr(self, path: Path, channels: list[str]) -> ndarray | None:
        """Decode channels of an OpenEXR image, side by side; None if they cannot be decoded.

        Raises:
            ImportFailedError: See `image`.
        """
        return self._ask(str(path), do="exr", path=str(path.absolute()), channels=channels)[1]

    def probe(self, path: Path) -> tuple[int, int, int, float]:
        """Ask for a video's frame count (0 if there is no video), width, height [px], rate [Hz].

        Raises:
            ImportFailedError: See `image`.
        """
        answer = self._ask(str(path), do="probe", path=str(path.absolute()))[0]["video"]
        return int(answer[0]), int(answer[1]), int(answer[2]), float(answer[3])

    def frame(self, path: Path, index: int) -> tuple[ndarray | None, int]:
        """Decode a frame of a video (BGR), best in their order.

        Returns:
            The image, or None if it cannot be decoded; and the number of the frame, or of the
            first one that cannot.

        Raises:
            ImportFailedError: See `image`.
        """
        place = f"{path}, frame {index}"
        reached, restarts = -1, 0
        while True:
            answer, image = self._ask(place, do="frame", path=str(path.absolute()), index=index)
            if not answer.get("is_on_the_way"):
                return image, int(answer["at"])
            # A frame on the way that crashes it has a new process begin at frame 0.
            restarts += int(answer["at"]) <= reached
            reached = int(answer["at"])
            if restarts > 1:
                raise _refusal(place, _CRASHED)

    def release(self, path: Path) -> None:
        """Close a video."""
        with self._lock:
            if self._child is not None:
                self._child.tell({"do": "release", "path": str(path.absolute())})

    def close(self) -> None:
        """End the process, and give back what it shared."""
        with self._lock:
            if self._child is not None:
                self._child.close()
            if self._area is not None:
                self._area.close()
                self._shared.close()
            self._child = self._area = self._shared = None

    def _start(self) -> AnsweringChild:
        self._shared = _memory()
        self._area = mmap.mmap(self._shared.fileno(), _ROOM)
        descriptor = self._shared.fileno()
        return AnsweringChild(
            self._worker, str(descriptor), str(self._memory), threads=1, pass_fds=[descriptor]
        )

    def _ask(self, place: str, **request: object) -> tuple[dict[str, Any], ndarray | None]:
        with self._lock:
            if self._child is None:
                self._child = self._start()
            try:
                answer = self._child.ask(request, self._longest_s)
            except ChildEndedError as end:
                late = f"decoding it took more than {self._longest_s:g} s"
                raise _refusal(place, late if end.is_late else _CRASHED) from None
            if answer.get("is_too_large"):
                raise ImportFailedError(
                    f"{place}: decoding it needs more memory than is allowed "
                    f"({self._memory >> 20} MiB). It is damaged or made to do harm."
                )
            return answer, self._received(answer)

    def _received(self, answer: dict[str, Any]) -> ndarray | None:
        if "shape" not in answer:
            return None
        shape = tuple(int(length) for length in answer["shape"])
        kind: Any = np.dtype(str(answer["dtype"]))
        count = math.prod(shape)
        return np.frombuffer(cast("Any", self._area), kind, count).reshape(shape).copy()


def _refusal(place: str, deed: str) -> ImportFailedError:
    return ImportFailedError(
        f"{place}: {deed}. It is damaged or made to do harm; record or export it again."
    )


def _memory() -> Any:
    """Make memory that a child can share: a file that lies nowhere."""
    if hasattr(os, "memfd_create"):
        made = os.fdopen(os.memfd_create("physhandi"), "r+b")
    else:
        made = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as its decoder
    made.truncate(_ROOM)
    return made


@cache
def media_decoder() -> MediaDecoder:
    """Give the decoder that all importers of this process share, so that it starts only once."""
    decoder = MediaDecoder()
    atexit.register(decoder.close)
    return decoder


class _Videos:
    """The videos that are open, and which frame each gives next."""

    def __init__(self) -> None:
        self._open: dict[str, tuple[Any, int]] = {}

    def frame(self, path: str, index: int) -> tuple[dict[str, Any], ndarray | None]:
        """Decode a frame; tells how far that went, and whether it has to be asked for again."""
        capture, at = self._open.pop(path, (None, 0))
        if capture is None or index < at:
            capture, at = cv2.VideoCapture(path), 0
        stop = min(index, at + _MOST_PASSED)
        while at < stop and capture.grab():
            at += 1
        is_on_the_way = at == stop < index
        is_read, image = capture.read() if at == index else (False, None)
        self._open[path] = capture, at + is_read
        while len(self._open) > _OPEN:
            self.release(next(iter(self._open)))
        return {"at": at, "is_on_the_way": is_on_the_way}, image if is_read else None

    def release(self, path: str) -> None:
        """Close a video."""
        capture, _ = self._open.pop(path, (None, 0))
        if capture is not None:
            capture.release()


def _probed(path: str) -> list[float]:
    capture = cv2.VideoCapture(path)
    try:
        return [
            *(
                max(0, round(capture.get(number)))
                for number in (
                    cv2.CAP_PROP_FRAME_COUNT,
                    cv2.CAP_PROP_FRAME_WIDTH,
                    cv2.CAP_PROP_FRAME_HEIGHT,
                )
            ),
            float(capture.get(cv2.CAP_PROP_FPS)),
        ]
    finally:
        capture.release()


def decode(request: dict[str, Any], videos: _Videos) -> tuple[dict[str, Any], ndarray | None]:
    """Do what a request asks for, in the child."""
    if request["do"] == "probe":
        return {"video": _probed(request["path"])}, None
    if request["do"] == "frame":
        return videos.frame(request["path"], request["index"])
    if request["do"] == "exr":
        return {}, decode_exr(request["path"], request["channels"])
    return {}, cast("ndarray | None", cv2.imread(request["path"], request["flags"]))


def answer_requests(channel: Channel) -> None:
    """Answer requests until there are no more."""
    descriptor, memory = int(channel.arguments[0]), int(channel.arguments[1])
    area = mmap.mmap(descriptor, _ROOM)
    limit(_LONGEST_CPU_S, memory)
    videos = _Videos()
    for request in channel.requests():
        if request["do"] == "release":
            videos.release(request["path"])
            continue
        try:
            answer, image = decode(request, videos)
        except MemoryError:
            answer, image = {"is_too_large": True}, None
        except cv2.error as error:
            answer, image = {"is_too_large": error.code == _NO_MEMORY, "at": 0}, None
        if image is not None:
            if image.nbytes > _ROOM:
                channel.tell(is_too_large=True)
                continue
            np.frombuffer(area, image.dtype, image.size)[:] = image.ravel()
            answer |= {"shape": image.shape, "dtype": image.dtype.str}
        channel.tell(**answer)


if __name__ == "__main__":
    run_child(answer_requests)
