"""`vatmart bench physics`, `parity` and `perception`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from vatmart_jax.atomic_io import write_json
from vatmart_jax.cli.common import JsonFlag, names, prepare_jax, run_command
from vatmart_jax.envs import TASKS
from vatmart_jax.errors import UserError, require_one_of
from vatmart_jax.physics import BACKENDS
from vatmart_jax.reporting import ConsoleReporter, Reporter


@dataclass(frozen=True)
class Bench:
    """Flags of all benchmarks."""

    data: tuple[Path, ...] = ()
    """a folder of objects, or what `vatmart convert` made of it; default the bundled objects"""
    split: str = "train"
    """train, test_shapes, test_categories, extra or all"""
    objects: int | None = None
    """only so many of its objects, drawn at random"""
    seed: int = 0
    out: Path | None = None
    """also write the result to this .json file"""
    json: JsonFlag = False

    max_folders: ClassVar[int] = 1

    def run(self) -> dict[str, Any]:
        self.validate()
        if len(self.data) > self.max_folders:
            raise UserError(
                f"--data: {len(self.data)} folders; give one (parity: or two conversions of the same objects)"
            )
        prepare_jax()
        from vatmart_jax.bench.common import SceneSubset
        from vatmart_jax.workflows.prepare import prepare

        with ConsoleReporter() as reporter:
            folders = [prepare(data, reporter=reporter) for data in self.data or (None,)]
            result = self.measure(SceneSubset(folders[0], self.split, self.objects), folders[1:], reporter)
        if self.out:
            write_json(self.out, result)
        return result

    def validate(self) -> None:
        """Raises UserError for flags that do not fit."""

    def measure(self, subset: Any, others: list[Path], reporter: Reporter) -> dict[str, Any]:
        raise NotImplementedError


@dataclass(frozen=True)
class BenchPhysics(Bench):
    """Physics steps and whole trials per second."""

    impl: str = "c"
    """c, warp or jax"""
    batch: str = "1024"
    """simulations at once; several as in 256,1024,4096"""
    task: str = "push-door"
    seconds: float = 10.0
    """each measurement lasts at least so long"""

    def validate(self) -> None:
        require_one_of("--task", self.task, TASKS)
        require_one_of("--impl", self.impl, BACKENDS.names())
        if min(self._batches()) < 1:
            raise UserError(f"--batch {self.batch}: a batch has one simulation or more")

    def _batches(self) -> tuple[int, ...]:
        try:
            return tuple(int(word) for word in self.batch.split(","))
        except ValueError as e:
            raise UserError(f"--batch {self.batch}: expected whole numbers, as in 256,1024,4096") from e

    def measure(self, subset: Any, others: list[Path], reporter: Reporter) -> dict[str, Any]:
        from vatmart_jax.bench.physics import bench_physics

        return bench_physics(
            subset, impl=self.impl, batches=self._batches(), task=self.task, seed=self.seed, seconds=self.seconds
        )


@dataclass(frozen=True)
class BenchParity(Bench):
    """The same random trials on several implementations; with a second --data folder (boxes) also on that."""

    impls: str = "c,warp,jax"
    """the first is the reference"""
    trials: int = 120
    """per task"""

    max_folders: ClassVar[int] = 2

    def validate(self) -> None:
        names("--impls", self.impls, BACKENDS.names())

    def measure(self, subset: Any, others: list[Path], reporter: Reporter) -> dict[str, Any]:
        from vatmart_jax.bench.parity import bench_parity

        other = others[0] if others else None
        return bench_parity(
            subset, tuple(self.impls.split(",")), trials=self.trials, seed=self.seed, other=other, reporter=reporter
        )


@dataclass(frozen=True)
class BenchPerception(Bench):
    """Training steps per second, and how long a view of 10,000 points takes to encode."""

    preset: str = "cpu"
    """whose networks: quick, cpu, gpu or paper"""
    seconds: float = 10.0
    """each measurement lasts at least so long"""

    def validate(self) -> None:
        from vatmart_jax.pipeline.presets import PRESETS

        require_one_of("--preset", self.preset, PRESETS)

    def measure(self, subset: Any, others: list[Path], reporter: Reporter) -> dict[str, Any]:
        from vatmart_jax.bench.perception import bench_perception

        return bench_perception(subset, preset=self.preset, seed=self.seed, seconds=self.seconds)


BENCHES: dict[str, type[Bench]] = {"physics": BenchPhysics, "parity": BenchParity, "perception": BenchPerception}


def main(argv: list[str]) -> None:
    """Run the benchmark that the first word names."""
    what = argv[0] if argv else ""
    if what in ("-h", "--help"):
        rows = "\n".join(f"  {name:<10} {(kind.__doc__ or '').strip()}" for name, kind in BENCHES.items())
        flags = "`vatmart bench WHAT --help` lists the flags of one, --json among them."
        print(f"usage: vatmart bench WHAT [flags]\n\n{rows}\n\n{flags}")
        sys.exit(0)
    if what not in BENCHES:
        raise UserError(f"bench {what}: name what to measure, one of {', '.join(BENCHES)}")
    run_command(BENCHES[what], argv[1:], f"vatmart bench {what}")
