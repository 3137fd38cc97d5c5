"""Where the configuration lies, its strict root, and errors that name the key that was probably meant."""

import difflib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException, OverrideParseException
from omegaconf import MISSING, DictConfig, OmegaConf

PACKAGE = Path(__file__).resolve().parents[1]
# An installed wheel carries conf/ inside the package; a checkout has it beside the package.
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"


@dataclass
class TrainSchema:
    """Every root key of conf/train.yaml: any other is an error, with ``+`` as well."""

    name: str = MISSING
    seed: int = MISSING
    split: Any = MISSING
    resume: Any = None
    data: Any = MISSING
    scale: Any = MISSING
    schedule: Any = MISSING
    node: Any = MISSING
    sky: Any = None
    loss: Any = MISSING
    callback: Any = MISSING
    optimization: Any = MISSING
    render: Any = MISSING
    trainer: Any = MISSING
    logger: Any = None


ConfigStore.instance().store(name="train_schema", node=TrainSchema)


def override_problem(overrides: list[str], config_name: str = "train") -> str | None:
    """One line on what is wrong with the overrides, naming the nearest key; None if they compose."""
    keyed = [text for before, text in zip(["", *overrides], overrides, strict=False) if not _is_flag(before, text)]
    for text in keyed:
        # Every key has its place in conf/, so an added one is a slip that Hydra would let pass.
        if text.startswith("+") and not text.startswith(("++", "+hydra")):
            with initialize_config_dir(str(CONF), version_base="1.3"):
                return _explain(f"Key '{text.lstrip('+').partition('=')[0]}' not in the schema", [text], config_name)
    # A sweep (a=1,2) composes for no single job; Hydra's sweeper splits it first.
    single = [text for text in keyed if "," not in text.partition("=")[2] or text.partition("=")[2][:1] in "[{'\""]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        try:
            compose(config_name, single)
        except OverrideParseException as error:
            return f"{error.override!r} is no override: write key=value"
        except ConfigCompositionException as error:
            return _explain(str(error.__cause__ or error).splitlines()[0], single, config_name)
    return None


def _is_flag(before: str, text: str) -> bool:
    """A flag of Hydra's, or the word after it (``--cfg job``)."""
    return text.startswith("-") or (before.startswith("-") and "=" not in text)


def _explain(reason: str, overrides: list[str], config_name: str) -> str:
    """Hydra's reason with the whole key and the key or option that was probably meant."""
    option = re.search(r"Could not find '([^']+)/([^/']+)'", reason)
    if option:
        choices = sorted(path.stem for path in (CONF / option[1]).glob("*.yaml"))
        return f"no option {option[2]!r} in conf/{option[1]}: choose one of {', '.join(choices)}"
    unknown = re.search(r"[Kk]ey '([^']+)' is not in struct|Key '([^']+)' not in|Could not override '([^']+)'", reason)
    if not unknown:
        return reason
    part = next(group for group in unknown.groups() if group)
    given = [text.partition("=")[0].lstrip("+~") for text in overrides]
    key = next((name for name in given if part in name.split(".") or name == part), part)
    known = _keys(OmegaConf.to_container(compose(config_name), resolve=False))
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f"no key {key!r}" + (f"; did you mean {close[0]!r}?" if close else "")


def _keys(tree: object, prefix: str = "") -> list[str]:
    if not isinstance(tree, dict):
        return []
    keys = []
    for name, value in tree.items():
        keys.append(f"{prefix}{name}")
        keys += _keys(value, f"{prefix}{name}.")
    return keys


def load_run_config(run: Path) -> DictConfig:
    """The resolved configuration that a run wrote. Raises FileNotFoundError naming what a run folder holds."""
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{run} is no run: it has no .hydra/config.yaml; give a folder that train wrote")
    return OmegaConf.load(path)
