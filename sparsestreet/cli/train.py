"""``sparsestreet train``: compose, assemble, fit, evaluate, record."""

import logging
import sys
import warnings
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Callback, Trainer, seed_everything
from omegaconf import DictConfig

from sparsestreet.cli.assemble import assemble, evaluate_assembly
from sparsestreet.cli.compose import CONF, override_problem
from sparsestreet.training.callbacks import Checkpoints, Clock, TrainingProgress

log = logging.getLogger(__name__)


def train(arguments: list[str]) -> int:
    """Run the Hydra app on these overrides; 2 if they name an unknown key."""
    problem = override_problem(arguments) if "--help" not in arguments else None
    if problem:
        print(f"sparsestreet train: {problem}", file=sys.stderr)
        return 2
    sys.argv = ["sparsestreet train", *arguments]
    app()
    return 0


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def app(cfg: DictConfig) -> float:
    """One training with its evaluation; returns the held-out full-image PSNR, for sweepers."""
    out = Path(HydraConfig.get().runtime.output_dir)
    seed_everything(cfg.seed, verbose=False)
    silence_known_noise()
    parts = assemble(cfg)
    clock = Clock()
    trainer = build_trainer(cfg, clock, out)
    # A checkpoint holds the state of callbacks and optimizer as well, so it is no file of weights only.
    resume_options = {"ckpt_path": cfg.resume, "weights_only": False} if cfg.resume else {}
    trainer.fit(parts.system, datamodule=parts.datamodule, **resume_options)
    if trainer.fast_dev_run:
        log.info("fast_dev_run: stopped after %d steps without evaluation", trainer.global_step)
        return 0.0
    summary = evaluate_assembly(parts, cfg, out, training_seconds=clock.seconds)
    log.info("records and pictures in %s", out)
    return summary.quality["psnr_full"].mean if summary else 0.0


def build_trainer(cfg: DictConfig, clock: Clock, out: Path) -> Trainer:
    callbacks: list[Callback] = list(instantiate(cfg.callback, _convert_="all").values())
    standing = [TrainingProgress(), Checkpoints(out / "checkpoints")]
    logger = instantiate(cfg.logger) if cfg.logger else False
    return instantiate(
        cfg.trainer,
        callbacks=[clock, *callbacks, *standing],
        logger=logger,
        default_root_dir=str(out),
        enable_model_summary=False,
        enable_progress_bar=False,
        enable_checkpointing=False,
        max_epochs=-1,
    )


def silence_known_noise() -> None:
    """Hints of Lightning that do not apply: frames are already in memory, a loader process would copy them."""
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
