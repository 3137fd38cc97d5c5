"""The layout in which a log is written: an option of conf/layout, and its settings."""

from collections.abc import Sequence

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.commands.options import unknown_key
from sparsestreet.cli.config.compose import configuration
from sparsestreet.cli.config.log_from_options import UsageError
from sparsestreet.cli.config.validate import type_problem
from sparsestreet.data.writer import LogWriter

DEFAULT = "layout=drivestudio"


def named_writer(words: Sequence[str], searchpath: Sequence[str] = ()) -> LogWriter:
    """The writer of ``layout=NAME layout.key=value``; without a name it is DriveStudio's.

    ``searchpath`` are the words ``hydra.searchpath=...`` of a command, for layouts of one's own. Raises UsageError for
    options and keys that are not there, and for values of a wrong type or that the writer does not take.
    """
    named = [text for text in words if text.startswith("layout=")] or [DEFAULT]
    if len(named) > 1:
        raise UsageError(f"a log is written in one layout, got {' '.join(named)}")
    settings = [text for text in words if not text.startswith("layout=")]
    name = named[0].partition("=")[2]
    try:
        cfg = _composed(name, settings, searchpath)
    except (HydraException, OmegaConfBaseException) as error:
        raise UsageError(str(error).splitlines()[0]) from error
    if problem := type_problem(OmegaConf.to_container(cfg, resolve=True)):
        raise UsageError(problem)
    try:
        return instantiate(cfg.layout, _convert_="all")
    except InstantiationException as error:
        raise UsageError(str(error.__cause__ or error)) from None


def _composed(name: str, settings: Sequence[str], searchpath: Sequence[str]) -> DictConfig:
    with configuration():
        loader = GlobalHydra.instance().config_loader()
        options = loader.get_group_options("layout", ObjectType.CONFIG, config_name="train", overrides=list(searchpath))
        if name not in options:
            raise UsageError(f"no option {name!r} in conf/layout: choose one of {', '.join(options)}")
        plain = compose(None, [*searchpath, f"+layout={name}"])
        known = [f"layout.{key}" for key in plain.layout if key != "_target_"]
        for text in settings:
            if (key := text.partition("=")[0]) not in known:
                raise UsageError(unknown_key(key, known))
        return compose(None, [*searchpath, f"+layout={name}", *settings])
