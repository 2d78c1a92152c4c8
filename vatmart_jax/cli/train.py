"""`vatmart train`."""

# No postponed annotations: tyro reads those of a dataclass that only `command` sees.
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from vatmart_jax.cli.common import JsonFlag, Output, peek, physics_impl, prepare_jax, run_command
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import TASKS
from vatmart_jax.errors import UserError, require_one_of
from vatmart_jax.pipeline.presets import PRESETS, default_preset
from vatmart_jax.pipeline.run_config import DataSource, RunConfig
from vatmart_jax.pipeline.run_dir import check_folder
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.reporting import ConsoleReporter
from vatmart_jax.workflows.prepare import prepare
from vatmart_jax.workflows.train import train


def main(argv: list[str]) -> None:
    """Run the command. The preset and whether there is data decide the other flags' defaults."""
    chosen = peek(argv, "--preset") or default_preset(peek(argv, "--data") is not None)
    require_one_of("--preset", chosen, PRESETS)
    run_command(command(chosen), argv, "vatmart train")


def command(chosen: str) -> type[Any]:
    """The command's flags, where a preset is chosen."""

    @dataclass(frozen=True)
    class Train:
        """Train priors for one task: exploration, perception, curiosity, finetuning, evaluation, pictures.

        Rerunning the same command resumes an interrupted run.
        """

        task: str
        """push-door, pull-door, push-drawer, pull-drawer, push-lid or pull-lid"""
        out: Path
        """run folder"""
        data: Path | None = None
        """a folder of objects, or what `vatmart convert` made of it; default the bundled objects"""
        more_data: tuple[Path, ...] = ()
        """further folders such as those of `vatmart generate`, whose training splits are trained on too"""
        preset: str = chosen
        """quick, cpu, gpu or paper; the flags below start from it; default quick for the bundled objects, and with
        --data gpu on a GPU, else cpu"""
        impl: str | None = None
        """physics: c, warp or jax; default warp on an NVIDIA GPU, else c"""
        seed: int = 0
        json: JsonFlag = False
        settings: Annotated[Settings, arg(name="")] = field(default_factory=lambda: PRESETS[chosen])

        def run(self) -> Output:
            require_one_of("--task", self.task, TASKS)
            if self.more_data and self.data is None:
                raise UserError("--more-data without --data: name what it adds to")
            prepare_jax()
            config = RunConfig(
                task=self.task,
                data=DataSource.of(self.data),
                more_data=tuple(str(folder.resolve()) for folder in self.more_data),
                preset=self.preset,
                impl=physics_impl(self.impl),
                seed=self.seed,
                settings=self.settings,
            )
            check_folder(self.out, config.to_json())
            with ConsoleReporter() as reporter:
                points = self.settings.perception.networks.encoder.n_points
                folders = (self.data, *self.more_data)
                data = Data(*(prepare(folder, num_points=points, reporter=reporter) for folder in folders))
                return Output(*train(config, data, self.out, reporter))

    return Train
