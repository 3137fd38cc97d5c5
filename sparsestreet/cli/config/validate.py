"""What cannot be, of the words of a command and of the configuration that they compose, each in one line.

Asked before any data is read, so that nobody waits for a street to hear of a slip of the pen."""

import inspect
import re
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from functools import cache
from importlib.util import find_spec

from beartype.door import is_bearable
from beartype.roar import BeartypeException
from hydra import compose
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from sparsestreet.cli.config.compose import (
    CONF,
    MOVED,
    composed,
    config_files,
    configuration,
    is_sweep,
    option_tree,
    options_of,
    without_flags,
)
from sparsestreet.cli.config.targets import located
from sparsestreet.cli.process import shares_a_run
from sparsestreet.naming import nearest

if typing.TYPE_CHECKING:
    import torch

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


WORDS = {
    **dict.fromkeys(("steps", "iterations", "iters", "num_iterations", "epochs"), "schedule.max_steps"),
    **dict.fromkeys(("lr", "learning_rate", "learning_rates"), "schedule.rates"),
    **dict.fromkeys(("device", "gpu", "accelerator"), "trainer"),
}
"""Words of the field -> our key."""
SHORT = 4
"""Letters of a word below which another word is like it by chance (lr, logger)."""
FEW_PLACES = 6
"""Keys that a slip still names."""

ADDABLE = ("++", "+hydra", "+sweep")
"""What may be added: keys that are meant to be new, and sweeps."""


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
        single = [text for text in keyed if not is_sweep(text)]
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
    names = options_of("sparsify")
    *some, last = [name for name in names if option_tree("sparsify", name)["sparsify"].get("masks")]
    return f"sparsify={', '.join(some)} or {last}"


def _explain(reason: str, overrides: list[str]) -> str:
    """Hydra's reason (its first line names what is wrong) with the whole key and the key or option that was meant."""
    if (place := re.match(r"In '([^']+)': (.+)", reason, re.S)) and place[1] != "train":
        if options_of(place[1]):
            return f"{place[1]} holds several options: choose one of {', '.join(options_of(place[1]))}"
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
    if key in _known()[0] or options_of(_group(key)):
        return f"no key {key!r} with these choices: leave it out, or choose the option that has it"
    return _unknown_key(key, overrides)


def _explain_file(reason: str, overrides: list[str]) -> str:
    """What is wrong within a file of a group, which is somebody's own."""
    first, _, rest = reason.partition("\n")
    if first.endswith("raised while composing config:"):
        key = re.search(r"full_key: (\S+)", rest)
        return _unknown_key(key[1]) if key and " not in " in rest else _explain(rest, overrides)
    chosen = re.search(r"Could not override '([^'@]+)(@[^']*)?'. No match", first)
    if chosen and any(place == chosen[1] for place, _, _ in config_files()):
        keys = chosen[1].replace("/", ".")
        return f"'override /{chosen[1]}' needs a group, and {chosen[1]} is an option: set {keys}.KEY in your file"
    if chosen:
        return f"'override /{chosen[1]}{chosen[2] or ''}' overrides nothing that the defaults before it choose"
    return _explain(reason, overrides)


def _no_option(name: str, group: str) -> str:
    if group == "hydra/launcher":
        package = name.partition("_")[0]
        return f"no launcher {name!r} is installed: pip install hydra-{package}-launcher, or leave it out"
    while not options_of(group) and "/" in group:
        group, name = group.rpartition("/")[0], f"{group.rpartition('/')[2]}/{name}"
    return f"no option {name!r} in conf/{group}: choose one of {', '.join(options_of(group))}"


def _needs_a_key(key: str) -> str:
    names = [f"{key}.{name}" for name in composed(())[key] if not name.startswith("_")]
    return f"{key} is no choice but has keys of its own: set one of {', '.join(names)}"


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
        known = (*known, *(set(_keys_of(chosen)) - set(known)))
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
    options = options_of(_group(key))
    return f" Its options are {', '.join(options)}" if options else ""


@cache
def _known() -> tuple[tuple[str, ...], dict[str, str]]:
    """Every key of the configuration as it stands without overrides, every group, and every place of one.

    Then the keys that follow another of the same last name, which is to be set instead (``trainer.max_steps``).
    """
    with configuration():
        cfg = compose("train", return_hydra_config=True)
    groups = dict.fromkeys(group for place, _, _ in config_files() if (group := place.rpartition("/")[0]))
    places = [key for key in cfg.hydra.runtime.choices if "@" in key]
    values = _keys_of(composed(()))
    follows = {key: re.fullmatch(r"\$\{([\w.]+)\}", str(value)) for key, value in values.items()}
    last = {key: key.rpartition(".")[2] for key in values}
    leaders = {
        key: found[1]
        for key, found in follows.items()
        if found and found[1] in values and found[1].endswith(f".{last[key]}")
    }
    return (*values, *groups, *places), leaders


