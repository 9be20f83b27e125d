"""Rules about the tree that no linter knows."""

import ast
import gc
import re
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from itertools import chain
from pathlib import Path
from typing import TypeVar

import beartype
import jaxtyping
import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

Node = TypeVar("Node", bound=ast.AST)
ROOT = Path(__file__).parent.parent
PACKAGES = ("app", "physhandi")
SOURCE_FILES = sorted(
    path for part in (*PACKAGES, "web_assets") for path in (ROOT / part).rglob("*.py")
)
KERNEL_FILES = [
    ROOT / "physhandi/appearance/kernels.py",
    ROOT / "physhandi/rendering/kernels.py",
    *sorted((ROOT / "physhandi/simulation/kernels").glob("*.py")),
]
SHAPED = ("appearance", "data", "fitting", "hand", "metrics")
"""Packages of which pyproject.toml names the modules whose arrays are checked."""
READABLE = 20
"""Files of a folder that a person reads at a glance."""

LEAVES = ast.Name, ast.Constant, ast.alias
"""Half of all nodes; they consist of nothing but text, values, and whether they are read."""
ANYWHERE = {"logger", "main"}
"""Public names that mean the same in every module."""
VAGUE = {"found", "told", "kept", "known"}
"""Names that say what was done with a value, but not what it is."""
CLEARLY_NAMED = ("app", "physhandi")
"""Packages in which no value has a vague name."""


@pytest.fixture(scope="module", autouse=True)
def _look_for_no_garbage() -> Iterator[None]:
    """Trees stay: looking for garbage among them takes longer than parsing."""
    gc.disable()
    yield
    tree.cache_clear()
    by_kind.cache_clear()
    gc.enable()


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def by_kind(path: Path) -> dict[type[ast.AST], list[ast.AST]]:
    """Sort all nodes of a module by their kind, but not what says that one is read or written.

    Modules are walked once, since that takes as long as parsing them; a kind is asked for often.
    """
    found: list[ast.AST] = [tree(path)]
    kinds = defaultdict(list)
    for node in found:
        kinds[type(node)].append(node)
        if isinstance(node, LEAVES):
            continue
        for value in vars(node).values():
            if isinstance(value, list):
                found += [one for one in value if isinstance(one, ast.AST)]
            elif isinstance(value, ast.AST) and not isinstance(value, ast.expr_context):
                found.append(value)
    return kinds


def nodes_of(path: Path, *kinds: type[ast.AST]) -> Iterator[ast.AST]:
    return chain.from_iterable(by_kind(path).get(kind, ()) for kind in kinds)


def place(path: Path, node: ast.AST | None = None) -> str:
    line = f":{getattr(node, 'lineno', '')}" if node is not None else ""
    return f"{path.relative_to(ROOT)}{line}"


def nodes(files: Iterable[Path], kind: type[Node]) -> Iterator[tuple[Path, Node]]:
    for path in files:
        for node in nodes_of(path, kind):
            assert isinstance(node, kind)
            yield path, node


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in SOURCE_FILES}


def test_the_tree_is_seen_at_all() -> None:
    assert len(SOURCE_FILES) > 100
    assert len(KERNEL_FILES) > 5


def test_nothing_executes_foreign_bytes() -> None:
    forbidden = re.compile(
        r"pickle\.loads?\(|allow_pickle=True|weights_only=False|shell=True|\beval\("
    )
    lines = [
        f"{place(path)}:{number}: {line.strip()}"
        for path in SOURCE_FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if forbidden.search(line)
    ]
    assert lines == []


def test_at_most_twenty_types_are_ignored_and_each_says_why() -> None:
    lines = [
        f"{place(path)}:{number}: {line.strip()}"
        for path in SOURCE_FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(r"#\s*(type|pyrefly):\s*ignore|cast\(Any", line)
    ]
    assert len(lines) <= 20, "\n".join(lines)
    assert all(
        re.search(r"ignore\[[\w-]+(, ?[\w-]+)*\]\s+#\s*\w+|cast\(Any.*#", line) for line in lines
    ), lines


def test_kernels_import_only_warp_and_each_other() -> None:
    for path, node in nodes(KERNEL_FILES, ast.Import):
        assert [alias.name for alias in node.names] == ["warp"], place(path, node)
    for path, node in nodes(KERNEL_FILES, ast.ImportFrom):
        assert str(node.module).startswith("physhandi.simulation.kernels"), place(path, node)


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any(
        ast.unparse(decorator).startswith("wp.kernel") for decorator in function.decorator_list
    )


