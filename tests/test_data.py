"""Preparing data: of several runs that start at once, one converts and the others wait."""

import threading
import time
from pathlib import Path

from vatmart_jax.data import prepare


def test_runs_that_start_at_once_prepare_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    inside, most, found, said = 0, 0, [], []

    def convert(source: Path, out: Path) -> None:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        time.sleep(0.05)
        inside -= 1

    def run() -> None:
        found.append(prepare(None, convert, lambda out: out.mkdir(exist_ok=True), said.append))

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and len(found) == 4 and len(set(found)) == 1
    assert len(said) == 3 and all("waiting for another run" in line for line in said)
