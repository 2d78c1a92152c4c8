"""`vatmart play`."""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from vatmart_jax.cli.common import JsonFlag, prepare_jax
from vatmart_jax.errors import OpenGLError, UserError, require_one_of


@dataclass(frozen=True)
class Play:
    """Show one trial: the scripted expert's, what a run's priors propose, or a trajectory from a file."""

    scene: Positional[str]
    """object id, id:part, or index into the data's Scenes"""
    data: Path | None = None
    """a folder of objects, or what `vatmart convert` made of it; default the run's data, or the bundled objects"""
    task: str | None = None
    """default the run's, or to push"""
    amount: float | None = None
    """how far to move the part, rad or unit lengths; default random"""
    run_: Annotated[Path | None, arg(name="run")] = None
    """a run folder of `vatmart train`, or the name of pretrained priors: their best proposal"""
    trajectory: Path | None = None
    """a .npy file of 30 numbers: 6D rotation of the start pose, then four residual waypoints"""
    contact: tuple[float, float, float] | None = None
    """with --trajectory: touch the part nearest to this point; default a random one"""
    out: Path = Path("play.gif")
    viewer: bool = False
    """MuJoCo's viewer instead of a picture"""
    seed: int = 0
    json: JsonFlag = False

    def run(self) -> dict[str, Any]:
        if self.run_ and self.trajectory:
            raise UserError("--run and --trajectory: give one of them")
        _choose_opengl(self.viewer)
        from vatmart_jax.envs import TASKS
        from vatmart_jax.viz.trial_video import animate, play, show

        if self.task is not None:
            require_one_of("--task", self.task, TASKS)
        prepare_jax()
        folder, run = self._folders()
        recording, result = play(
            folder,
            self.scene,
            task=self.task,
            amount=self.amount,
            trajectory=self.trajectory,
            contact=self.contact,
            run=run,
            seed=self.seed,
        )
        if self.viewer:
            show(recording)
            return result
        animate(recording, self.out)
        return {**result, "file": str(self.out)}

    def _folders(self) -> tuple[Path, Path | None]:
        """Of the data and of the run."""
        from vatmart_jax.pipeline.run_config import RunConfig
        from vatmart_jax.priors.pretrained import run_folder
        from vatmart_jax.reporting import ConsoleReporter
        from vatmart_jax.workflows.prepare import prepare, prepare_source

        with ConsoleReporter() as reporter:
            if self.run_ is None:
                return prepare(self.data, reporter=reporter), None
            run = run_folder(self.run_)
            if self.data is not None:
                return prepare(self.data, reporter=reporter), run
            return prepare_source(RunConfig.load(run).data, where=str(self.run_), reporter=reporter), run


def _choose_opengl(viewer: bool) -> None:
    """Before MuJoCo is imported, which reads the variable then. Raises OpenGLError where there is none."""
    if sys.platform == "linux" and not viewer:
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "osmesa")
    try:
        import mujoco  # noqa: F401
    except (ImportError, AttributeError) as e:  # what PyOpenGL raises where the library is missing
        raise OpenGLError from e
