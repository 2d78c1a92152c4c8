"""Benchmarks: speed of physics and networks, agreement of the physics implementations."""
