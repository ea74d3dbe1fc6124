"""Markdown as one HTML page that needs nothing beside it: no network, no scripts, pictures inside."""

import base64
import re
from collections.abc import Mapping
from html import escape
from pathlib import Path

from markdown_it import MarkdownIt

# Colours as the reader has set them, dark or light; pictures keep their white background
STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h2 { margin-top: 3rem; border-bottom: 1px solid #8888; }
p, li { max-width: 50rem; }
.table { overflow-x: auto; margin: 1rem 0; }
pre { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.82rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.5rem; white-space: nowrap; text-align: left; }
th { border-bottom: 2px solid #8888; }
tr:has(td:first-child:not(:empty)) td { border-top: 1px solid #8886; }
img { max-width: 100%; background: white; border-radius: 4px; }
code { font-size: 0.9em; }
ins { text-underline-offset: 0.2em; }
"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}</body>
</html>
"""


def html_page(markdown: str, pictures: Mapping[str, Path]) -> str:
    """
    :param markdown: Markdown, whose first line is its title, with tables and ``<ins>``; no other HTML passes
    :param pictures: PNG files by the names that the Markdown has for them. No other file is embedded
    :return: The page. Headings have the anchors that GitHub gives them
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for token, following in zip(tokens, [*tokens[1:], None], strict=True):
        if token.type == "heading_open" and following is not None:
            token.attrSet("id", re.sub(r"[^\w\- ]", "", following.content.lower()).replace(" ", "-"))
        for child in token.children or ():
            if child.type == "image":
                picture = pictures.get(str(child.attrGet("src")))
                data = "" if picture is None else base64.b64encode(picture.read_bytes()).decode()
                child.attrSet("src", f"data:image/png;base64,{data}")
    body = parser.renderer.render(tokens, parser.options, {})
    body = body.replace("<table>", '<div class="table"><table>').replace("</table>", "</table></div>")
    body = body.replace("&lt;ins&gt;", "<ins>").replace("&lt;/ins&gt;", "</ins>")
    title = escape(markdown.splitlines()[0].lstrip("# "))
    return PAGE.format(title=title, style=STYLE, body=body)
