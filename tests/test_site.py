"""The site of the documentation: its table of contents, its reference, and that what it quotes is what the code says."""

import ast
import importlib
import re
import runpy
from collections import Counter
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks.readme import documentation_tables, read_cells, readme_table
from benchmarks.report.places import PLACE
from tests.test_docs import ALL_PAGES, ROOT, name_of, without_code

DOCS = ROOT / "docs"
CONTENTS = runpy.run_path(str(DOCS / "conf.py"))
PUBLIC = (
    "sb3_cchain",
    *(f"sb3_cchain.{room}" for room in ("algorithms", "algorithms.contrib", "analysis", "callbacks", "checkpoint", "churn")),
    *(f"sb3_cchain.{room}" for room in ("envs", "methods", "networks", "tasks", "tensorboard")),
)
DIRECTIVE = re.compile(r"^\.\. auto(class|function|module):: (\S+)\n(?:   :members: ?(.*))?", flags=re.MULTILINE)

# GitHub shows directives as they are typed, so they are on pages of their own
WITH_DIRECTIVES = {"contributing", "changelog"}


def pages() -> list[str]:
    return [str(path.relative_to(DOCS).with_suffix("")) for path in DOCS.rglob("*.md") if "_build" not in path.parts]


def get(name: str) -> object:
    module, attribute = name.rsplit(".", 1)
    return getattr(importlib.import_module(module), attribute)


def members(module: ModuleType) -> list[str]:
    if hasattr(module, "__all__"):
        return list(module.__all__)
    return [name for name, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__]


def documented() -> Counter[int]:
    """How often the site shows each object, by its id."""
    found: Counter[int] = Counter()
    for page in pages():
        for kind, name, given in DIRECTIVE.findall((DOCS / f"{page}.md").read_text()):
            if kind == "module":
                module = importlib.import_module(name)
                listed = re.split(r",\s*", given) if given else members(module)
                found.update(id(getattr(module, each)) for each in listed)
            else:
                found[id(get(name))] += 1
    return found


def test_the_reference_has_every_public_name_once():
    names: dict[int, str] = {}
    for package in PUBLIC:
        module = importlib.import_module(package)
        names.update({id(getattr(module, name)): f"{package}.{name}" for name in module.__all__ if name not in names})
    counts = documented()
    assert not {name: counts[key] for key, name in names.items() if counts[key] != 1}, "not once on the site"


def test_every_page_is_in_the_contents_once():
    listed = [CONTENTS["page_of"](entry) for entries in CONTENTS["CONTENTS"].values() for entry in entries]
    assert len(set(listed)) == len(listed)
    found_by_itself = {page for page in pages() if page.startswith("modules/")} | {"index"}
    assert set(pages()) - set(listed) <= found_by_itself, "add it to CONTENTS in docs/conf.py"
    assert set(listed) - set(pages()) <= CONTENTS["OPTIONAL"]


def test_only_the_reference_has_directives():
    with_directives = {page for page in pages() if re.search(r"^ *(```|:::+)\{", (DOCS / f"{page}.md").read_text(), re.M)}
    assert {page for page in with_directives if not page.startswith("reference/")} <= WITH_DIRECTIVES


@pytest.mark.parametrize("page", ALL_PAGES, ids=name_of)
def test_pictures_are_there_and_described(page):
    for description, target in re.findall(r"!\[([^\]]*)\]\(([^)]*)\)", without_code(page)):
        assert len(description) >= 10, target
        assert (page.parent / target).is_file(), target


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) < 120


def tables(page: Path) -> dict[str, str]:
    return {place[1]: place[0] for place in PLACE.finditer(page.read_text())}


def test_the_readme_shows_the_committed_results():
    results, write = ROOT / "benchmarks/results", "run python -m benchmarks.readme --write"
    assert readme_table(read_cells(results)) in tables(ROOT / "README.md")["readme"], write
    for name, table in documentation_tables(results).items():
        assert table in tables(DOCS / "results/gym_control.md")[name], write


