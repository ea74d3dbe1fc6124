"""Packages import each other in one direction, and the core needs no extra: read from the imports themselves."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# Each package imports only from rows above its own and, without cycles, from its own
ROWS = (
    ("validation", "replaced", "gym_notice", "locked_file", "masked_evaluation"),
    ("churn",),
    ("tasks", "envs", "networks"),
    ("callbacks", "tensorboard", "checkpoint"),
    ("algorithms", "analysis", "methods"),
    ("sb3_cchain",),  # the package itself: the public names
    ("zoo", "benchmarks"),
)
LEVEL = {package: level for level, row in enumerate(ROWS) for package in row}
# Packages that only an extra installs, and the modules that may import them when they are imported themselves
EXTRAS = {
    *("matplotlib", "seaborn", "pandas", "rliable", "scipy"),
    *("rl_zoo3", "sb3_contrib", "huggingface_sb3", "optuna", "requests", "yaml", "ray", "river"),
    *("procgen", "gym3", "gym", "minatar", "minigrid", "ale_py", "cv2", "shimmy", "dm_control", "dm_env", "mujoco", "Box2D"),
    *("torchvision", "sklearn"),
}
MODULES_OF_EXTRAS = ("sb3_cchain.zoo", "sb3_cchain.algorithms.contrib", "benchmarks")


@cache
def modules() -> dict[str, Path]:
    """All modules of the package and of the benchmarks, by name; a package under its own name."""
    found = {}
    for folder in ("sb3_cchain", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported_names(statement: ast.Import | ast.ImportFrom) -> list[str]:
    if isinstance(statement, ast.Import):
        return [alias.name for alias in statement.names]
    assert statement.level == 0, "Write absolute imports"
    # `from package import module` imports the module
    return [
        name if (name := f"{statement.module}.{alias.name}") in modules() else statement.module for alias in statement.names
    ]


@cache
def imports(module: str) -> frozenset[str]:
    """Everything that a module imports, inside functions and for types too."""
    tree = ast.parse(modules()[module].read_text())
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    return frozenset(name for statement in statements for name in imported_names(statement))


def statements_run_at_import(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Without the bodies of functions, and of ``if TYPE_CHECKING``."""
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.unparse(statement.test):
            yield from statements_run_at_import(statement.orelse)
            continue
        yield statement
        for field in ("body", "orelse", "finalbody", "handlers"):
            for child in getattr(statement, field, []):
                yield from statements_run_at_import(child.body if isinstance(child, ast.ExceptHandler) else [child])


def package_of(module: str) -> str:
    """The row's name of a module of ours."""
    parts = module.split(".")
    return parts[1] if parts[0] == "sb3_cchain" and len(parts) > 1 else parts[0]


def is_ours(module: str) -> bool:
    return module.split(".")[0] in ("sb3_cchain", "benchmarks")


def find_cycle(graph: dict[str, set[str]]) -> list[str]:
    """:return: The nodes of a cycle, in its order; empty when there is none"""
    done: set[str] = set()

    def search(node: str, path: list[str]) -> list[str]:
        if node in path:
            return path[path.index(node) :]
        if node in done:
            return []
        for child in sorted(graph.get(node, ())):
            if cycle := search(child, [*path, node]):
                return cycle
        done.add(node)
        return []

    for node in sorted(graph):
        if cycle := search(node, []):
            return cycle
    return []


def test_a_cycle_is_found():
    assert find_cycle({"a": {"b"}, "b": {"c", "d"}, "d": {"b"}}) == ["b", "d"]
    assert find_cycle({"a": {"b", "c"}, "b": {"c"}}) == []


def test_every_package_has_its_row():
    assert {package_of(module) for module in modules()} <= set(LEVEL)


@pytest.mark.parametrize("module", sorted(modules()))
def test_imports_only_from_the_rows_above(module):
    package = package_of(module)
    for imported in filter(is_ours, imports(module)):
        other = package_of(imported)
        assert other == package or LEVEL[other] <= LEVEL[package], f"{module} imports {imported}"


def test_the_first_row_imports_none_of_ours():
    for module in modules():
        if package_of(module) in ROWS[0]:
            assert not any(map(is_ours, imports(module))), module


def test_no_cycles_between_packages():
    graph: dict[str, set[str]] = {}
    for module in modules():
        package = package_of(module)
        graph.setdefault(package, set()).update({package_of(name) for name in filter(is_ours, imports(module))} - {package})
    assert find_cycle(graph) == []


def test_no_cycles_between_modules():
    assert find_cycle({module: set(filter(is_ours, imports(module))) for module in modules()}) == []


def test_churn_needs_torch_alone():
    roots = {name.split(".")[0] for module in modules() if package_of(module) == "churn" for name in imports(module)}
    assert roots.isdisjoint({"stable_baselines3", "gymnasium", "tensorboard", "rich"}) and "torch" in roots


@pytest.mark.parametrize("module", sorted(module for module in modules() if not module.startswith(MODULES_OF_EXTRAS)))
def test_importing_the_core_needs_no_extra(module):
    tree = ast.parse(modules()[module].read_text())
    run = [node for node in statements_run_at_import(tree.body) if isinstance(node, ast.Import | ast.ImportFrom)]
    needed = {name.split(".")[0] for statement in run for name in imported_names(statement)} & EXTRAS
    assert not needed, f"Import {', '.join(sorted(needed))} where it is used, inside the function"


def test_packages_and_modules_say_what_they_are_for():
    for module, path in modules().items():
        assert ast.get_docstring(ast.parse(path.read_text())), f"{module} has no docstring"
        assert not module.rsplit(".", 1)[-1].strip("_").startswith(("utils", "helpers", "common")), module
