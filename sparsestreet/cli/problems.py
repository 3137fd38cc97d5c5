"""What cannot be, of the words of a command and of the configuration that they compose, each in one line."""

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from sparsestreet.cli.compose import MOVED, composed, configuration, without_flags
from sparsestreet.cli.limits import limit_problem
from sparsestreet.cli.option_files import CONF, config_files, option_tree, options_of
from sparsestreet.naming import nearest

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
    names = options_of("sparsify")
    *some, last = [name for name in names if option_tree("sparsify", name)["sparsify"].get("masks")]
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
