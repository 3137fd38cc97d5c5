"""Where the configuration lies, its strict root, and errors that name the key that was probably meant."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

import sparsestreet.cli.resolvers  # noqa: F401 - conf/ asks for them
from sparsestreet.cli.limits import limit_problem
from sparsestreet.files import read_yaml
from sparsestreet.naming import nearest

PACKAGE = Path(__file__).resolve().parents[1]
# An installed wheel carries conf/ inside the package; a checkout has it beside the package.
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"

WORDS = {
    **dict.fromkeys(("steps", "iterations", "iters", "num_iterations", "epochs"), "schedule.max_steps"),
    **dict.fromkeys(("lr", "learning_rate", "learning_rates"), "schedule.rates"),
    **dict.fromkeys(("device", "gpu", "accelerator"), "trainer"),
}
"""Words of the field -> our key."""
MOVED = {"data.log.min_lens_shift": "effects.lens.min_shift"}
"""Keys of earlier versions -> where their value belongs now."""
PATHS = {
    *("out", "resume", "count_of", "data.root", "data.log.root", "data.log.parent", "image_points.cache"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}
"""Keys whose value is a path, in whatever letters."""
SHORT = 4
"""Letters of a word below which another word is like it by chance (lr, logger)."""
FEW_PLACES = 6
"""Keys that a slip still names."""

ADDABLE = ("++", "+hydra", "+sweep")
"""What may be added: keys that are meant to be new, and sweeps."""

Tree = dict[str, Any]
"""Keys below a key: a word in their place (``render=fast``) is an error."""


@dataclass
class TrainSchema:
    """Every root key of conf/train.yaml: any other is an error, with ``+`` as well."""

    name: str = MISSING
    seed: Any = MISSING
    capacity: str = MISSING
    split: Tree = MISSING
    training_views: Tree = MISSING
    budget: Tree = MISSING
    resume: str | None = None
    overwrite: bool = False
    reuse: bool = True
    checkpoint_every: Any = MISSING
    branch_points: list[float] = field(default_factory=list)
    count_of: str | None = None
    data: Tree = MISSING
    schedule: Tree = MISSING
    assignment: Tree = MISSING
    moving: Tree = MISSING
    method: Tree = MISSING
    preset: Tree = MISSING
    sparsify: Tree = MISSING
    node: Tree = MISSING
    effects: Tree | None = None
    image_points: Any = None
    moved_views: Any = None
    loss: Tree = MISSING
    callback: Tree = MISSING
    optimizer: Tree = MISSING
    render: Tree = MISSING
    trainer: Tree = MISSING
    logger: Any = None
    evaluation: Tree = MISSING
    out: str = MISSING
    folder: str = MISSING


ConfigStore.instance().store(name="train_schema", node=TrainSchema)


@contextmanager
def configuration() -> Iterator[None]:
    """Hydra knows where conf/ lies."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def composed(overrides: Iterable[str]) -> DictConfig:
    """The configuration of train with these overrides, as long as no app runs: its ``folder`` is here.

    Answers to the same overrides are one object: read it, never change it. Raises what Hydra raises.
    """
    return _composed(tuple(overrides))


@cache
def _composed(overrides: tuple[str, ...]) -> DictConfig:
    with configuration():
        return compose("train", [*overrides, "folder=."])


def override_problem(overrides: list[str]) -> str | None:
    """One line on what is wrong with the overrides, naming the nearest key; None if they compose."""
    keyed = without_flags(overrides)
    for text in keyed:
        if "=" not in text and not text.startswith("~"):
            return f"{text!r} is no override: write key=value"
        # Every key has its place in conf/, so an added one is a slip that Hydra would let pass.
        if text.startswith("+") and not text.startswith(ADDABLE):
            return _unknown_key(text.lstrip("+").partition("=")[0])
        if text.startswith("folder="):
            return f"{text}: folder follows from out, and a value of its own would lead nowhere: give out=DIR"
    try:
        # A sweep (a=1,2) composes for no single job; Hydra's sweeper splits it first.
        single = [text for text in keyed if not _is_sweep(text)]
        if len(single) < len(keyed) and not {"-m", "--multirun"} & set(overrides):
            several = next(text for text in keyed if text not in single)
            return f"{several} asks for several runs: add -m, or choose one"
        cfg = composed(single)
    except OverrideParseException as error:
        return f"{error.override!r} cannot be read: put a value with special characters in quotes, key='a=b'"
    except YAMLError as error:
        return " ".join(str(error).split())
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        cause = error.__cause__ or error
        key = getattr(cause, "full_key", None)
        reason = str(cause)
        return _explain(f"{key}: {reason}" if key and key not in reason.splitlines()[0] else reason, single)
    return limit_problem(cfg) or _masks_that_are_off(single, cfg)


