"""From a config to the objects of a run; training and evaluation assemble the same."""

from dataclasses import dataclass
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation.run import evaluate_run
from sparsestreet.scene.build import build_scene
from sparsestreet.training.system import StreetSystem


@dataclass(frozen=True)
class Assembly:
    log: DrivingLog
    datamodule: StreetData
    system: StreetSystem


def assemble(cfg: DictConfig) -> Assembly:
    """Read the log, split it, seed the scene and wrap it for training."""
    log = instantiate(cfg.data.log, _convert_="all")
    datamodule = StreetData(log, stride=cfg.split.stride, offset=cfg.split.offset, seed=cfg.seed)
    split = datamodule.split
    scene = build_scene(
        log,
        split.train,
        frozenset(frame.index for frame in split.held_out),
        instantiate(cfg.node, _convert_="all"),
        instantiate(cfg.sky) if cfg.sky else None,
        cfg.seed,
    )
    system = StreetSystem(
        scene,
        instantiate(cfg.loss, _convert_="all"),
        instantiate(cfg.optimization, _convert_="all"),
        radius=log.radius,
        options=instantiate(cfg.render),
    )
    return Assembly(log, datamodule, system)