# Rows of the tables of the speed page, and the ratio to PPO that is stated elsewhere and in the page's first lines
ITERATION, NEXT = "iteration (rollout and `train()`)", ', `churn_reference="next"`'
RATIOS = [
    ("gym_control", ITERATION, "CChainPPO", "1.08"),
    ("gym_control", ITERATION, f"CChainPPO{NEXT}", "1.03"),
    ("gym_control", ITERATION, "deep copy", "1.74"),
    ("gym_control", ITERATION, "SBX's PPO", "0.94"),
    ("gym_control", "`train()`", "CChainPPO", "1.29"),
    ("gym_control", "`train()`", f"CChainPPO{NEXT}", "1.16"),
    ("gym_control", "`train()`", "deep copy", "2.50"),
    ("gym_control", "`train()`", "SBX's PPO", "0.85"),
    ("dmc", "`train()`", "SBX's PPO", "0.48"),
    ("procgen", "`train()`", "CChainPPO", "2.30"),
    ("procgen", "`train()`", f"CChainPPO{NEXT}", "1.47"),
    ("minatar", "`train()`", "CChainDQN", "1.33"),
    ("minatar", "`train()`", f"CChainDQN{NEXT}", "1.16"),
]


@pytest.mark.parametrize("table, what, model, ratio", RATIOS)
def test_stated_costs_are_those_of_the_tables(table, what, model, ratio):
    speed = DOCS / "results/speed.md"
    (row,) = re.findall(rf"^\| {re.escape(what)} \| {re.escape(model)} \|(.*)$", tables(speed)[table], re.M)
    assert row.split("|")[1].split()[0] == ratio
    stated = [speed.read_text().split("How to read")[0], (DOCS / "comparison.md").read_text()]
    assert any(ratio in text for text in stated)


def test_the_readme_states_no_other_costs():
    in_short = (DOCS / "results/speed.md").read_text().split("How to read")[0]
    (cost,) = re.findall(r"^- \*\*Cost\.\*\*(.*?)\n\n", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    numbers = re.findall(r"\d+\.\d+", cost)
    assert len(numbers) > 3 and set(numbers) <= set(re.findall(r"\d+\.\d+", in_short))


def literal(node: ast.expr) -> str | None:
    """A string as the code has it, with … in place of what is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
        return "".join(map(str, parts))
    return None


@cache
def nodes() -> list[ast.AST]:
    return [node for path in (ROOT / "sb3_cchain").rglob("*.py") for node in ast.walk(ast.parse(path.read_text()))]


def pieces(message: str) -> list[str]:
    return [piece.strip(" .") for piece in message.split("…") if len(piece.strip(" .")) > 3]


def quoted_messages() -> list[str]:
    blocks = re.findall(r"^ *```text\n(.*?)^ *```", (DOCS / "faq.md").read_text(), flags=re.DOTALL | re.MULTILINE)
    return [line.strip() for block in blocks for line in block.splitlines()]


def is_said(piece: str, texts: str) -> bool:
    """In one string of the code, or in two, which are put together there."""
    return any(piece[:end].strip(" ,:") in texts and piece[end:].strip(" ,:") in texts for end in range(len(piece)))


def test_the_messages_of_the_troubleshooting_page_are_those_of_the_code():
    texts = "\n".join(filter(None, (literal(node) for node in nodes() if isinstance(node, ast.expr))))
    missing = [piece for message in quoted_messages() for piece in pieces(message) if not is_said(piece, texts)]
    assert missing == []


def test_the_troubleshooting_page_has_every_warning():
    page = (DOCS / "faq.md").read_text()
    calls = [node for node in nodes() if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "warn"]
    warnings = [text for call in calls if (text := literal(call.args[0])) is not None]
    assert len(warnings) > 10
    # The first words of each
    assert [text for text in warnings if pieces(text)[0][:40].strip() not in page] == []