def as_typed(arguments: Sequence[str]) -> list[str]:
    """The arguments, with quotes of Hydra's around a value that its grammar reads as something else than was typed.

    A shell takes its own quotes away, so a folder's name comes with its spaces, commas and letters alone. Lists of a
    sweep stay lists, unless there is a file of the whole name.
    """
    several = bool({"-m", "--multirun"} & set(arguments))
    return [_as_typed(text, several) for text in arguments]


def _as_typed(text: str, several: bool) -> str:
    key, equals, value = text.partition("=")
    if text.startswith("-") or not equals or not value or value[0] + value[-1] in ("''", '""') or "${" in value:
        return text
    path = key in PATHS
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException:
        plain = not set(value) & set("[]{}()'\",")
        return f"{key}={_in_quotes(value)}" if path or plain else text
    if (
        not path
        or value == "null"
        or (override.is_sweep_override() and (several or key != "out") and not Path(value).exists())
    ):
        return text
    return text if override.value() == value else f"{key}={_in_quotes(value)}"


def quoted(value: str) -> str:
    """A text as Hydra's grammar takes it, whatever characters it has.

    >>> quoted("a/b-1"), quoted("it's ö")
    ('a/b-1', "'it\\\\'s ö'")
    """
    return value if re.fullmatch(r"[A-Za-z0-9_./-]+", value) else _in_quotes(value)


def _in_quotes(value: str) -> str:
    # A backslash before a quote, or at the end, stands for itself where it is doubled.
    escaped = re.sub(r"(\\*)('|$)", lambda end: 2 * end[1] + ("\\'" if end[2] else ""), value)
    return f"'{escaped}'"


def value_of(text: str) -> str:
    """The value of an override without Hydra's quotes; a list of a sweep as it was typed."""
    override = OverridesParser.create().parse_override(text)
    return text.partition("=")[2] if override.is_sweep_override() else str(override.value())


def without_flags(overrides: Sequence[str]) -> list[str]:
    """The overrides without flags of Hydra's, and without the words after them (``--cfg job``)."""
    pairs = zip(["", *overrides], overrides, strict=False)
    return [text for before, text in pairs if not _is_flag(before, text)]


def _is_flag(before: str, text: str) -> bool:
    return text.startswith("-") or (before.startswith("-") and "=" not in text)


def _is_sweep(text: str) -> bool:
    """Whether an override asks for several jobs. Raises OverrideParseException for one that cannot be read."""
    return OverridesParser.create().parse_overrides([text])[0].is_sweep_override()


def _masks_that_are_off(overrides: list[str], cfg: DictConfig) -> str | None:
    """A mask's option has no effect where masks are not trained: it must not pass in silence."""
    if cfg.sparsify.masks:
        return None
    for text in overrides:
        key = text.partition("=")[0]
        if re.match(r"(node\.\w+\.mask\.|schedule\.(mask_learning_rate|lambda_m))", key):
            return f"{key} has no effect with sparsify={cfg.sparsify.name}: choose {_sparsify_with_masks()}"
    return None


def _sparsify_with_masks() -> str:
    names = _options("sparsify")
    *some, last = [name for name in names if OmegaConf.load(CONF / "sparsify" / f"{name}.yaml").sparsify.get("masks")]
    return f"sparsify={', '.join(some)} or {last}"


