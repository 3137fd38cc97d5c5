"""What a composed configuration says that cannot be: values of a wrong type, missing ones, devices that are not there.

Asked before any data is read, so that nobody waits for a street to hear of a slip of the pen.
"""

import inspect
import re
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass

from beartype.door import is_bearable
from beartype.roar import BeartypeException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from sparsestreet.cli.limits import limit_problem
from sparsestreet.cli.preset import preset_problem
from sparsestreet.cli.process import shares_a_run
from sparsestreet.cli.targets import located

if typing.TYPE_CHECKING:
    import torch

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
        return _any_fits(_meant(value), hint)
    except BeartypeException:
        return True  # an annotation that cannot be checked at run time says nothing


def _item_fits(item: Tree, count: int, hint: typing.Any) -> bool:
    """Beartype checks one random item of a variadic tuple or list, so each item is checked in a sequence of copies."""
    return _any_fits((kind([one] * count) for one in _meant(item) for kind in (list, tuple)), hint)


def _meant(value: Tree) -> tuple[Tree, ...]:
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