def _keys_of(cfg: DictConfig) -> dict[str, object]:
    """Without the numbers of the capacity, which are set where they act."""
    found = _keys(OmegaConf.to_container(cfg, resolve=False))
    return {key: value for key, value in found.items() if not key.startswith("capacity.")}


def _keys(tree: object, prefix: str = "") -> dict[str, object]:
    """Dotted key -> its value as it is written; what begins with an underscore is Hydra's."""
    keys: dict[str, object] = {}
    for name, value in tree.items() if isinstance(tree, dict) else ():
        if not name.startswith("_"):
            keys[f"{prefix}{name}"] = value
            keys |= _keys(value, f"{prefix}{name}.")
    return keys


def preset_problem(cfg: DictConfig) -> str | None:
    """One line where the preset has no configuration of the method; None where it has, or needs none."""
    if not OmegaConf.is_missing(cfg.preset, "method"):
        return None
    found = options_of(f"preset/method/{cfg.preset.name}")
    return (
        f"preset={cfg.preset.name} has no configuration of method={cfg.method.name}: choose method="
        f"{' or '.join(found)}, or another preset"
    )


def preset_notes(cfg: DictConfig) -> Iterator[str]:
    """Lines that a training logs before its first step; none for a preset of our own."""
    preset = cfg.preset
    if preset.label.endswith("_scaled"):
        yield (
            f"preset {preset.name} is scaled: DriveStudio's has schedule=paper capacity=paper; here its milestones "
            f"are fractions of {cfg.schedule.max_steps:,} steps, and capacity={cfg.capacity.name} sets sizes"
        )
    if absent := preset.get("absent"):
        yield f"preset {preset.name} lacks of DriveStudio: {'; '.join(absent.values())}"


Tree = typing.Any


def config_problem(cfg: DictConfig) -> str | None:
    """The first problem of a training's configuration in one sentence; None where there is none."""
    if problem := preset_problem(cfg):
        return problem
    try:
        tree = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        return _in_one_line(error)
    try:
        problem = limit_problem(cfg) or next(_parts_without_keys(tree), None) or type_problem(tree)
    except ValueError as error:  # a class that cannot be imported
        return str(error)
    return problem or device_problem(cfg.trainer)


def unresolvable(cfg: DictConfig) -> str | None:
    """The first ``${...}`` that gives no value, in one sentence; None where each does."""
    try:
        OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        return _in_one_line(error)
    return None


def type_problem(tree: Tree) -> str | None:
    """The first value of a wrong type, in one sentence; None where there is none."""
    return next(_wrong_types(tree), None)


def _in_one_line(error: OmegaConfBaseException) -> str:
    reason = str(error).splitlines()[0]
    missing = re.search(r"[Mm]issing mandatory value: (\S+)", reason)
    if missing:
        key = error.full_key if isinstance(error, MissingMandatoryValue) else missing[1]
        return f"{key} has no value: give {key}=..."
    if absent := re.search(r"Interpolation key '(\S+)' not found", reason):
        key = error.full_key
        return f"{key} follows from {absent[1]!r}, which these choices lack: choose another option, or give {key}=..."
    return reason.partition("interpolation: ")[2] or reason


def _parts_without_keys(tree: Tree) -> Iterator[str]:
    """Nodes, effects, losses and callbacks that are a plain value."""
    for group in ("node", "effects", "loss", "callback"):
        for name, value in (tree[group] or {}).items():
            if not isinstance(value, dict):
                yield f"{group}.{name} has keys of its own, got {value!r}: set one of them, or say ~{group}.{name}"


def _wrong_types(tree: Tree, path: str = "", kind: typing.Any = None) -> Iterator[str]:
    """Values that the classes and functions they are handed to do not take; ``kind`` is what the tree shall become."""
    if not isinstance(tree, dict):
        return
    hints = _hints(tree, kind, path)
    for name, value in tree.items():
        key = f"{path}.{name}" if path else name
        if isinstance(kind, type) and is_dataclass(kind) and "_target_" not in tree and name not in hints:
            yield f"no key {key!r}: {kind.__name__} has {', '.join(hints)}"
        if name in hints and not isinstance(value, dict) and not _fits(value, hints[name]):
            yield f"{key} must be {_in_words(hints[name])}, got {value!r}"
        yield from _wrong_types(value, key, hints.get(name))


def _hints(tree: Mapping[str, Tree], kind: typing.Any, path: str) -> dict[str, typing.Any]:
    """Key -> annotation of its value, by what ``_target_`` names or by the kind; nothing where neither can be read."""
    if typing.get_origin(kind) is Mapping and "_target_" not in tree:
        item = _from_mapping(typing.get_args(kind)[1])
        return {name: item for name, value in tree.items() if isinstance(value, dict)}
    found = located(tree["_target_"], f"{path}._target_") if "_target_" in tree else kind
    if not (callable(found) and ("_target_" in tree or is_dataclass(found))):
        return {}
    try:
        function = found.__init__ if inspect.isclass(found) else found
        return {name: hint for name, hint in typing.get_type_hints(function).items() if name != "return"}
    except (NameError, TypeError):
        return {}