def test_kernels_write_only_to_outputs() -> None:
    kernels = [pair for pair in nodes(KERNEL_FILES, ast.FunctionDef) if _is_kernel(pair[1])]
    assert len(kernels) > 20
    for path, kernel in kernels:
        arguments = {argument.arg for argument in kernel.args.args}
        for node in ast.walk(kernel):
            targets = (
                node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            )
            for target in targets:
                if isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
                    name = target.value.id
                    assert name not in arguments or name.endswith("_out"), (
                        f"{place(path, node)}: {kernel.name} writes {name}"
                    )


def spoken(path: Path) -> Iterator[ast.AST]:
    """Where a module writes to standard output or standard error, whatever the way."""
    for node in nodes_of(path, ast.Call, ast.Attribute, ast.ImportFrom):
        match node:
            case ast.Call(func=ast.Name("print" | "input")):
                yield node
            case ast.Call(func=ast.Attribute(ast.Name("os"), "write"), args=[ast.Constant(), *_]):
                yield node
            case ast.Attribute(ast.Name("sys"), "stderr" | "stdout" | "__stderr__" | "__stdout__"):
                yield node
            case ast.Attribute(ast.Name("warnings"), "warn" | "warn_explicit"):
                yield node
            case ast.Attribute(ast.Name("logging"), "basicConfig" | "StreamHandler"):
                yield node
            case ast.Attribute(ast.Name("traceback"), name) if name.startswith("print_"):
                yield node
            case ast.ImportFrom(module="sys" | "warnings" | "traceback"):
                yield node


def test_only_the_command_line_and_printed_progress_speak() -> None:
    allowed = {
        "physhandi/progress.py": 1,  # What `progress=True` asks for.
        "physhandi/devices.py": 2,  # Passes on what a driver wrote before it failed.
        "app/logs.py": 2,  # The server's log.
        "app/jobs/worker.py": 1,  # The log of a fit, which its process writes.
        "app/viewer/live/worker.py": 1,  # The same of live simulations.
    }
    counts = {place(path): sum(1 for _ in spoken(path)) for path in SOURCE_FILES}
    speaking = {file: count for file, count in counts.items() if count}
    of_commands = {file for file in speaking if file.startswith("app/cli/")}
    assert sum(speaking.pop(file) for file in of_commands) > 10
    assert speaking == allowed


def test_every_configuration_field_is_documented() -> None:
    undocumented = []
    classes = [
        (path, node)
        for path in SOURCE_FILES
        for node in tree(path).body
        if isinstance(node, ast.ClassDef) and node.name.endswith(("Config", "Parameters"))
    ]
    assert len(classes) > 10
    for path, node in classes:
        for field, following in zip(node.body, [*node.body[1:], None], strict=True):
            documented = isinstance(following, ast.Expr) and isinstance(
                following.value, ast.Constant
            )
            if isinstance(field, ast.AnnAssign) and not documented:
                undocumented.append(f"{place(path, field)}: {ast.unparse(field.target)}")
    assert undocumented == []


def test_a_folder_is_read_at_a_glance() -> None:
    for folder in sorted({path.parent for path in SOURCE_FILES}):
        count = sum(path.name != "__init__.py" for path in folder.glob("*.py"))
        assert count <= READABLE, f"{place(folder)} holds {count} files: name its parts and move"


