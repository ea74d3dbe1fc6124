"""A table of what was measured, in Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH


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
        return f"{markdown_table(self.header, self.rows)}\n\n{fill(self.note, LINE_LENGTH)}"
