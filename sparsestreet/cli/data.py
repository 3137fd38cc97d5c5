"""``sparsestreet data check`` and ``sparsestreet data make``."""

import sys

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig

from sparsestreet.cli.compose import CONF, override_problem

USAGE = """\
sparsestreet data check data.root=DIR     print everything that is wrong with a log (exit status 1), or its summary
sparsestreet data make [seed=N] [data.log.settings.width=W ...]     write a synthetic street; prints where it lies
"""


def data(arguments: list[str]) -> int:
    """Run the sub-command; 2 on wrong usage."""
    verb, overrides = (arguments[0], arguments[1:]) if arguments else ("", [])
    if verb not in ("check", "make") or "--help" in overrides:
        print(USAGE)
        return 0 if arguments and (verb in ("-h", "--help") or "--help" in overrides) else 2
    if verb == "check" and not any(text.startswith("data=") for text in overrides):
        overrides = ["data=drivestudio", *overrides]
    problem = override_problem(overrides)
    if problem:
        print(f"sparsestreet data {verb}: {problem}", file=sys.stderr)
        return 2
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides)
    return _check(cfg) if verb == "check" else _make(cfg)


def _check(cfg: DictConfig) -> int:
    from sparsestreet.data.check import report_problems

    return report_problems(cfg.data.log.root)


def _make(cfg: DictConfig) -> int:
    log = instantiate(cfg.data.log, _convert_="all")
    print(f"{cfg.data.log.root}: {log.num_frames} frames of {log.num_cameras} cameras")
    return 0
