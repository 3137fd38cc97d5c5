"""conf/layout says what the writers take by themselves."""

from pathlib import Path

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

CONF = Path(__file__).resolve().parents[2] / "conf" / "layout"


@pytest.mark.parametrize("name", ["nuscenes", "kitti", "pandaset"])
def test_a_file_has_the_settings_of_its_writer(name):
    config = dict(OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml")))  # pyright: ignore
    writer = get_class(str(config.pop("_target_")))
    assert config == vars(writer())
