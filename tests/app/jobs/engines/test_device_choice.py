"""Where fits run on a machine with several graphics cards, which are made up here."""

from pathlib import Path

from app.jobs.engines.device_choice import DeviceChoice
from app.jobs.machine import Cards
from app.settings import ServerSettings

UUIDS = {"cuda:0": "GPU-b", "cuda:1": "GPU-a", "cuda:2": "GPU-c"}
"""CUDA counts these cards in another order than the driver's tool does."""


def choice_of(tmp_path: Path, free_mib: dict[str, int], *, device: str) -> DeviceChoice:
    table = "".join(
        f"{number}, NVIDIA H200, 0, {1000 - free_mib[uuid]}, 1000, 40, {uuid}\n"
        for number, uuid in enumerate(sorted(free_mib))
    )
    cards = Cards(lambda arguments: table if "query-gpu" in arguments[0] else "")
    cards.refresh()
    settings = ServerSettings(data_dir=tmp_path, device=device, fit_memory_gib=0.5)
    return DeviceChoice(settings, cards, card_of=lambda name: UUIDS[name])


def test_a_fit_goes_where_fewest_are_and_then_where_most_memory_is_free(tmp_path: Path) -> None:
    free = {"GPU-a": 800, "GPU-b": 700, "GPU-c": 600}
    choice = choice_of(tmp_path, free, device="cuda:0,cuda:1,cuda:2")
    assert choice.choose([]) == "cuda:1"
    assert choice.choose(["cuda:1"]) == "cuda:0"
    assert choice.choose(["cuda:1", "cuda:0"]) == "cuda:2"
    assert choice.choose(["cuda:2", "cuda:1", "cuda:0", "cuda:1"]) == "cuda:0"


def test_a_card_without_enough_free_memory_gets_no_fit_and_the_reason_is_told(
    tmp_path: Path,
) -> None:
    free = {"GPU-a": 511, "GPU-b": 513}
    choice = choice_of(tmp_path, free, device="cuda:0,cuda:1")
    assert choice.choose(["cuda:0", "cuda:0"]) == "cuda:0"
    short = choice_of(tmp_path, {"GPU-a": 102, "GPU-b": 205}, device="cuda:0,cuda:1")
    assert short.choose([]) is None
    assert short.shortage == (
        "Waits for memory of a GPU: cuda:0 has 0.2 GiB, cuda:1 has 0.1 GiB free, and a fit is "
        "started with 0.5 GiB."
    )


def test_of_cards_of_which_nothing_is_known_the_first_is_taken(tmp_path: Path) -> None:
    choice = choice_of(tmp_path, {}, device="cuda:0, cuda:1")
    assert [choice.choose(busy) for busy in ([], ["cuda:0"])] == ["cuda:0", "cuda:1"]
    assert choice_of(tmp_path, {}, device="cpu").choose(["cpu"]) == "cpu"


def test_nobody_asks_for_cards_before_a_fit_is_placed(tmp_path: Path) -> None:
    asked: list[str] = []
    settings = ServerSettings(data_dir=tmp_path, device="auto")  # As `doctor` reads it.
    choice = DeviceChoice(settings, Cards(lambda _: ""), card_of=asked.append)
    assert asked == []
    assert choice.choose([]) == "auto"
    choice.card("auto")
    assert asked == ["auto"]


def test_one_fit_runs_on_each_device_unless_it_is_said_otherwise(tmp_path: Path) -> None:
    two = ServerSettings(data_dir=tmp_path, device="cuda:0, cuda:1")
    assert (two.devices, two.live_device, two.slots) == (("cuda:0", "cuda:1"), "cuda:0", 2)
    assert two.model_copy(update={"parallel_fits": 6}).slots == 6
    assert ServerSettings(data_dir=tmp_path).slots == 1
