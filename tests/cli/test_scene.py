"""What a command imports before it opens the scene of a run."""

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sparsestreet.cli.scene import import_parts


@pytest.mark.parametrize(
    "where",
    ["node.kite", "node.background.density", "node.background.sources.kites", "node.background.mask", "effects.haze"],
)
def test_every_part_from_outside_is_imported(where: str, tmp_path: Path, monkeypatch):
    """A scene file holds the settings of nodes and effects, and what is set within them."""
    name = f"outside_{where.rpartition('.')[2]}"
    (tmp_path / f"{name}.py").write_text("class Settings: ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    config = OmegaConf.create({"node": {"background": {"_target_": "sparsestreet.scene.nodes.BackgroundSettings"}}})
    OmegaConf.update(config, f"{where}._target_", f"{name}.Settings")
    (tmp_path / ".hydra").mkdir()
    OmegaConf.save(config, tmp_path / ".hydra" / "config.yaml")
    import_parts(tmp_path)
    assert sys.modules.pop(name).Settings
