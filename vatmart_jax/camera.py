"""The one camera convention: where a camera stands, what it looks along, and what lies where in its picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera in the object frame (z up, the object's front towards -x)."""

    position: np.ndarray  # [3]
    axes: np.ndarray  # [3, 3] unit rows: right, up, forward

    @classmethod
    def looking_at(cls, centre: np.ndarray, azimuth: float, elevation: float, distance: float = 1.0) -> Camera:
        """A camera that sees `centre` in the middle of its picture, z up.

        azimuth: rad about z, 0 in front (at -x), positive ones at -y. elevation: rad above the horizon, below pi / 2.
        These are the angles that a ViewBank keeps of each view.
        """
        back = np.array([-np.cos(azimuth), -np.sin(azimuth), np.tan(elevation)]) * np.cos(elevation)
        right = np.cross(-back, [0, 0, 1])
        right /= np.linalg.norm(right)
        return cls(position=centre + distance * back, axes=np.stack([right, np.cross(back, right), -back]))

    @property
    def right(self) -> np.ndarray:
        return self.axes[0]

    @property
    def up(self) -> np.ndarray:
        return self.axes[1]

    @property
    def forward(self) -> np.ndarray:
        return self.axes[2]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Orthographic picture coordinates [..., 2] of points [..., 3]: to the right and up, in unit lengths."""
        return (points - self.position) @ self.axes[:2].T

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance [...] of points [..., 3] from the camera along its direction of sight."""
        return (points - self.position) @ self.forward

    def rays(self, points: np.ndarray, *, pixels: int, field_of_view: float) -> np.ndarray:
        """Unit directions [n, 3] through the centres of all pixels in the bounding box of the projected points [m, 3].

        pixels: of the square picture's side. field_of_view: rad, of the whole picture.
        """
        p = (points - self.position) @ self.axes.T
        focal = pixels / 2 / np.tan(field_of_view / 2)
        image = focal * p[:, :2] / p[:, 2:]
        low = np.clip(np.floor(image.min(axis=0) + pixels / 2), 0, pixels).astype(int)
        high = np.clip(np.ceil(image.max(axis=0) + pixels / 2), 0, pixels).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 - pixels / 2 for a, b in zip(low, high, strict=True)))
        directions = np.stack([x.ravel(), y.ravel(), np.full(x.size, focal)], axis=1) @ self.axes
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)
