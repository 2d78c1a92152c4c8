"""The HTML report of a conversion's fidelity, object by object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

MAX_GAP, MAX_PHANTOM = 0.005, 0.02  # a group beyond these is marked: unit lengths; share of the hull surface
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Conversion report</title>
<style>
body {{ font: 14px system-ui, sans-serif; margin: 2em; color: #222 }}
table {{ border-collapse: collapse }}
th, td {{ padding: 4px 10px; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top }}
th {{ cursor: pointer; position: sticky; top: 0; background: #f4f4f4 }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums }}
td.bad {{ background: #fbe3dd }}
img {{ width: 520px; display: block }}
td:last-child {{ max-width: 26em }}
td:last-child small {{ display: block; max-height: 9em; overflow: auto }}
small {{ color: #666 }}
</style>
<h1>Conversion report</h1>
<p>{summary}</p>
<p><small>Pictures: visual meshes and hulls closed, then open. Gap: visual surface outside the hulls. Phantom: share of
hull surface farther than 0.02 from any visual surface. Handles: those a finger still passes behind, of those it passes
behind in the visual meshes. Lengths in unit lengths of the object. Click a heading to sort.</small></p>
{refused}
<table id="objects"><thead><tr>{head}</tr></thead><tbody>
{rows}
</tbody></table>
<script>
document.querySelectorAll("#objects th").forEach((th, column) => th.onclick = () => {{
  const body = document.querySelector("#objects tbody"), down = th.dataset.down = th.dataset.down === "1" ? "0" : "1";
  const value = row => {{
    const text = row.cells[column].dataset.v ?? row.cells[column].innerText;
    return text !== "" && !isNaN(text) ? Number(text) : text;
  }};
  const compare = (a, b) => typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1;
  [...body.rows].sort((a, b) => compare(value(a), value(b)) * (down === "1" ? -1 : 1)).forEach(r => body.append(r));
}});
</script>
</html>
"""


def html_report(
    reports: Sequence[Mapping[str, Any]], failed: Sequence[Mapping[str, str]], without_views: Sequence[str]
) -> str:
    """report.html of a data set, to lie beside the object folders; worst objects first.

    reports: the report.json of each object.
    """
    head = ("picture", "id", "category", "split", "parts", "hulls", "gap", "phantom", "handles", "seconds", "notes")
    rows = []
    for r in sorted(reports, key=_badness, reverse=True):
        groups = r["groups"].values()
        gap = max((g["gap_max"] for g in groups), default=0.0)
        phantom = max((g["phantom_share"] for g in groups), default=0.0)
        passable = [h for h in r["handles"] if h["clear_in_mesh"]]
        kept = sum(h["clear_in_hulls"] for h in passable)
        notes = [*r["notes"], *(f"{x['joint']}: {x['reason']}" for x in r["left_out"])]
        notes += [f"{g}: {m['hulls']} hulls in a budget of {m['budget']}" for g, m in r["groups"].items() if _over(m)]
        parts = ", ".join(f"{p['link']} ({p['kind']})" for p in r["parts"])
        cells = [
            f'<td><img loading="lazy" src="{quote(r["id"])}/picture.png"></td>',
            f"<td>{escape(r['id'])}</td><td>{escape(r['category'])}</td><td>{escape(r['split'])}</td>",
            f'<td data-v="{len(r["parts"])}">{escape(parts)}</td>',
            f'<td class="n">{sum(g["hulls"] for g in groups)}</td>',
            _number(f"{gap:.4f}", gap > MAX_GAP),
            _number(f"{phantom:.3f}", phantom > MAX_PHANTOM),
            _number(f"{kept} / {len(passable)}", kept < len(passable)),
            f'<td class="n">{r["seconds"]:.1f}</td><td><small>{"<br>".join(map(escape, notes))}</small></td>',
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    listed = [f"<li><b>{escape(f['id'])}</b> refused: {escape(f['reason'])}</li>" for f in failed]
    listed += [f"<li>no views: {escape(why)}</li>" for why in without_views]
    return _PAGE.format(
        summary=escape(_summary(reports, failed)),
        refused=f"<ul>{''.join(listed)}</ul>" if listed else "",
        head="".join(f"<th>{h}</th>" for h in head),
        rows="\n".join(rows),
    )


def _number(text: str, is_bad: bool) -> str:
    return f'<td class="n bad">{text}</td>' if is_bad else f'<td class="n">{text}</td>'


def _over(group: Mapping[str, Any]) -> bool:
    return group["hulls"] > group["budget"]


def _badness(report: Mapping[str, Any]) -> float:
    """How far the worst group is beyond the gap and the phantom share that are marked, in those units."""
    groups = report["groups"].values()
    lost = sum(h["clear_in_mesh"] and not h["clear_in_hulls"] for h in report["handles"])
    return lost + max((max(g["gap_max"] / MAX_GAP, g["phantom_share"] / MAX_PHANTOM) for g in groups), default=0.0)


def _summary(reports: Sequence[Mapping[str, Any]], failed: Sequence[Mapping[str, str]]) -> str:
    moving = [r["groups"][p["link"]] for r in reports for p in r["parts"]]
    seconds = np.array([r["seconds"] for r in reports] or [0.0])
    kinds = Counter(p["kind"] for r in reports for p in r["parts"])
    counted = ", ".join(f"{n} {kind}s" for kind, n in sorted(kinds.items())) or "no moving parts"
    text = f"{len(reports)} objects converted, {len(failed)} refused; {counted}. "
    text += f"Seconds per object: median {np.median(seconds):.1f}, 90% {np.percentile(seconds, 90):.1f}, "
    text += f"most {seconds.max():.1f}. "
    if moving:
        gap = np.percentile([g["gap_max"] for g in moving], 90)
        share = np.percentile([g["phantom_share"] for g in moving], 90)
        text += f"Moving parts, 90%: gap within {gap:.4f}, phantom surface within {share:.2%}. "
    passable = [h for r in reports for h in r["handles"] if h["clear_in_mesh"]]
    if passable:
        kept = sum(h["clear_in_hulls"] for h in passable)
        text += f"A finger still passes behind {kept} of {len(passable)} handles."
    return text
