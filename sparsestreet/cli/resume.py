"""Going on with a run: its own configuration, its own folder, exactly where it stopped."""

from pathlib import Path
from typing import Any

import yaml

from sparsestreet.cli.compose import load_run_config, resolved
from sparsestreet.records.configuration import IDENTITY_KEYS, flat_config, without
from sparsestreet.safe_yaml import read_yaml


def resumed_overrides(arguments: list[str]) -> list[str]:
    """The overrides of the run that ``resume=RUN`` (or one of its checkpoints) names, then those that were given.

    The run's folder is gone on in, unless ``out=`` names another. Without ``resume=`` they are as given.
    Raises FileNotFoundError where no run is at that place, ValueError in a sweep.
    """
    given = next((text.partition("=")[2] for text in arguments if text.startswith("resume=")), "null")
    if given in ("null", ""):
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
    kept = [text for text in map(str, overrides) if not text.startswith(("resume=", "out=", "overwrite="))]
    folder = [] if any(text.startswith("out=") for text in arguments) else [f"out={run}"]
    return [*kept, *arguments, *folder]


def run_of(path: Path) -> Path:
    """The folder of a run, given as it is or by one of its checkpoints."""
    if not path.exists():
        raise FileNotFoundError(f"resume={path}: there is nothing; give a run's folder or one of its checkpoints")
    return path if path.is_dir() else path.resolve().parents[1]


def has_checkpoint(run: Path) -> bool:
    """Whether a run has one that is whole."""
    return any((run / "checkpoints").glob("[!.]*.ckpt"))


def check_resumed(config: dict[str, Any], run: Path) -> None:
    """Raises ValueError, naming the options, where a run would go on with another configuration than its own."""
    before = flat_config(resolved(load_run_config(run)))
    now = flat_config(config)
    old, new = (without(flat, (*IDENTITY_KEYS, "trainer.*")) for flat in (before, now))
    changed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
    if before.get("seed") != now["seed"]:
        changed.insert(0, "seed")
    if changed:
        said = ", ".join(f"{key} ({old.get(key, before.get(key))} before)" for key in changed[:3])
        raise ValueError(f"a run goes on as it began, but {len(changed)} options differ: {said}; start a new run")
