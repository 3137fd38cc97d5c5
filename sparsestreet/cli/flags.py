"""Hydra's flags of ``sparsestreet train``: which there are, which show a configuration, what is wrong with them."""

from collections.abc import Iterable, Sequence

from sparsestreet.cli.problems import override_problem

SHOWS = {"--cfg", "-c", "--info", "-i"}
"""Flags that print the configuration, and train nothing."""
SWEEPS = {"--multirun", "-m"}
_OF_SHOWN = {"--resolve": "--cfg job --resolve", "--package": "--cfg job --package loss", "-p": "--cfg job -p loss"}
"""What these flags change is a printed configuration."""
_OTHERS = "--help -h --hydra-help --version --run -r --shell-completion -sc --config-path -cp --config-name -cn"
HYDRA = {*SHOWS, *SWEEPS, *_OF_SHOWN, *_OTHERS.split(), "--config-dir", "-cd"}
"""Without ``--experimental-rerun``, which opens a pickle of a run and runs whatever it holds."""


def flags_of(arguments: Iterable[str]) -> set[str]:
    """The flags without their values (``--cfg=job``)."""
    return {text.partition("=")[0] for text in arguments if text.startswith("-")}


def flag_problem(arguments: Sequence[str]) -> str | None:
    """One line on a flag that is none of Hydra's, or has no place beside the others; None where there is none."""
    flags = flags_of(arguments)
    unknown = next((text.partition("=")[0] for text in arguments if text.partition("=")[0] in flags - HYDRA), None)
    if unknown:
        key = unknown.lstrip("-")
        return f"{unknown} is no flag: write {key}=VALUE" if (why := _no_key(key)) is None else f"{unknown} is {why}"
    if flags & SHOWS and flags & SWEEPS:
        return "--cfg and --info show one configuration: leave out -m"
    alone = next((flag for flag in _OF_SHOWN if flag in flags and not flags & {"--cfg", "-c"}), None)
    return f"{alone} changes what --cfg prints: write {_OF_SHOWN[alone]}" if alone else None


def _no_key(key: str) -> str | None:
    """Why an option of this name does not exist; None for one of conf/."""
    problem = override_problem([f"{key}=0"])
    return f"no flag, and there is {problem}" if problem and problem.startswith("no key") else None