def _explain(reason: str, overrides: list[str]) -> str:
    """Hydra's reason (its first line names what is wrong) with the whole key and the key or option that was meant."""
    if (place := re.match(r"In '([^']+)': (.+)", reason, re.S)) and place[1] != "train":
        return f"{place[1]}.yaml: {_explain_file(place[2], overrides)}"
    said, given = reason.splitlines()[0], [text.partition("=")[0].lstrip("+~") for text in overrides]
    if "Got NoneType" in said:
        group = next((key for key, _, value in (text.partition("=") for text in overrides) if value == "null"), "")
        return _no_option("null", group)
    if branch := re.search(r"^(\w+): Cannot assign \w+ to Dict|^field '(\w+)' is not Optional", said):
        return _needs_a_key(branch[1] or branch[2])
    option = re.search(r"Could not find '([^']+)/([^/']+)'|Could not load '([^']+)/([^/']+)'", said)
    if option:
        group, name = (part for part in option.groups() if part)
        return _no_option(name, group)
    unknown = re.search(r"[Kk]ey '([^']+)' is not in struct|Key '([^']+)' not in|Could not override '([^']+)'", said)
    if not unknown:
        return said
    part = next(group for group in unknown.groups() if group)
    key = next((name for name in given if part in name.split(".") or name == part), part)
    if places := re.search(r"Did you mean to override (?:one of )?(.+)\?", reason):
        return f"no key {key!r}; did you mean {places[1].replace(', ', ' or ')}?{_options_of(key)}"
    if key in _known()[0] or (CONF / _group(key)).is_dir():
        return f"no key {key!r} with these choices: leave it out, or choose the option that has it"
    return _unknown_key(key, overrides)


def _explain_file(reason: str, overrides: list[str]) -> str:
    """What is wrong within a file of a group, which is somebody's own."""
    first, _, rest = reason.partition("\n")
    if first.endswith("raised while composing config:"):
        key = re.search(r"full_key: (\S+)", rest)
        return _unknown_key(key[1]) if key and " not in " in rest else _explain(rest, overrides)
    chosen = re.search(r"Could not override '([^'@]+)(@[^']*)?'. No match", first)
    if chosen and (CONF / f"{chosen[1]}.yaml").is_file():
        keys = chosen[1].replace("/", ".")
        return (
            f"'override /{chosen[1]}' needs a group, and conf/{chosen[1]}.yaml is a file: set {keys}.KEY in your file"
        )
    if chosen:
        return f"'override /{chosen[1]}{chosen[2] or ''}' overrides nothing that the defaults before it choose"
    return _explain(reason, overrides)


def _no_option(name: str, group: str) -> str:
    if group == "hydra/launcher":
        package = name.partition("_")[0]
        return f"no launcher {name!r} is installed: pip install hydra-{package}-launcher, or leave it out"
    while not _options(group) and "/" in group:
        group, name = group.rpartition("/")[0], f"{group.rpartition('/')[2]}/{name}"
    return f"no option {name!r} in conf/{group}: choose one of {', '.join(_options(group))}"


def _needs_a_key(key: str) -> str:
    names = [f"{key}.{name}" for name in composed(())[key] if not name.startswith("_")]
    return f"{key} is no choice but has keys of its own: set one of {', '.join(names)}"


def _options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _group(key: str) -> str:
    """Of ``mask@node.rigid.mask``: mask."""
    return key.partition("@")[0]


def _unknown_key(key: str, overrides: Sequence[str] = ()) -> str:
    """One line with the key that was probably meant, or the few that it may be, and the options where it is a group."""
    if key in MOVED:
        return f"no key {key!r}: it is {MOVED[key]!r} now"
    meant = _meant(key, overrides)
    if not meant:
        return f"no key {key!r}; sparsestreet train --cfg job prints all"
    if len(meant) == 1:
        return f"no key {key!r}; did you mean {meant[0]!r}?{_options_of(meant[0])}"
    return f"no key {key!r}; did you mean {', '.join(meant[:-1])} or {meant[-1]}?"


def _meant(key: str, overrides: Sequence[str] = ()) -> list[str]:
    """Keys by another word of the field's, by their last name, else the one that is most like it.

    Known are the keys of the default configuration, and those that the other overrides bring.
    """
    if key in WORDS:
        return [WORDS[key]]
    known, leaders = _known()
    groups = [text for text in overrides if "." not in text.partition("=")[0].partition("@")[0]]
    with suppress(HydraException, OmegaConfBaseException, ValueError):
        chosen = composed(
            [text for text in groups if not text.startswith(("+", key)) and text.partition("=")[0] != key]
        )
        known = (*known, *(set(_keys(OmegaConf.to_container(chosen, resolve=False))) - set(known)))
    alike = 0.5 if len(key) >= SHORT else 0.8
    found = [] if "." in key else _by_last_name(key, known)
    found = found or nearest(key, known, cutoff=alike)
    return list(dict.fromkeys(leaders.get(one, one) for one in found))


