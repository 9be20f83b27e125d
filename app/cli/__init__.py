"""The `physhandi` command: functions become subcommands, and every failure is one clear line."""

import logging
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

from physhandi.child import end_without_collecting, loading_modules
from physhandi.errors import PhysHandiError, UsageError, describe

if TYPE_CHECKING:
    from tyro.constructors import (
        ConstructorRegistry,
        PrimitiveConstructorSpec,
        PrimitiveTypeInfo,
        UnsupportedTypeAnnotationError,
    )
    from tyro.extras import SubcommandApp


def build() -> "SubcommandApp":
    """Make the tree of commands; their docstrings and types are the help text."""
    # Here, because processes of suites start in this package and need none of the commands.
    with loading_modules():
        from tyro.extras import SubcommandApp

        from app.cli import benchmark, data_folder, recordings, runs, serving
        from app.cli.suite import evaluate_suite

    imports = SubcommandApp()
    imports.command(name="capture")(recordings.import_capture)
    imports.command(name="stereo")(recordings.import_stereo)
    imports.command(name="mocap")(recordings.import_mocap)
    imports.command(name="phystwin")(recordings.import_phystwin)
    imports.command(name="mano")(recordings.import_mano)
    imports.command(name="hands")(recordings.import_hands)
    imports.command(name="run")(runs.import_run)
    evaluate = SubcommandApp()
    evaluate.command(name="run")(runs.evaluate_run)
    evaluate.command(name="hands")(runs.evaluate_hands)
    evaluate.command(name="suite")(evaluate_suite)
    benchmarks = SubcommandApp()
    for measure in (
        benchmark.rollout,
        benchmark.gradient,
        benchmark.batch,
        benchmark.scaling,
        benchmark.splats,
        benchmark.capture,
        benchmark.substeps,
        benchmark.live,
        benchmark.viewer,
    ):
        benchmarks.command(measure)
    app = SubcommandApp()
    app.command(serving.serve)
    app.command(runs.reconstruct)
    app.command(runs.simulate)
    app.command(evaluate, name="evaluate", help="Measure results.")
    app.command(recordings.synthesize)
    app.command(
        imports,
        name="import",
        help="Turn a recording, a result or a hand model of another format into ours.",
    )
    app.command(runs.export)
    app.command(runs.gallery)
    app.command(recordings.check)
    app.command(recordings.annotate)
    app.command(recordings.shape)
    app.command(benchmarks, name="benchmark", help="Measure speed; see docs/benchmarks.")
    app.command(serving.doctor)
    app.command(data_folder.reindex)
    return app


def as_shown() -> "ConstructorRegistry":
    """Show options that may be left out as ``PATH`` and ``(default: none)``.

    Tyro's ``{None}|PATH`` tells that None can be typed, too, which it still can.
    """
    from tyro.conf import DisallowNone
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

    registry = ConstructorRegistry()

    @registry.primitive_rule
    def without_none(
        kind: "PrimitiveTypeInfo",
    ) -> "PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None":
        if type(None) not in get_args(kind.type) or DisallowNone in kind.markers:
            return None
        inner = replace(kind, markers={*kind.markers, DisallowNone})
        spec = ConstructorRegistry.get_primitive_spec(inner)
        if not isinstance(spec, PrimitiveConstructorSpec):
            return spec
        return replace(
            spec,
            instance_from_str=lambda words: (
                None if words == ["None"] else spec.instance_from_str(words)
            ),
            str_from_instance=lambda value: (
                ["none"] if value is None else spec.str_from_instance(value)
            ),
        )

    return registry


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed with one clear line, 2 bad usage."""
    from tyro.conf import OmitArgPrefixes

    end_without_collecting()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        code = (
            build().cli(prog="physhandi", args=argv, config=(OmitArgPrefixes,), registry=as_shown())
            or 0
        )
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
