"""Going on with a run: its own configuration, its own folder, exactly where it stopped."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra import compose
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.config.compose import configuration, load_run_config, quoted, value_of, without_flags
from sparsestreet.cli.config.targets import check_modules, check_places, check_received, leaves
from sparsestreet.files import read_yaml
from sparsestreet.naming import checkpoint_fraction

_PASSING = {"overrides", "runtime", "sweeper", "sweep"}
"""Keys of hydra's own configuration that follow from the words, or act in sweeps alone."""


def resumed_overrides(arguments: list[str], parts: Sequence[str] = ()) -> list[str]:
    """The overrides of the run that ``resume=RUN`` (or one of its checkpoints) names, then those that were given.

    An option that is given again counts as it is given now. The run's folder is gone on in, unless ``out=`` names
    another, or the checkpoint is one that was kept before a moment: a branch has a folder of its own. Without
    ``resume=`` they are as given.

    The run's own may come from anybody: what they name beyond conf/ must lie in ``parts``, modules that the user's own
    command trusts, or be said in this command.

    Raises FileNotFoundError where no run is at that place, ValueError in a sweep, and for what is not to be trusted.
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
    source = run / ".hydra" / "overrides.yaml"
    overrides = read_yaml(source, yaml.safe_load)
    if not isinstance(overrides, list):
        raise ValueError(f"{source} is damaged: it holds no list of options")
    own = {"resume", "out", "overwrite", *(_key_of(text) for text in arguments)}
    kept = [text for text in map(str, overrides) if _key_of(text) not in own]
    branches = checkpoint_fraction(Path(given)) is not None
    folder = [] if branches or any(text.startswith("out=") for text in arguments) else [f"out={quoted(str(run))}"]
    _check_words(kept, without_flags([*arguments, *folder]), source, parts)
    return [*kept, *arguments, *folder]


def _check_words(received: list[str], typed: list[str], source: Path, parts: Sequence[str]) -> None:
    """Raises ValueError where words that came with a run choose what only the user's own may."""
    check_modules(parts)
    for text in received:
        if text.startswith("-") or "hydra" in text.partition("=")[0] or _key_of(text) == "folder":
            raise ValueError(
                f"{source} has {text[:100]!r}: a run that was received chooses no flag, no folder and nothing of "
                "Hydra's; take it out, and say it in this command if it is yours"
            )
    try:
        merged = _raw([*received, *typed])
    except (HydraException, OmegaConfBaseException, ValueError):
        return  # nothing is made of words that do not compose; ``override_problem`` says why
    plain = _own([*typed])
    hydra, own = merged.pop("hydra"), plain.pop("hydra")
    for one in (hydra, own):
        one["job"].pop("override_dirname", None)  # which follows from the words
    if changed := [key for key in hydra.keys() - _PASSING if hydra[key] != own.get(key)]:
        raise ValueError(f"{source} changes hydra.{changed[0]}, which a run that was received does not choose")
    said = frozenset((place, repr(value)) for place, value in leaves(plain))
    check_received(merged, source, parts, said)
    check_places(merged, source, said)


def _own(typed: list[str]) -> dict[str, Any]:
    """The configuration of the user's words alone; of those of Hydra's, where the others need the run's."""
    for words in (typed, [text for text in typed if text.startswith("hydra")]):
        try:
            return _raw(words)
        except (HydraException, OmegaConfBaseException, ValueError):
            continue
    return _raw([])


def _raw(words: list[str]) -> dict[str, Any]:
    """As plain values, interpolations as they are written."""
    with configuration():
        cfg: Any = OmegaConf.to_container(compose("train", words, return_hydra_config=True))
    return cfg


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