def _from_mapping(hint: typing.Any) -> typing.Any:
    """Of a dataclass or a mapping of its fields: the dataclass."""
    return next((one for one in typing.get_args(hint) if is_dataclass(one)), hint)


def _fits(value: Tree, hint: typing.Any) -> bool:
    if isinstance(value, str) and typing.get_origin(hint) is Sequence:
        return False  # a word is a sequence of letters, which nobody means
    try:
        if isinstance(value, list):
            return all(_item_fits(item, len(value), hint) for item in value) if value else _any_fits(([], ()), hint)
        return _any_fits(_meant_checks(value), hint)
    except BeartypeException:
        return True  # an annotation that cannot be checked at run time says nothing


def _item_fits(item: Tree, count: int, hint: typing.Any) -> bool:
    """Beartype checks one random item of a variadic tuple or list, so each item is checked in a sequence of copies."""
    return _any_fits((kind([one] * count) for one in _meant_checks(item) for kind in (list, tuple)), hint)


def _meant_checks(value: Tree) -> tuple[Tree, ...]:
    """YAML writes 1 where a float is meant."""
    return (value, float(value)) if isinstance(value, int) and not isinstance(value, bool) else (value,)


def _any_fits(values: Iterable[Tree], hint: typing.Any) -> bool:
    return any(is_bearable(value, hint) for value in values)


def _in_words(hint: typing.Any) -> str:
    return hint.__name__ if inspect.isclass(hint) and not typing.get_args(hint) else str(hint).replace("typing.", "")


GPU = ("gpu", "cuda")
"""Words of ``trainer.accelerator`` that ask for a CUDA device; ``auto`` takes one where there is one."""


def device_of(name: str, asker: str, remedy: str) -> "torch.device":
    """The device by name: cpu, cuda, or a GPU by its number, as cuda:1.

    Raises ValueError for any other name, and where torch sees no GPU: what needs one (``asker``) and what would help.
    """
    import torch  # seconds, which a refused start does not wait for

    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {name!r}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"{asker} needs a CUDA device and torch sees none: {remedy}")
    return torch.device(name)


def device_problem(trainer: DictConfig) -> str | None:
    """What is asked of devices that cannot be, in one sentence; None where it can."""
    import torch

    devices = trainer.get("devices", 1)
    if trainer.get("accelerator") in GPU:
        try:
            device_of("cuda", "trainer=gpu", "sparsestreet check says why; trainer=cpu trains without")
        except ValueError as error:
            return str(error)
    if shares_a_run(trainer):
        return None
    named = named_devices(devices)
    if (devices not in (1, "1", "auto")) if named is None else len(named) != 1:
        return (
            f"training runs on one device, got trainer.devices={devices}: trainer=ddp shares a run among several, and "
            "a sweep gives each of its jobs one"
        )
    if named and not on_gpu(trainer):
        return f"trainer.devices={devices} names a GPU, and this run has none: say trainer=gpu, or leave it out"
    if named and named[0] not in range(there := torch.cuda.device_count()):
        return f"trainer.devices={devices} is not there: torch sees {there} of them, numbered from 0"
    return None


def on_gpu(trainer: DictConfig) -> bool:
    import torch

    accelerator = trainer.get("accelerator")
    return accelerator in GPU or (accelerator in (None, "auto") and torch.cuda.is_available())


def named_devices(devices: typing.Any) -> list[int] | None:
    """The devices that are named by their numbers, as Lightning reads them ([3], "3," or "2,3"); None for a count."""
    if isinstance(devices, str) and "," in devices:
        return [int(part) for part in devices.split(",") if part.strip()]
    return list(devices) if isinstance(devices, list | ListConfig) else None


_WORDS = ("auto", "on", "off")


def with_effect_keys(arguments: Sequence[str]) -> list[str]:
    """The arguments with ``effects.X=on`` as ``effects.X.when=on``, and ``effects=auto|off`` for all default effects.

    Lists of a sweep stay lists (``effects.exposure=on,off``). What is no such word stays as it is.
    """
    return [written for text in arguments for written in _written(text)]


def _written(text: str) -> list[str]:
    key, equals, value = text.partition("=")
    if not equals or not set(value.split(",")) <= set(_WORDS):
        return [text]
    if key == "effects" and value in ("auto", "off"):
        return [f"effects.{name}.when={value}" for name in _default_effects()]
    if key.startswith("effects.") and key.count(".") == 1:
        return [f"{key}.when={value}"]
    return [text]


def _default_effects() -> list[str]:
    """Name in the list of conf/train.yaml."""
    defaults = OmegaConf.load(CONF / "train.yaml").defaults
    return next(list(entry.effects) for entry in defaults if "effects" in entry)


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
