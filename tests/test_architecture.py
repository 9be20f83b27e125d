"""Rules about the tree that no linter knows."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PYTHON_FILES = sorted(
    path
    for part in ("app", "physhandi", "tests", "web_assets")
    for path in (ROOT / part).rglob("*.py")
)
SOURCE_FILES = [path for path in PYTHON_FILES if "tests" not in path.relative_to(ROOT).parts]


def test_the_tree_is_seen_at_all() -> None:
    assert len(SOURCE_FILES) > 30


@pytest.mark.parametrize("path", PYTHON_FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_file_is_longer_than_400_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400, (
        "name the second concept in it and split there"
    )


@pytest.mark.parametrize("path", SOURCE_FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_cli_prints(path: Path) -> None:
    calls = [
        node.lineno
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]
    assert path.relative_to(ROOT) == Path("app/cli.py") or not calls


@pytest.mark.parametrize("path", SOURCE_FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_nothing_executes_foreign_bytes(path: Path) -> None:
    text = path.read_text()
    for pattern in (
        r"pickle\.loads?\(",
        r"allow_pickle=True",
        r"weights_only=False",
        r"shell=True",
        r"\beval\(",
    ):
        assert not re.search(pattern, text), pattern


def test_at_most_twenty_types_are_ignored_and_each_says_why() -> None:
    lines = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in SOURCE_FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(r"#\s*(type|pyright):\s*ignore|cast\(Any", line)
    ]
    assert len(lines) <= 20, "\n".join(lines)
    assert all(
        re.search(r"ignore\[[\w-]+(, ?[\w-]+)*\]\s+#\s*\w+|cast\(Any.*#", line) for line in lines
    ), lines


@pytest.mark.parametrize(
    "path", sorted((ROOT / "physhandi/simulation/kernels").glob("*.py")), ids=lambda p: p.name
)
def test_kernels_import_only_warp_and_each_other(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert [alias.name for alias in node.names] == ["warp"]
        elif isinstance(node, ast.ImportFrom):
            assert str(node.module).startswith("physhandi.simulation.kernels")


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any(
        ast.unparse(decorator).startswith("wp.kernel") for decorator in function.decorator_list
    )


@pytest.mark.parametrize(
    "path", sorted((ROOT / "physhandi/simulation/kernels").glob("*.py")), ids=lambda p: p.name
)
def test_kernels_write_only_to_outputs(path: Path) -> None:
    for kernel in ast.walk(ast.parse(path.read_text())):
        if not isinstance(kernel, ast.FunctionDef) or not _is_kernel(kernel):
            continue
        arguments = {argument.arg for argument in kernel.args.args}
        for node in ast.walk(kernel):
            targets = (
                node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            )
            for target in targets:
                if isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
                    name = target.value.id
                    assert name not in arguments or name.endswith("_out"), (
                        f"{kernel.name} writes {name}"
                    )


def test_every_configuration_field_is_documented() -> None:
    undocumented = []
    for path in SOURCE_FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not (
                isinstance(node, ast.ClassDef) and node.name.endswith(("Config", "Parameters"))
            ):
                continue
            for field, following in zip(node.body, [*node.body[1:], None], strict=True):
                documented = isinstance(following, ast.Expr) and isinstance(
                    following.value, ast.Constant
                )
                if isinstance(field, ast.AnnAssign) and not documented:
                    undocumented.append(f"{node.name}.{ast.unparse(field.target)}")
    assert undocumented == []


def test_vendored_and_bundled_data_stay_small() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "sequences"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    files = listed.stdout.split() or [
        str(p) for p in (ROOT / "sequences").rglob("*") if p.is_file()
    ]
    assert 0 < sum((ROOT / name).stat().st_size for name in files) <= 5_000_000
