"""What can be said of a configuration before torch is imported: limits of numbers, and packages that are missing."""

from importlib.util import find_spec

from omegaconf import DictConfig, OmegaConf

WHOLE_NUMBERS: dict[str, tuple[int, int | None]] = {
    # What numpy's and Lightning's generators take.
    "seed": (0, 2**32 - 1),
    "schedule.max_steps": (1, None),
    "checkpoint_every": (1, None),
    "split.stride": (0, None),
    "split.offset": (0, None),
}
"""Key -> its least and its largest value; None: no limit."""

LOGGER_PACKAGES = {"TensorBoardLogger": ("tensorboard", "tensorboardX"), "WandbLogger": ("wandb",)}
"""Class of a logger -> packages of which it needs one; the first is the name of our extra."""


def limit_problem(cfg: DictConfig) -> str | None:
    """The first number out of its limits, number of steps that is given twice or package that is missing, in a line."""
    for key, (least, most) in WHOLE_NUMBERS.items():
        value = OmegaConf.select(cfg, key)
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or value < least or (most is not None and value > most):
            limits = f"{least} or more" if most is None else f"{least} to {most}"
            return f"{key} must be a whole number, {limits}, got {value!r}"
    for moment in cfg.get("branch_points") or ():
        if not 0 < moment < 1:
            return f"branch_points are fractions of the run, above 0 and below 1, got {moment!r}"
    return _two_lengths(cfg) or _missing_package(cfg)


def _two_lengths(cfg: DictConfig) -> str | None:
    """Milestones, rates and records speak of fractions of the schedule: a run of another length is none of it."""
    trained, scheduled = OmegaConf.select(cfg, "trainer.max_steps"), cfg.schedule.max_steps
    if trained == scheduled:
        return None
    return (
        f"trainer.max_steps={trained} would train another length than the schedule of {scheduled:,} steps says: "
        f"give schedule.max_steps={trained}, or trainer.fast_dev_run={trained} to try a few of its steps"
    )


def _missing_package(cfg: DictConfig) -> str | None:
    name = str(cfg.logger.get("_target_", "")).rpartition(".")[2] if cfg.logger else ""
    packages = LOGGER_PACKAGES.get(name, ())
    if not packages or any(find_spec(package) for package in packages):
        return None
    return f"the logger {name} needs a package: pip install 'sparsestreet[{packages[0]}]', or choose logger=csv"
