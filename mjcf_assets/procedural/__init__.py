"""Procedural articulated objects: meshes, furniture components, categories, and the writer of PartNet's layout."""