def imported_modules(path: Path) -> set[str]:
    """Modules of ours that a file imports anywhere, also inside functions and for types alone.

    What a package's `__init__` imports inside functions is left out: these are doors to what
    stands above, opened for whoever calls them.
    """
    is_door = path.name == "__init__.py"
    top = tree(path).body if is_door else nodes_of(path, ast.Import, ast.ImportFrom)
    found: set[str] = set()
    for node in top:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = (f"{node.module}.{alias.name}" for alias in node.names)
            found.update(name if name in MODULES else str(node.module) for name in names)
    return (found & set(MODULES)) - {module_name(path)}


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules in which each reaches every other."""
    reached = {name: set(others) for name, others in imports.items()}
    is_growing = True
    while is_growing:
        is_growing = False
        for name, others in reached.items():
            more = others.union(*(reached[other] for other in others))
            is_growing |= more != others
            reached[name] = more
    groups = {
        tuple(sorted(other for other in reached[name] if name in reached[other]))
        for name in reached
        if name in reached[name]
    }
    return sorted(map(list, groups))


def test_circles_of_imports_are_recognised() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    imports = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"f", "a"}, "f": {"e"}}
    assert circles(imports) == [["a", "b", "c"], ["e", "f"]]


def test_no_modules_import_each_other_in_a_circle() -> None:
    imports = {name: imported_modules(path) for name, path in MODULES.items()}
    assert sum(map(len, imports.values())) > 500
    assert circles(imports) == []


def public_names(path: Path) -> set[str]:
    """What a module defines at its top without an underscore."""
    found: set[str] = set()
    for node in tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found.update(target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.add(node.target.id)
    return {name for name in found if not name.startswith("_")}


def test_a_public_name_has_one_meaning() -> None:
    places = defaultdict(list)
    for module, path in MODULES.items():
        names = public_names(path)
        if module.startswith("app.cli."):
            # A command is named after what it calls.
            names -= {node.name for node in tree(path).body if isinstance(node, ast.FunctionDef)}
        for name in names - ANYWHERE:
            places[name].append(module)
    assert len(places) > 1000
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def named_values(path: Path) -> Iterator[tuple[ast.AST, str]]:
    """Variables, parameters and attributes, each where it gets a value or is declared."""
    kinds = ast.arg, ast.Name, ast.Attribute, ast.ExceptHandler, ast.MatchAs, ast.MatchStar
    for node in nodes_of(path, *kinds):
        match node:
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()):
                yield node, name
            case ast.Attribute(attr=name, ctx=ast.Store()):
                yield node, name
            case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)):
                yield node, name
            case ast.MatchStar(name=str(name)):
                yield node, name


def test_a_value_is_named_after_what_it_is() -> None:
    files = [path for path in SOURCE_FILES if place(path).split("/")[0] in CLEARLY_NAMED]
    values = [(path, node, name) for path in files for node, name in named_values(path)]
    assert len(values) > 30_000
    assert [place(path, node) for path, node, name in values if name in VAGUE] == []


def test_vendored_and_bundled_data_stay_small() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "sequences"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    files = listed.stdout.split() or [
        str(p) for p in (ROOT / "sequences").rglob("*") if p.is_file()
    ]
    assert 0 < sum((ROOT / name).stat().st_size for name in files) <= 6_800_000


def test_shapes_that_a_module_tells_are_checked_while_tests_run(pytestconfig) -> None:
    checked = pytestconfig.getoption("jaxtyping_packages").split(",")
    for path in SOURCE_FILES:
        place = path.relative_to(ROOT).with_suffix("")
        names = [".".join(place.parts[:count]) for count in range(1, len(place.parts) + 1)]
        asks = place.parts[:2] in {("physhandi", part) for part in SHAPED}
        if asks and "from jaxtyping import" in path.read_text():
            assert set(names) & set(checked), f"name {names[-1]} in pyproject.toml"


def test_shapes_are_checked_in_the_first_calls_of_a_function() -> None:
    @jaxtyping.jaxtyped(typechecker=beartype.beartype)
    def first(point: jaxtyping.Float[np.ndarray, "point 3"]) -> float:
        return float(point[0, 0])

    wrong = np.ones((2, 4))
    with pytest.raises(jaxtyping.TypeCheckError, match="point"):
        first(wrong)
    for _ in range(1_000):
        assert first(wrong[:, :3]) == 1.0
    assert first(wrong) == 1.0  # Checking all calls of a fit takes longer than the fit.


def _needed(requirement: Requirement, found: dict[str, set[str]]) -> None:
    """Add an installed package and all that it needs, with the extras that are asked of each."""
    name = canonicalize_name(requirement.name)
    if name in found and requirement.extras <= found[name]:
        return
    found.setdefault(name, set()).update(requirement.extras)
    for need in map(Requirement, distribution(name).requires or ()):
        marker = need.marker
        if marker is None or any(marker.evaluate({"extra": e}) for e in ("", *found[name])):
            _needed(need, found)


def test_constraints_name_what_is_installed_beside_torch() -> None:
    """`make install` installs these lines at once; what is missing there would come late."""
    extras = re.search(r"^EXTRAS := (\[.+?\])$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert extras is not None
    ours: dict[str, set[str]] = {}
    torch: dict[str, set[str]] = {}
    try:
        _needed(Requirement(f"physhandi{extras[1]}"), ours)
        _needed(Requirement("torch"), torch)
    except PackageNotFoundError as error:
        pytest.skip(f"needs all that `make install` installs: {error}")
    assert len(ours) > 100
    text = (ROOT / "constraints.txt").read_text()
    part = text.partition("# What else")[2].partition("# Other")[0].splitlines()[1:]
    named = {canonicalize_name(Requirement(line).name) for line in part}
    assert named == ours.keys() - torch.keys() - {"physhandi"}
