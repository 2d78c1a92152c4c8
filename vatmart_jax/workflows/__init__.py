"""Whole jobs: train a run, evaluate runs."""
