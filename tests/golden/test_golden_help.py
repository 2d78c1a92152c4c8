"""Every command's help reads as it read."""

from __future__ import annotations

import pytest
from adapter import HELP, help_text
from record import held


@pytest.mark.parametrize("name", HELP)
def test_help_reads_as_it_did(name):
    found = help_text(HELP[name])
    assert found == held(f"help/{name}.txt", found)
