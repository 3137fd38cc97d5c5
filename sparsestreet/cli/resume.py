"""Going on with a run: its own configuration, its own folder, exactly where it stopped."""

from pathlib import Path

import yaml

from sparsestreet.cli.compose import load_run_config, quoted, value_of
from sparsestreet.records.branch_of import moment_of
from sparsestreet.safe_yaml import read_yaml


def resumed_overrides(arguments: list[str]) -> list[str]:
    """The overrides of the run that ``resume=RUN`` (or one of its checkpoints) names, then those that were given.

    An option that is given again counts as it is given now. The run's folder is gone on in, unless ``out=`` names
    another, or the checkpoint is one that was kept before a moment: a branch has a folder of its own. Without
    ``resume=`` they are as given.
    Raises FileNotFoundError where no run is at that place, ValueError in a sweep.
    """
    given = next((value_of(text) for text in arguments if text.startswith("resume=")), "null")
    if given in ("null", "None", ""):
        return arguments
    if {"-m", "--multirun"} & set(arguments):
        raise ValueError("a sweep cannot go on with one run: leave out -m or resume")
    run = run_of(Path(given))
    load_run_config(run)  # says what a run's folder is, where this is none
    if not has_checkpoint(run):
        raise FileNotFoundError(
            f"resume={given}: it was ended before its first checkpoint (checkpoint_every=...): start it again with "
            f"its own options and out={run}"
        )
    overrides = read_yaml(run / ".hydra" / "overrides.yaml", yaml.safe_load)
    if not isinstance(overrides, list):
        raise ValueError(f"{run}/.hydra/overrides.yaml is damaged: it holds no list of options")
    own = {"resume", "out", "overwrite", *(_key_of(text) for text in arguments)}
    kept = [text for text in map(str, overrides) if _key_of(text) not in own]
    branches = moment_of(Path(given)) is not None
    folder = [] if branches or any(text.startswith("out=") for text in arguments) else [f"out={quoted(str(run))}"]
    return [*kept, *arguments, *folder]


def _key_of(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")


def run_of(path: Path) -> Path:
    """The folder of a run, given as it is or by one of its checkpoints."""
    if not path.exists():
        raise FileNotFoundError(f"resume={path}: there is nothing; give a run's folder or one of its checkpoints")
    return path if path.is_dir() else path.resolve().parents[1]


def has_checkpoint(run: Path) -> bool:
    """Whether a run has one that is whole."""
    return any((run / "checkpoints").glob("[!.]*.ckpt"))
