"""From a config to the objects of a run; training and evaluation assemble the same."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation.history import draw_history
from sparsestreet.evaluation.records import RunDescription, RunSummary
from sparsestreet.evaluation.run import evaluate_run
from sparsestreet.ops import guards
from sparsestreet.scene.build import build_scene
from sparsestreet.scene.centers import node_legend, project_centers
from sparsestreet.scene.rendering import render
from sparsestreet.training.system import StreetSystem


@dataclass(frozen=True)
class Assembly:
    log: DrivingLog
    datamodule: StreetData
    system: StreetSystem


def assemble(cfg: DictConfig) -> Assembly:
    """Read the log, split it, seed the scene and wrap it for training."""
    log = instantiate(cfg.data.log, _convert_="all").read()
    datamodule = StreetData(log, stride=cfg.split.stride, offset=cfg.split.offset, seed=cfg.seed)
    split = datamodule.split
    scene = build_scene(
        log,
        split.train,
        split.held_out_indices,
        instantiate(cfg.node, _convert_="all"),
        instantiate(cfg.sky, _convert_="all") if cfg.sky else None,
        cfg.seed,
    )
    system = StreetSystem(
        scene,
        instantiate(cfg.loss, _convert_="all"),
        instantiate(cfg.optimizer, _convert_="all"),
        radius=log.radius,
        options=instantiate(cfg.render, _convert_="all"),
        sh_interval=cfg.schedule.sh_interval,
    )
    return Assembly(log, datamodule, system)


@torch.no_grad()
def evaluate_assembly(parts: Assembly, cfg: DictConfig, out: Path, training_seconds: float | None) -> RunSummary | None:
    """Records and pictures of the held-out frames under ``out``; None where the split holds out nothing."""
    held_out = parts.datamodule.split.held_out
    if not held_out:
        return None
    system, scene = parts.system.cpu().eval(), parts.system.scene
    summary = evaluate_run(
        held_out,
        render=lambda frame: render(scene, frame, options=system.options),
        centers=lambda frame: project_centers(scene, frame),
        guards=lambda frame: guards(
            scene.gaussians_at(frame).gaussians, frame.camera, settings=system.options.settings
        ),
        gaussians=scene.counts(),
        bytes_by_part=scene.bytes_by_part(),
        run=RunDescription(
            method=cfg.name,
            scene=parts.log.name,
            seed=cfg.seed,
            split=f"every {cfg.split.stride}th frame from {cfg.split.offset}",
            training_seconds=training_seconds,
            command=shlex.join(["sparsestreet", *sys.argv[0].split()[1:], *sys.argv[1:]]),
        ),
        out=out,
        legend=node_legend(scene.counts()),
    )
    draw_history(out)
    return summary
