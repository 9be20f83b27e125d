"""On which device a fit is started: the one with the fewest fits, and with most free memory."""

from collections.abc import Callable, Sequence

from app.jobs.machine import Cards
from app.settings import ServerSettings
from physhandi.devices import card_of

_GIBIBYTE = 2**30


class DeviceChoice:
    """Chooses among the devices of a server; GPUs on which too little memory is free are left out.

    A GPU whose memory the driver does not tell counts as free.
    """

    def __init__(
        self,
        settings: ServerSettings,
        cards: Cards,
        *,
        card_of: Callable[[str], str | None] = card_of,
    ) -> None:
        """Prepare.

        Args:
            settings: Name the devices, and the free memory that a GPU must have for a further fit.
            cards: Knows how much memory is free.
            card_of: Tells the graphics card of a device; see `physhandi.devices.card_of`.
        """
        self._devices = settings.devices
        self._least = settings.fit_memory_gib * _GIBIBYTE
        self._cards = cards
        self._card_of = card_of
        self._card_by_device: dict[str, str | None] = {}

    def choose(self, busy: Sequence[str]) -> str | None:
        """Choose the device of the next fit.

        Args:
            busy: Devices of the fits at work, one for each of them.

        Returns:
            The device; None if no GPU has enough free memory.
        """
        fit = [device for device in self._devices if not self._is_short(device)]
        if not fit:
            return None
        # The first of equals: of two devices of which nothing is known the preferred one.
        return min(fit, key=lambda device: (busy.count(device), -(self._free(device) or 0.0)))

    def card(self, device: str) -> str | None:
        """Tell the graphics card of one of the devices; None for a CPU."""
        # Asked when a fit is placed: who only looks at a data folder starts no Warp.
        if device not in self._card_by_device:
            self._card_by_device[device] = None if device == "cpu" else self._card_of(device)
        return self._card_by_device[device]

    @property
    def shortage(self) -> str:
        """Why no device can be chosen, as a sentence."""
        memory = ", ".join(
            f"{device} has {(self._free(device) or 0.0) / _GIBIBYTE:.1f} GiB"
            for device in self._devices
        )
        return (
            f"Waits for memory of a GPU: {memory} free, and a fit is started with "
            f"{self._least / _GIBIBYTE:g} GiB."
        )

    def _free(self, device: str) -> float | None:
        card = self.card(device)
        return None if card is None else self._cards.free_memory(card)

    def _is_short(self, device: str) -> bool:
        free = self._free(device)
        return free is not None and free < self._least
