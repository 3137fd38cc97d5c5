"""Where the configuration lies, its options and strict root, and words as Hydra's grammar takes them."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, cast

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.config.resolvers import register_resolvers
from sparsestreet.files import read_yaml

PACKAGE = Path(__file__).resolve().parents[2]
# An installed wheel carries conf/ inside the package; a checkout has it beside the package.
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"

GLOBAL = "# @package _global_"
"""First line of a file whose keys begin at the root."""
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_OPTIONS = re.compile(r"^# Options of ", re.MULTILINE)
"""A line of a file that holds several options, by their names."""
_NAMED = ("effects", "loss", "callback", "source")
"""Groups of which several options are chosen at once: each stands below its own name."""


def config_files() -> Iterator[tuple[str, bool, Any]]:
    """Yield the path below conf/ of each option, without its ending, whether its keys are global, and its tree."""
    for path in sorted(CONF.rglob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        if not _OPTIONS.search(text):
            place = path.relative_to(CONF).with_suffix("")
            yield place.as_posix(), text.startswith(GLOBAL), yaml.load(text, LOADER) or {}
    yield from _short_options()


def _short_options() -> Iterator[tuple[str, bool, Any]]:
    """Yield the same of files that hold several: ``experiment/claim.yaml`` those of ``experiment=claim/NAME``."""
    for path in sorted([*CONF.glob("options/*.yaml"), *CONF.glob("experiment/*.yaml")]):
        text = path.read_text(encoding="utf-8")
        if not _OPTIONS.search(text):
            continue
        group = path.relative_to(CONF).with_suffix("").as_posix().removeprefix("options/")
        for name, option in (yaml.load(text, LOADER) or {}).items():
            yield f"{group}/{name}", text.startswith(GLOBAL), {name: option} if group in _NAMED else option or {}


@cache
def options_of(group: str) -> tuple[str, ...]:
    """Return the names of the options of a group, sorted; none where conf/ has no such group."""
    names = (name.rpartition("/") for name, _, _ in config_files())
    return tuple(sorted(name for folder, _, name in names if folder == group))


def option_tree(group: str, name: str) -> Any:
    """Return what conf/ says of an option, as plain values."""
    return next(tree for place, _, tree in config_files() if place == f"{group}/{name}")


def register_options() -> None:
    """Tell Hydra of the options that share a file; it reads files of single options itself."""
    for place, anywhere, tree in _short_options():
        group, _, name = place.rpartition("/")
        package = "_global_" if anywhere else None
        ConfigStore.instance().store(name=name, node=tree, group=group, package=package, provider="conf")


register_options()
register_resolvers()


MOVED = {"data.log.min_lens_shift": "effects.lens.min_shift", "image_points.cache": "cache"}
"""Keys of earlier versions -> where their value belongs now."""
PATHS = {
    *("out", "resume", "count_of", "trunk", "data.root", "data.log.root", "data.log.parent", "cache"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}
"""Keys whose value is a path, in whatever letters."""
Tree = dict[str, Any]
"""Keys below a key: a word in their place (``render=fast``) is an error."""


@dataclass
class TrainSchema:
    """Every root key of conf/train.yaml: any other is an error, with ``+`` as well."""

    name: str = MISSING
    seed: Any = MISSING
    capacity: Tree = MISSING
    split: Tree = MISSING
    training_views: Tree = MISSING
    budget: Tree = MISSING
    resume: str | None = None
    overwrite: bool = False
    trunk: str | None = None
    checkpoint_every: Any = MISSING
    branch_points: list[float] = field(default_factory=list)
    keep_checkpoints: bool = False
    count_of: str | None = None
    cache: str | None = None
    data: Tree = MISSING
    schedule: Tree = MISSING
    assignment: Tree = MISSING
    moving: Tree = MISSING
    method: Tree = MISSING
    preset: Tree = MISSING
    sparsify: Tree = MISSING
    node: Tree = MISSING
    effects: Tree | None = None
    tracks: Tree = MISSING
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


def as_typed(arguments: Sequence[str]) -> list[str]:
    """The arguments, with quotes of Hydra's around a value that its grammar reads as something else than was typed.

    A shell takes its own quotes away, so a folder's name comes with its spaces, commas and letters alone. Lists of a
    sweep stay lists, unless there is a file of the whole name. ``data.root=@FILE`` is the list of folders that a file
    names, one a line, since Linux takes no argument above 128 KiB; what follows # is a comment.
    """
    several = bool({"-m", "--multirun"} & set(arguments))
    return [_as_typed(text, several) for text in arguments]


_DRIVES = "data.root"


def _lines(path: Path) -> list[str]:
    """Return what the lines of a file name; nothing where there is no file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [name for line in lines if (name := line.partition("#")[0].strip())]


def _as_typed(text: str, several: bool) -> str:
    key, equals, value = text.partition("=")
    if key == _DRIVES and value.startswith("@") and (listed := _lines(Path(value[1:]))):
        return f"{key}={','.join(map(quoted, listed))}"
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
    return [
        text for before, text in pairs if not (text.startswith("-") or (before.startswith("-") and "=" not in text))
    ]


def is_sweep(text: str) -> bool:
    """Whether an override asks for several jobs. Raises OverrideParseException for one that cannot be read."""
    return OverridesParser.create().parse_overrides([text])[0].is_sweep_override()


def check_moved(cfg: DictConfig) -> None:
    """Raise ValueError for a key that an earlier version wrote, and that has another name now."""
    for old, new in MOVED.items():
        place, _, name = old.rpartition(".")
        if name in (OmegaConf.select(cfg, place) or {}):
            raise ValueError(
                f"the configuration has {old}, which is {new} now: move its value there, in .hydra/config.yaml"
            )


def resolved(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as plain values, with what its interpolations stand for."""
    return cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))


def with_images(cfg: DictConfig, images: int | None) -> DictConfig:
    """The configuration of a run whose training sees so many images."""
    known = cfg.copy()
    known.training_views.images = images
    return known


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
    cfg.cache = None  # it lies beside what ``out`` was, which only that app could resolve
    if isinstance(cfg.get("image_points"), DictConfig):
        cfg.image_points.pop("cache", None)  # of earlier versions, whose points lay in a folder of their own
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
