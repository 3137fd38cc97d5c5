"""conf/layout says what the writers take by themselves."""

from pathlib import Path

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from sparsestreet.data.kitti import KittiWriter
from sparsestreet.data.nuscenes import NuScenesWriter
from sparsestreet.data.pandaset import PandaSetWriter

CONF = Path(__file__).resolve().parents[2] / "conf" / "layout"


@pytest.mark.parametrize("name", ["nuscenes", "kitti", "pandaset"])
def test_a_file_has_the_settings_of_its_writer(name):
    config = {str(key): value for key, value in OmegaConf.load(CONF / f"{name}.yaml").items()}
    writer = get_class(str(config.pop("_target_")))
    assert config == vars(writer())


@pytest.mark.parametrize(
    ("writer", "message"),
    [
        (lambda: NuScenesWriter(jpeg_quality=0), "jpeg_quality lies in 1 to 100, got 0"),
        (lambda: NuScenesWriter(version="samples"), "version is a folder whose name starts with v, got 'samples'"),
        (lambda: NuScenesWriter(version="../v1.0"), "version is a folder"),
        (lambda: KittiWriter(drive=10000), "drive has four digits, got 10000"),
        (lambda: PandaSetWriter(scene=1000), "scene has three digits, got 1000"),
        (lambda: PandaSetWriter(jpeg_quality=101), "jpeg_quality lies in 1 to 100, got 101"),
    ],
)
def test_a_setting_that_no_layout_has_is_an_error(writer, message):
    with pytest.raises(ValueError, match=message):
        writer()
