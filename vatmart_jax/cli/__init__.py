"""The `vatmart` command."""