def _by_last_name(word: str, known: Sequence[str]) -> list[str]:
    """The few keys that end in a word, or in the one that is most like it; none where they are many."""
    last: dict[str, list[str]] = {}
    for key in known:
        last.setdefault(key.rpartition(".")[2], []).append(key)
    like = nearest(word, last, cutoff=0.6 if len(word) >= SHORT else 1.0)
    found = last[like[0]] if like else []
    return found if len(found) <= FEW_PLACES else []


def _options_of(key: str) -> str:
    options = _options(_group(key))
    return f" Its options are {', '.join(options)}" if options else ""


@cache
def _known() -> tuple[tuple[str, ...], dict[str, str]]:
    """Every key of the configuration as it stands without overrides, every group, and every place of one.

    Then the keys that follow another of the same last name, which is to be set instead (``trainer.max_steps``).
    """
    with configuration():
        cfg = compose("train", return_hydra_config=True)
    groups = [str(path.relative_to(CONF)) for path in CONF.rglob("*") if path.is_dir()]
    places = [key for key in cfg.hydra.runtime.choices if "@" in key]
    values = _keys(OmegaConf.to_container(composed(()), resolve=False))
    follows = {key: re.fullmatch(r"\$\{([\w.]+)\}", str(value)) for key, value in values.items()}
    last = {key: key.rpartition(".")[2] for key in values}
    leaders = {key: found[1] for key, found in follows.items() if found and found[1].endswith(f".{last[key]}")}
    return (*values, *groups, *places), leaders


def _keys(tree: object, prefix: str = "") -> dict[str, object]:
    """Dotted key -> its value as it is written; what begins with an underscore is Hydra's."""
    keys: dict[str, object] = {}
    for name, value in tree.items() if isinstance(tree, dict) else ():
        if not name.startswith("_"):
            keys[f"{prefix}{name}"] = value
            keys |= _keys(value, f"{prefix}{name}.")
    return keys


def check_moved(cfg: DictConfig) -> None:
    """Raises ValueError for a key that an earlier version wrote, and that has another name now."""
    for old, new in MOVED.items():
        place, _, name = old.rpartition(".")
        if name in (OmegaConf.select(cfg, place) or {}):
            raise ValueError(
                f"the configuration has {old}, which is {new} now: move its value there, in .hydra/config.yaml"
            )


def resolved(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as plain values, with what its interpolations stand for."""
    return cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))


def load_run_config(run: Path) -> DictConfig:
    """The configuration that a run wrote, with the log where the run had it.

    Raises FileNotFoundError naming what a run folder holds, ValueError for a file that is damaged.
    """
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        if run.is_file():
            from sparsestreet.scene.storage import scene_path  # torch

            scene_path(run)  # says what it is
        raise FileNotFoundError(f"{run} is no run: it has no .hydra/config.yaml; give a folder that train wrote")
    cfg = load_config(path)
    # Written as an interpolation that only a running app can resolve; and runs may have been moved.
    cfg.folder = str(run)
    try:
        _find_log(cfg, run / ".hydra" / "hydra.yaml")
    except OmegaConfBaseException as error:
        raise ValueError(f"{path} is damaged ({str(error).splitlines()[0]})") from error
    return cfg


def load_config(path: Path) -> DictConfig:
    """A configuration that Hydra wrote. Raises ValueError, naming the file, for what is none."""
    try:
        cfg = read_yaml(path, lambda text: OmegaConf.load(io.StringIO(text)))
    except OmegaConfBaseException as error:
        raise ValueError(f"{path} is damaged ({' '.join(str(error).split())[:200]})") from error
    if not isinstance(cfg, DictConfig):
        raise ValueError(f"{path} is damaged: it holds no configuration")
    return cfg


def _find_log(cfg: DictConfig, launch: Path) -> None:
    """Relative folders of the log are meant from where the run was started, as long as that is there."""
    cwd = OmegaConf.select(load_config(launch), "hydra.runtime.cwd") if launch.is_file() else ""
    if not isinstance(cwd, str):
        raise ValueError(f"{launch} is damaged: it does not say where the run was started (hydra.runtime.cwd)")
    started = Path(cwd)
    if started.is_dir():
        for key in ("data.root", "data.log.root", "data.log.parent"):
            folder = OmegaConf.select(cfg, key)
            if folder is not None:
                OmegaConf.update(cfg, key, str(started / folder))
