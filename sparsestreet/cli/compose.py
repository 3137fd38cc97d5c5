"""Where the configuration lies, its strict root, and errors that name the key that was probably meant."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, OverrideParseException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import sparsestreet.cli.resolvers  # noqa: F401 - conf/ asks for them
from sparsestreet.cli.options import unknown_key

PACKAGE = Path(__file__).resolve().parents[1]
# An installed wheel carries conf/ inside the package; a checkout has it beside the package.
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"

ADDABLE = ("++", "+hydra", "+sweep")
"""What may be added: keys that are meant to be new, and sweeps."""


@dataclass
class TrainSchema:
    """Every root key of conf/train.yaml: any other is an error, with ``+`` as well."""

    name: str = MISSING
    seed: int = MISSING
    capacity: str = MISSING
    split: Any = MISSING
    resume: str | None = None
    count_of: str | None = None
    data: Any = MISSING
    schedule: Any = MISSING
    assignment: Any = MISSING
    method: Any = MISSING
    preset: Any = MISSING
    sparsify: Any = MISSING
    node: Any = MISSING
    effects: Any = None
    image_points: Any = None
    loss: Any = MISSING
    callback: Any = MISSING
    optimizer: Any = MISSING
    render: Any = MISSING
    trainer: Any = MISSING
    logger: Any = None
    evaluation: Any = MISSING
    out: str = MISSING
    folder: str = MISSING


ConfigStore.instance().store(name="train_schema", node=TrainSchema)


@contextmanager
def configuration() -> Iterator[None]:
    """Hydra knows where conf/ lies."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def override_problem(overrides: list[str], config_name: str = "train") -> str | None:
    """One line on what is wrong with the overrides, naming the nearest key; None if they compose."""
    keyed = [text for before, text in zip(["", *overrides], overrides, strict=False) if not _is_flag(before, text)]
    with configuration():
        for text in keyed:
            if "=" not in text and not text.startswith("~"):
                return f"{text!r} is no override: write key=value"
            # Every key has its place in conf/, so an added one is a slip that Hydra would let pass.
            if text.startswith("+") and not text.startswith(ADDABLE):
                return unknown_key(text.lstrip("+").partition("=")[0], _known(config_name))
        # A sweep (a=1,2) composes for no single job; Hydra's sweeper splits it first.
        single = [text for text in keyed if "," not in text.partition("=")[2] or text.partition("=")[2][:1] in "[{'\""]
        try:
            cfg = compose(config_name, single)
        except OverrideParseException as error:
            return f"{error.override!r} cannot be read: put a value with special characters in quotes, key='a=b'"
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            cause = error.__cause__ or error
            key = getattr(cause, "full_key", None)
            reason = str(cause).splitlines()[0]
            return _explain(f"{key}: {reason}" if key and key not in reason else reason, single, config_name)
    return _masks_that_are_off(single, cfg)


def _is_flag(before: str, text: str) -> bool:
    """A flag of Hydra's, or the word after it (``--cfg job``)."""
    return text.startswith("-") or (before.startswith("-") and "=" not in text)


def _masks_that_are_off(overrides: list[str], cfg: DictConfig) -> str | None:
    """A mask's option has no effect where masks are not trained: it must not pass in silence."""
    if cfg.sparsify.masks:
        return None
    for text in overrides:
        key = text.partition("=")[0]
        if re.match(r"(node\.\w+\.mask\.|schedule\.(mask_learning_rate|lambda_m))", key):
            return f"{key} has no effect with sparsify={cfg.sparsify.name}: choose sparsify=masks, paper or removal"
    return None


def _explain(reason: str, overrides: list[str], config_name: str) -> str:
    """Hydra's reason with the whole key and the key or option that was probably meant."""
    if "Got NoneType" in reason:
        group = next((key for key, _, value in (text.partition("=") for text in overrides) if value == "null"), "")
        return f"no option null in conf/{group}: choose one of {', '.join(_options(group))}"
    option = re.search(r"Could not find '([^']+)/([^/']+)'|Could not load '([^']+)/([^/']+)'", reason)
    if option:
        group, name = (part for part in option.groups() if part)
        if group == "hydra/launcher":
            package = name.partition("_")[0]
            return f"no launcher {name!r} is installed: pip install hydra-{package}-launcher, or leave it out"
        return f"no option {name!r} in conf/{group}: choose one of {', '.join(_options(group))}"
    unknown = re.search(r"[Kk]ey '([^']+)' is not in struct|Key '([^']+)' not in|Could not override '([^']+)'", reason)
    if not unknown:
        return reason
    part = next(group for group in unknown.groups() if group)
    given = [text.partition("=")[0].lstrip("+~") for text in overrides]
    key = next((name for name in given if part in name.split(".") or name == part), part)
    if key in _known(config_name):
        return f"no key {key!r} with these choices: leave it out, or choose the option that has it"
    return unknown_key(key, _known(config_name))


def _options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _known(config_name: str) -> list[str]:
    """Every key of the configuration as it stands without overrides, and every group."""
    groups = [str(path.relative_to(CONF)) for path in CONF.rglob("*") if path.is_dir()]
    return _keys(OmegaConf.to_container(compose(config_name), resolve=False)) + groups


def _keys(tree: object, prefix: str = "") -> list[str]:
    if not isinstance(tree, dict):
        return []
    keys = []
    for name, value in tree.items():
        keys.append(f"{prefix}{name}")
        keys += _keys(value, f"{prefix}{name}.")
    return keys


def load_run_config(run: Path) -> DictConfig:
    """The configuration that a run wrote, with the log where the run had it.

    Raises FileNotFoundError naming what a run folder holds.
    """
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{run} is no run: it has no .hydra/config.yaml; give a folder that train wrote")
    cfg = OmegaConf.load(path)
    # Written as an interpolation that only a running app can resolve; and runs may have been moved.
    cfg.folder = str(run)
    _find_log(cfg, run / ".hydra" / "hydra.yaml")
    return cfg


def _find_log(cfg: DictConfig, launch: Path) -> None:
    """Relative folders of the log are meant from where the run was started, as long as that is there."""
    started = Path(OmegaConf.load(launch).hydra.runtime.cwd) if launch.is_file() else Path()
    if started.is_dir():
        for key in ("data.root", "data.log.root", "data.log.parent"):
            folder = OmegaConf.select(cfg, key)
            if folder is not None:
                OmegaConf.update(cfg, key, str(started / folder))
