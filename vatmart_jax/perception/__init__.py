"""Perception: PointNet++, the three heads, and their training, as pure functions on device."""
