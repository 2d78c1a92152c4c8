"""Trained priors: load, save, predict, export."""
