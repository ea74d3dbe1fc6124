"""The pictures of a report: where they lie, and the Markdown that shows them."""

from pathlib import Path

PICTURES = "pictures"


class Pictures:
    """
    The pictures of a report.

    :param folder: Folder of the report
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self.drawn: dict[str, Path] = {}
        (folder / PICTURES).mkdir(parents=True, exist_ok=True)

    def add(self, name: str, alternative: str) -> tuple[Path, str]:
        """
        :param name: Name of a picture that is about to be drawn
        :param alternative: Alternative text
        :return: Its path, and the Markdown that shows it
        """
        relative = f"{PICTURES}/{name}.png"
        self.drawn[relative] = self._folder / relative
        return self.drawn[relative], f"![{alternative}]({relative})"
