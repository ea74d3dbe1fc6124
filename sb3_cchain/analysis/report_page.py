"""The doctor's report as one HTML page that needs nothing beside it: no network, no scripts, pictures inside."""

import base64
import io
import math
from collections.abc import Sequence
from html import escape
from string import Template

from sb3_cchain.analysis.findings import CHECKS, Check, Finding, number
from sb3_cchain.analysis.inspection import Inspection
from sb3_cchain.analysis.inspection_report import draw

# Colours as the reader has set them, dark or light; pictures keep their white background
_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<link rel="icon" href="data:,">
<title>$title</title>
<style>
:root { color-scheme: light dark; --line: #8886; --ill: #c62828; --maybe: #b26a00; --well: #2e7d32; }
@media (prefers-color-scheme: dark) { :root { --ill: #ff8a80; --maybe: #ffcc80; --well: #a5d6a7; } }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; }
h2 { font-size: 1.25rem; margin-top: 2.5rem; overflow-wrap: anywhere; }
h3 { margin: 1.5rem 0 0; font-size: 1.05rem; }
.finding h3 { margin: 0; }
.verdict, .finding { border-left: 0.4rem solid var(--well); padding: 0.1rem 0 0.1rem 0.9rem; margin: 1rem 0; }
.likely { border-color: var(--ill); } .possible { border-color: var(--maybe); }
.verdict { font-size: 1.1rem; font-weight: 600; }
.finding p { margin: 0.4rem 0; } .source { font-size: 0.85rem; opacity: 0.8; }
.ill { color: var(--ill); font-weight: 600; } .maybe { color: var(--maybe); font-weight: 600; } .well { color: var(--well); }
pre { overflow-x: auto; padding: 0.6rem; margin: 0.3rem 0; border: 1px solid var(--line); border-radius: 4px; }
pre { font-size: 0.85rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 0.3rem 0.6rem 0.3rem 0; border-bottom: 1px solid var(--line); }
td small { overflow-wrap: anywhere; }
/* Narrow screens scroll the picture, whose text would be too small */
img { width: 100%; min-width: 42rem; background: white; border-radius: 4px; }
summary { cursor: pointer; }
</style>
</head>
<body>
<h1>$title</h1>
$body
</body>
</html>
""")


def html_report(inspections: Sequence[Inspection], title: str, with_picture: bool = True) -> str:
    """
    :param inspections: Of one model, or of two to compare
    :param title: Title of the page
    :param with_picture: Whether there is a picture of the networks, for which matplotlib is needed
    :return: The page
    :raises ImportError: Without matplotlib, when there should be a picture
    """
    parts = [_section(inspection) for inspection in inspections]
    if with_picture and any(tag.startswith("health/") for inspection in inspections for tag in inspection.figures):
        parts.append(_picture(inspections))
    return _PAGE.substitute(title=escape(title), body="\n".join(parts))


def _section(inspection: Inspection) -> str:
    about = f"{inspection.algorithm}, {inspection.num_timesteps} environment steps of training"
    mean_return = inspection.figures.get("rollout/mean_return", math.nan)
    if not math.isnan(mean_return):
        about += f"; mean return {number(mean_return)} in {inspection.figures['rollout/n_episodes']:.0f} episodes"
    return "\n".join(
        [
            f"<h2>{escape(inspection.name)}</h2>",
            f"<p>{escape(about)}</p>",
            _verdict(inspection),
            *map(_finding, inspection.findings),
            "<h3>All measures</h3>",
            _measures(inspection),
        ]
    )


def _verdict(inspection: Inspection) -> str:
    n_likely = sum(finding.check.certainty == "likely" for finding in inspection.findings)
    n_possible = len(inspection.findings) - n_likely
    counts = [f"{n} {certainty}" for n, certainty in ((n_likely, "likely"), (n_possible, "possible")) if n]
    text = f"Findings: {', '.join(counts)}" if counts else "No findings: this model looks healthy"
    kind = "likely" if n_likely else "possible" if n_possible else ""
    return f'<p class="verdict {kind}">{text}</p>'


def _finding(finding: Finding) -> str:
    check = finding.check
    remedies = "\n".join(
        f"<li>{escape(remedy.title[0].upper() + remedy.title[1:])}<pre><code>{escape(remedy.line)}</code></pre></li>"
        for remedy in finding.remedies
    )
    advice = f"<details><summary>What to try</summary><ul>{remedies}</ul></details>" if remedies else ""
    return (
        f'<div class="finding {check.certainty}"><h3>{escape(check.title)} ({check.certainty})</h3>'
        f"<p><strong>{escape(finding.measured())}</strong></p><p>{escape(check.meaning)}</p>"
        f'<p class="source">Threshold: {escape(check.source)}</p>{advice}</div>'
    )


def _measures(inspection: Inspection) -> str:
    rows = "\n".join(_measure(check, inspection) for check in CHECKS)
    header = "<tr><th>measure</th><th>value</th><th>healthy</th></tr>"
    return f'<div class="wide"><table>{header}\n{rows}</table></div>'


def _measure(check: Check, inspection: Inspection) -> str:
    worst = check.worst(inspection.symptoms)
    name = escape(check.measure.replace("_", " "))
    if worst is None:
        return f"<tr><td>{name}</td><td>not measured</td><td>{check.healthy_range()}</td></tr>"
    part, value = worst
    kind, verdict = "well", "healthy"
    if check.is_sick(value):
        kind, verdict = ("ill" if check.certainty == "likely" else "maybe"), check.certainty
    where = f"<br><small>{escape(part)}</small>" if part else ""
    shown = f'<span class="{kind}">{number(value)} ({verdict})</span>'
    return f"<tr><td>{name}{where}</td><td>{shown}</td><td>{check.healthy_range()}</td></tr>"


def _picture(inspections: Sequence[Inspection]) -> str:
    file = io.BytesIO()
    draw(inspections).savefig(file, format="png")
    data = base64.b64encode(file.getvalue()).decode()
    n_ntks = sum(inspection.ntk is not None for inspection in inspections)
    alone = " and its singular values" if n_ntks == 1 else ""
    kernels = f"The neural tangent kernel as a matrix{alone}, and bars" if n_ntks else "Bars"
    what = f"{kernels} of the units, the features and the weights of each group of layers."
    names = " and ".join(inspection.name for inspection in inspections)
    image = f'<img alt="{escape(f"{names}: {what}")}" src="data:image/png;base64,{data}">'
    return f'<h2>The networks</h2>\n<p>{what}</p>\n<div class="wide">{image}</div>'
