"""The golden values: `held` reads one; `python tests/golden/record.py` writes all of them anew.

They say what the package did when they were recorded. A change that only moves code leaves them as they are.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

VALUES = Path(__file__).parent / "values"
_RECORDING = "GOLDEN_RECORD"


def held(name: str, found: Any) -> Any:
    """The golden value of this name, text (.txt) or JSON; while recording it becomes `found`."""
    path = VALUES / name
    text = path.suffix == ".txt"
    if os.environ.get(_RECORDING):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(found if text else _lines(found) + "\n")
    return path.read_text() if text else json.loads(path.read_text())


def summary(array: np.ndarray) -> dict[str, Any]:
    """Of floats shape and statistics, one of which depends on the order; of all else shape and hash."""
    if array.dtype.kind == "f":
        flat = array.astype(np.float64).ravel()
        statistics = {"shape": list(array.shape), "type": array.dtype.name}
        if flat.size:
            ordered = (flat * np.linspace(0, 1, flat.size)).mean()
            found = {"mean": flat.mean(), "std": flat.std(), "ordered": ordered, "min": flat.min(), "max": flat.max()}
            statistics |= {name: _rounded(value) for name, value in found.items()}
        return statistics | {"first": [_rounded(value) for value in flat[:6]]}
    if array.dtype.kind == "U":
        kind, data = "str", "\n".join(array.ravel().tolist()).encode()
    else:
        kind, data = ("bool" if array.dtype.kind == "b" else "int"), array.astype("<i8").tobytes()
    return {"shape": list(array.shape), "type": kind, "sha256": hashlib.sha256(data).hexdigest()[:32]}


def _rounded(value: float) -> float:
    return round(float(value), 6) + 0.0  # never -0.0


def _lines(value: Any) -> str:
    """JSON with a line per entry of its outermost dict or list."""
    if isinstance(value, dict):
        return "{\n" + ",\n".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in value.items()) + "\n}"
    return "[\n" + ",\n".join(json.dumps(v) for v in value) + "\n]"


if __name__ == "__main__":
    os.environ[_RECORDING] = "1"
    sys.exit(pytest.main([str(Path(__file__).parent)]))
