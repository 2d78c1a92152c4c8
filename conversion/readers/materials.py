"""Materials of OBJ files: what model.xml carries over with `--textures`.

MuJoCo reads PNG alone, so images are made PNG here, as bytes that two materials with the same picture share.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

MAX_PIXELS = 2**26  # an image that claims more is damage
FORMATS = ("PNG", "JPEG", "BMP", "GIF")


def read_mtl(text: str) -> dict[str, tuple[tuple[float, float, float, float], str | None]]:
    """Colour and image name (as written) of every material. Lines that cannot be read count for nothing."""
    color: dict[str, list[float]] = {}
    image: dict[str, str] = {}
    name = ""
    for line in text.splitlines():
        key, _, value = line.strip().partition(" ")
        value = value.strip()
        try:
            if key == "newmtl":
                name = value
                color[name] = [0.8, 0.8, 0.8, 1.0]
            elif name and key == "Kd":
                r, g, b = np.clip([float(x) for x in value.split()[:3]], 0, 1)
                color[name][:3] = r, g, b
            elif name and key == "d" and 0 < float(value) <= 1:  # exporters write 0 for what is not transparent
                color[name][3] = float(value)
            elif name and key == "map_Kd" and value:
                # Options come before the file, whose name may have blanks.
                file = value.split()[-1] if value.startswith("-") else value
                image[name] = file.replace("\\", "/")
        except ValueError:
            continue
    return {k: ((c[0], c[1], c[2], c[3]), image.get(k)) for k, c in color.items()}


def read_png(path: Path, size: int) -> bytes:
    """The picture as PNG, no side longer than size. Raises ValueError where it cannot be read."""
    try:
        with Image.open(path, formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} by {image.height} pixels")
            picture = image.convert("RGB")
        picture.thumbnail((size, size))
        out = io.BytesIO()
        picture.save(out, "PNG")
        return out.getvalue()
    except Exception as e:  # Pillow raises whatever its parsing runs into
        raise ValueError(f"no readable image ({type(e).__name__})") from None
