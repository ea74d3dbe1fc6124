"""Tables in Markdown, and the places in the documentation where they stand."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

# Of the pages
LINE_LENGTH = 120

# A table of the documentation stands between these two comments, which readers do not see
PLACE = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", flags=re.DOTALL)


@dataclass
class Table:
    """
    What was measured.

    :param header: Names of the columns
    :param rows: Cells
    :param note: What the reader must know about it
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str

    def markdown(self) -> str:
        """
        :return: The table and, below it, the note
        """
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
        return f"{table}\n\n{fill(self.note, LINE_LENGTH)}"


def write_tables(tables: Mapping[str, str], folder: Path) -> None:
    """
    Put tables between their comments.

    :param tables: Markdown, by name
    :param folder: Where the pages are, or one page
    :raises ValueError: When a table has no place in any page; the others have been written
    """
    written = set()
    for page in sorted(folder.rglob("*.md")) if folder.is_dir() else [folder]:

        def replace(place: re.Match[str]) -> str:
            name = place[1]
            if name not in tables:
                return place[0]
            written.add(name)
            return f"<!-- table: {name} -->\n\n{tables[name]}\n\n<!-- end -->"

        text = page.read_text()
        filled = PLACE.sub(replace, text)
        if filled != text:
            page.write_text(filled)
    if missing := set(tables) - written:
        raise ValueError(
            f"No page in {folder} has a place for {', '.join(sorted(missing))}: <!-- table: NAME --> <!-- end -->"
        )
