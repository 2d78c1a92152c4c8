"""Batched trials: tasks, starts, rewards, observations."""
