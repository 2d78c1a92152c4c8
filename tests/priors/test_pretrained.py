"""What comes with the package loads, is small, and says nothing of the machine it was made on."""

from pathlib import Path

import numpy as np
import pytest

from vatmart_jax.errors import UserError
from vatmart_jax.pipeline.run_config import RunConfig
from vatmart_jax.priors.pretrained import names, run_folder
from vatmart_jax.priors.priors import Priors


@pytest.mark.parametrize("name", names())
def test_pretrained_priors_load_by_name_and_predict(name: str) -> None:
    folder = run_folder(Path(name))
    config = RunConfig.load(folder)
    assert config.data.kind == ("bundled" if name.startswith("generated-") else "external")
    assert sum(file.stat().st_size for file in folder.rglob("*")) < 20e6
    priors = Priors.load(folder)
    assert priors.config.task == config.task
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3))
    found = priors.predict(cloud, 0.3, n_proposals=4)
    assert found.trajectories.shape == (4, 30) and np.isfinite(found.trajectories).all()


def test_a_folder_goes_before_a_name_and_what_is_neither_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = Path(names()[0])
    assert run_folder(name).is_absolute()
    name.mkdir()
    assert run_folder(name) == name
    with pytest.raises(UserError, match=rf"no such run folder, nor pretrained priors \(.*{name}"):
        run_folder(Path("push-lid"))
