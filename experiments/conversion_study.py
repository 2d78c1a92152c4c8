"""Three ways to take links apart, on the same links and by the same measures of fidelity.

    python experiments/conversion_study.py --src REAL

hulls: one hull per semantic leaf, concave leaves grown from their flat patches, merged to the budget (the default).
coacd_leaf: CoACD on the concave leaves, merged to the budget (`--decomposer coacd`). coacd_link: CoACD on the whole
link's mesh, which knows nothing of leaves. Seconds are of one core. Gap, phantom: see conversion/fidelity.py.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import tyro

from conversion.config import DecomposeConfig
from conversion.decompose import decompose
from conversion.fidelity import measure_fidelity
from conversion.model import ConvexShape
from conversion.part_detection import detect_parts
from conversion.readers import read_object
from conversion.surface import Surface

RESULTS = Path(__file__).parent / "results" / "conversion-study.json"
CONFIG = DecomposeConfig()
# A door or drawer (its first) or the static rest of one object each, over the categories.
LINKS = (
    ("45194", "static"), ("46120", "part"), ("41083", "part"), ("45621", "static"), ("12036", "static"),
    ("11178", "part"), ("7310", "static"), ("7167", "part"), ("8877", "part"), ("101599", "static"), ("22301", "part"),
    ("100129", "static"), ("102055", "static"),
)  # fmt: skip


def hulls(surface: Surface, budget: int) -> list[ConvexShape]:
    return decompose(surface, budget, CONFIG)


def coacd_leaf(surface: Surface, budget: int) -> list[ConvexShape]:
    return decompose(surface, budget, replace(CONFIG, decomposer="coacd"))


def coacd_link(surface: Surface, budget: int) -> list[ConvexShape]:
    import coacd

    coacd.set_log_level("error")
    start = np.cumsum([0] + [len(v.vertices) for v in surface.visuals])
    found = coacd.run_coacd(
        coacd.Mesh(
            np.concatenate([v.vertices for v in surface.visuals]),
            np.concatenate([v.faces + s for v, s in zip(surface.visuals, start, strict=False)]),
        ),
        threshold=0.05,
        max_convex_hull=budget,
        decimate=True,
        max_ch_vertex=CONFIG.max_vertices,
        mcts_iterations=60,
        mcts_nodes=10,
        resolution=1000,
        seed=0,
    )
    return [ConvexShape(vertices=np.asarray(v, np.float64), is_handle=False) for v, _ in found]


def main(src: Path, results: Path = RESULTS, links: tuple[str, ...] = ()) -> None:
    """links: ids to do again; all if empty."""
    table = json.loads(results.read_text()) if results.is_file() else {}
    methods: tuple[Callable[[Surface, int], list[ConvexShape]], ...] = (hulls, coacd_leaf, coacd_link)
    for name, what in LINKS:
        if links and name not in links:
            continue
        obj = read_object(src / name)
        root = obj.root if what == "static" else detect_parts(obj)[0][0].link
        visuals = obj.group_visuals(root)
        row = {"category": obj.category, "link": root, "leaves": len(visuals)}
        for method in methods:
            start = time.process_time()
            found = method(Surface(visuals), 32 if what == "static" else 16)
            seconds = time.process_time() - start
            match = asdict(measure_fidelity(Surface(visuals, seed=1), found))
            row[method.__name__] = {"seconds": round(seconds, 2), "hulls": len(found)} | {
                k: round(v, 4) for k, v in match.items()
            }
        table[f"{name} {what}"] = row
        results.write_text(json.dumps(table, indent=1) + "\n")
        print(name, what, json.dumps(row))
    for method in methods:
        rows = [row[method.__name__] for key, row in table.items() if method.__name__ in row]
        median = {k: round(float(np.median([r[k] for r in rows])), 4) for k in rows[0]}
        worst = {k: max(r[k] for r in rows) for k in rows[0]}
        print(method.__name__, "median", json.dumps(median), "most", json.dumps(worst))


if __name__ == "__main__":
    tyro.cli(main)
