"""The `physhandi` command: parses, calls, prints; the only module that prints."""

import json
import logging
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import tyro

from app.cli import commands, doctor, speed
from app.cli.arguments import (
    Benchmark,
    Command,
    Evaluate,
    EvaluateHands,
    EvaluateSuite,
    Export,
    Import,
    Reconstruct,
    Serve,
    Simulate,
    Synthesize,
)
from app.cli.suite import evaluate_suite
from physhandi.errors import PhysHandiError, UsageError, describe
from physhandi.progress import Progress, watched

Result = TypeVar("Result")


def _watched(work: Callable[[Progress], Result]) -> Result:
    with watched(True) as progress:
        return work(progress)


def _show(result: Any, *, as_json: bool = False) -> None:
    if as_json:
        print(json.dumps(commands.as_json_data(result), indent=2, ensure_ascii=False))
        return
    for line in commands.lines(result):
        print(line)


_WATCHED: dict[type, Callable[[Any, Progress], dict[str, Any]]] = {
    Reconstruct: commands.reconstruct,
    Simulate: commands.simulate,
    Synthesize: commands.make_sequence,
}


def _dispatch(command: Any) -> int:
    match command:
        case Serve():
            commands.serve(command, on_ready=lambda url: print(url, flush=True))
        case Reconstruct() | Simulate() | Synthesize():
            work = _WATCHED[type(command)]
            _show(_watched(lambda progress: work(command, progress)))
        case Evaluate(what=EvaluateHands() as what):
            _show(commands.evaluate_hands(what), as_json=what.json)
        case Evaluate(what=EvaluateSuite() as what):
            found = _watched(lambda progress: evaluate_suite(what, progress))
            _show(found, as_json=what.json)
        case Evaluate(what=what):
            _show(commands.evaluate_run(what), as_json=what.json)
        case Import(source=source):
            _show(_watched(lambda progress: commands.import_foreign(source, progress)))
        case Export():
            print(commands.export(command))
        case Benchmark(what=what):
            _show(speed.measure(what), as_json=what.json)
        case _:
            healthy, lines = doctor.examine(command.data_dir)
            print("\n".join(lines))
            return 0 if healthy else 1
    return 0


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed with one clear line, 2 bad usage."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    command = tyro.cli(Command, prog="physhandi", args=argv, config=(tyro.conf.OmitArgPrefixes,))  # type: ignore[call-overload]  # tyro types a union of subcommands loosely
    try:
        code = _dispatch(command)
    except UsageError as error:
        print(f"physhandi: {error}", file=sys.stderr)
        code = 2
    except (PhysHandiError, OSError) as error:
        print(f"physhandi: {describe(error)}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("physhandi: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)
