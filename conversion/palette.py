"""Colours by role, RGB in 0..1, of pictures and MJCF models."""

from __future__ import annotations

BODY, HANDLE = (0.80, 0.78, 0.74), (0.25, 0.25, 0.28)
PARTS = ((0.62, 0.72, 0.84), (0.86, 0.70, 0.55), (0.66, 0.80, 0.62), (0.82, 0.64, 0.72), (0.74, 0.70, 0.86))
