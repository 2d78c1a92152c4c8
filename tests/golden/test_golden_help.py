"""Every command's help reads as it read."""

from __future__ import annotations

import pytest
from adapter import HELP, help_text
from record import VALUES, held


@pytest.mark.parametrize("name", HELP)
def test_help_reads_as_it_did(name):
    found = help_text(HELP[name])
    assert found == held(f"help/{name}.txt", found)


def test_no_command_is_gone():
    assert {path.stem for path in (VALUES / "help").glob("*.txt")} == set(HELP)
