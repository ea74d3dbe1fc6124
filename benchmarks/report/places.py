"""The places in the documentation where generated tables stand."""

import re
from collections.abc import Mapping
from pathlib import Path

# Of the pages
LINE_LENGTH = 120

# A table of the documentation stands between these two comments, which readers do not see
PLACE = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", flags=re.DOTALL)


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
