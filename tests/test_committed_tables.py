"""The tables of the documentation are those that the committed results give (the reports: test_report.py)."""

import importlib
import re
import shutil
from pathlib import Path

import pytest
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
# Those of `make tables` that take a folder of pages
MODULES = ("family", "plasticity", "sensitivity", "supervised", "shelf")


def command(module):
    name = f"benchmarks.{module}"
    return importlib.import_module(f"{name}.__main__" if (ROOT / "benchmarks" / module).is_dir() else name)


@pytest.mark.parametrize("module", MODULES)
def test_the_committed_results_make_the_committed_tables(module, tmp_path, monkeypatch, capsys):
    """That a picture is the same to the bit is not asked."""
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: drawn.append(Path(path)))
    docs = tmp_path / "docs"
    pages = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").glob("[!_]*/**/*.md")]
    for page in pages:
        (docs / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "docs" / page, docs / page)
    command(module).main(["--write", "--docs", str(docs)])
    assert drawn and all((ROOT / "docs" / path.relative_to(docs)).is_file() for path in drawn)
    for page in pages:
        assert (docs / page).read_text() == (ROOT / "docs" / page).read_text(), f"python -m benchmarks.{module} --write"


def test_one_command_makes_them_all():
    (recipe,) = re.findall(r"^tables: install\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    made = re.findall(r"-m benchmarks\.(\w+)", recipe)
    assert sorted(made) == sorted(["report", "readme", *MODULES])
