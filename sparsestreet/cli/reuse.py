"""What two sweeps share is trained once: a job takes the run that stands finished in another sweep's folder.

It takes files, not a link: each sweep's folder stays whole, wherever it is copied.
"""

import logging
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.compose import resolved
from sparsestreet.cli.folder import is_whole, same_run, take_folder
from sparsestreet.cli.resume import has_checkpoint
from sparsestreet.cli.targets import targets_of
from sparsestreet.records.configuration import Configuration, flat_config, only
from sparsestreet.records.costs import COSTS, update_costs
from sparsestreet.records.run import RUN, SAME_AS, RunDescription, SameAs
from sparsestreet.records.strict_json import RecordError
from sparsestreet.records.summary import SUMMARY

log = logging.getLogger(__name__)

_LARGE = ("scene.safetensors", "predictions")
"""Replaced as whole files whenever they change: two runs may share their bytes on the disk."""
_SMALL = ("views.json", "rig.json", "curves", "pictures", "records")


def finished_elsewhere(cfg: DictConfig, out: Path) -> Path | None:
    """The folder of this very run, finished, in a sweep beside this one; None where there is none, or none is wanted.

    One whose evaluation measured all that this job asks for comes first.
    """
    if not cfg.reuse or cfg.overwrite or cfg.resume or has_checkpoint(out):
        return None
    found = list(_same_runs(cfg, out, Path(HydraConfig.get().sweep.dir).absolute().parent))
    measured = (run for run, config in found if _measures(RUN.read(run).config, config))
    return next(measured, found[0][0] if found else None)


def take_finished(cfg: DictConfig, run: Path, out: Path) -> float | None:
    """Fill the folder of a job with a finished run; a full-image PSNR. What its evaluation lacks is measured.

    The record of what it took is the last that is written, as that of a training: what is killed before begins again.
    """
    log.info("%s holds this very run, finished: its files are taken (reuse=false trains it again)", run)
    summary, costs = SUMMARY.read(run), COSTS.read(run)
    take_folder(cfg, out, goes_on=False)
    for name in (*_LARGE, *_SMALL):
        _copy(run / name, out / name, os.link if name in _LARGE else shutil.copy2)
    config = _configured(cfg, summary.run)
    description = replace(summary.run, label=cfg.name, config=config)
    RUN.write(out, description)
    COSTS.write(out, replace(costs, wall_seconds=None))
    SUMMARY.write(out, replace(summary, run=description))
    taken = SameAs(run=os.path.relpath(run, out), label=summary.run.label, command=summary.run.command)
    SAME_AS.write(out, taken)
    if not _measures(summary.run.config, config):
        _measure(cfg, out)
    update_costs(out, wall_seconds=costs.wall_seconds)
    return SUMMARY.read(out).mean("psnr_full")


def _same_runs(cfg: DictConfig, out: Path, sweeps: Path) -> Iterator[tuple[Path, Configuration]]:
    """Finished runs of this configuration, seed and drive in the folders of sweeps, and what this job would record."""
    configured: dict[str, Configuration] = {}  # by the images that training saw: to resolve one takes a while
    for path in sorted(sweeps.glob(f"*/*/{RUN.name}")):
        run = path.parent
        try:
            description = RUN.read(run)
        except RecordError:
            continue  # of another version
        if description.seed != cfg.seed or description.steps < description.max_steps or run.samefile(out):
            continue
        images = str(description.config.get("training_views.images"))
        if images not in configured:
            configured[images] = _configured(cfg, description)
        config = configured[images]
        if same_run(description.config, config) and is_whole(run) and SUMMARY.exists(run):
            yield run, config


def _configured(cfg: DictConfig, run: RunDescription) -> Configuration:
    """The configuration of a job, as that of a run whose log it reads."""
    from sparsestreet.cli.assemble import with_images

    images = run.config.get("training_views.images")
    return flat_config(resolved(with_images(cfg, images) if isinstance(images, int) else cfg))


def _measures(config: Configuration, asked: Configuration) -> bool:
    """Whether a run's evaluation measured all that another one asks for."""
    wanted = {key: value for key, value in only(asked, ("evaluation.*",)).items() if value != []}
    return all(config.get(key) == value for key, value in wanted.items())


def _measure(cfg: DictConfig, out: Path) -> None:
    import torch

    from sparsestreet.cli.device import devices_of_job
    from sparsestreet.cli.evaluate import Options, measure

    with devices_of_job(cfg.trainer) as devices:
        if isinstance(devices, list):
            torch.cuda.set_device(devices[0])
        # Whatever it names is named by the words of this very sweep.
        measure(Options(run=out, parts=tuple({one for one in targets_of(OmegaConf.to_container(cfg)) if "." in one})))


def _copy(source: Path, to: Path, link: Callable[[str, str], object]) -> None:
    """A file, or a folder but for what says that a run is whole; bytes are shared where ``link`` and the disk can."""

    def one(source: str, to: str) -> str:
        try:
            link(source, to)
        except OSError:  # another disk, or one without links
            shutil.copy2(source, to)
        return to

    if source.is_dir():
        last = (Path(file.name).name for file in (SUMMARY, COSTS))
        shutil.copytree(source, to, copy_function=one, ignore=shutil.ignore_patterns(*last))
    elif source.is_file():
        one(str(source), str(to))
