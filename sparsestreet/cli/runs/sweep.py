"""Sweeps: what they ask for, jobs that are skipped, jobs that fail."""

import logging
import math
import re
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from hydra import compose
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, InstantiationException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.config.compose import configuration, is_sweep, resolved, value_of, with_images, without_flags
from sparsestreet.cli.config.resolvers import UNCOUNTED
from sparsestreet.cli.config.validate import SHOWS, SWEEPS, flags_of
from sparsestreet.cli.runs.folder import folder_problem, give_back, holds_same_run, is_whole, same_run
from sparsestreet.cli.runs.locks import FolderTakenError
from sparsestreet.records.configuration import flat_config
from sparsestreet.records.run import FAILURE, FailedRun, read_failures
from sparsestreet.records.strict_json import RecordError
from sparsestreet.records.summary import SUMMARY

log = logging.getLogger(__name__)

_FIXED = "hydra.job.config.override_dirname.exclude_keys"
ALIKE = ("seed=", "data.root=")
"""Options of a job that no problem of its configuration depends on."""
_SAID = 10
"""Configurations from which on a sweep says that it looks at them: a second each."""
_OTHER_SWEEPERS = re.compile(r"hydra/sweeper=|hydra\.sweeper\.(?!max_batch_size=)")
"""Words of sweepers of somebody else's, which choose their jobs as they go."""
OF_DRIVES = ("table", "drives")
"""What the names of sweeps over recorded drives start with."""


class SweepFolder(Callback):
    """Keeps where the sweep of this process writes."""

    folder: Path | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        SweepFolder.folder = Path(config.hydra.sweep.dir)
        if "joblib" in config.hydra.launcher._target_:
            # joblib ends the processes of its jobs where its own raises, and SIGTERM would leave them behind.
            signal.signal(signal.SIGTERM, _raise_exit)


def _raise_exit(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


@contextmanager
def restored_handlers() -> Iterator[None]:
    """Put the handlers of signals back behind the block, whatever handles signals within it."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


def as_sweep(arguments: list[str]) -> list[str]:
    """The arguments, with Hydra's flag where a sweep is named."""
    flagged = (SHOWS | SWEEPS) & flags_of(arguments)
    return arguments if flagged or not _named(arguments) else ["-m", *arguments]


def with_fixed_keys(arguments: list[str]) -> list[str]:
    """The arguments of a sweep, with the keys that it does not vary for the names of its folders (``swept``)."""
    if not SWEEPS & flags_of(arguments):
        return arguments
    fixed = [text.lstrip("+~").partition("=")[0] for text in without_flags(arguments) if not is_sweep(text)]
    keys = ",".join(f"'{key}'" for key in fixed if not key.startswith("hydra"))
    return [*arguments, f"{_FIXED}=[{keys}]"]


def jobs_of(overrides: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of each job of a sweep, in Hydra's order. Hydra must know where conf/ lies.

    Raises what Hydra raises for options that do not compose.
    """
    given = [text for text in overrides if not is_sweep(text)]
    params = compose("train", given, return_hydra_config=True).hydra.sweeper.params or {}
    asked = OverridesParser.create().parse_overrides([*(f"{key}={value}" for key, value in params.items()), *overrides])
    for batch in BasicSweeper.split_arguments(asked, max_batch_size=None):
        yield from batch


def has_known_jobs(arguments: list[str]) -> bool:
    """Whether this is a sweep whose jobs are known before the first is trained."""
    return bool(SWEEPS & flags_of(arguments)) and not any(map(_OTHER_SWEEPERS.search, arguments))


def job_problem(arguments: list[str]) -> str | None:
    """The first job of a sweep that cannot be, in one sentence; None where each can.

    Each configuration is looked at once, whatever its seeds. What follows from a run that is not there yet passes.
    """
    if not has_known_jobs(arguments):
        return None
    from sparsestreet.cli.config.validate import config_problem
    from sparsestreet.cli.runs.run import recipe_of

    with configuration():
        jobs = list(jobs_of(without_flags(arguments)))
        once = {tuple(word for word in words if not word.startswith(ALIKE)): words for words in reversed(jobs)}
        if len(once) > _SAID:
            print(f"sparsestreet train: looks at {len(once)} configurations before the first run", file=sys.stderr)
        for words in reversed(once.values()):
            try:
                cfg = compose("train", [*words, "folder=."])
                problem = config_problem(cfg)
                if problem is None:
                    recipe_of(cfg)
            except (HydraException, OmegaConfBaseException, ValueError, ImportError, FileNotFoundError) as error:
                problem = sentence(error).splitlines()[0]
            if problem and UNCOUNTED not in problem:
                shown = " ".join(word for word in words if not word.startswith("hydra"))
                number = jobs.index(words) + 1
                return f"job {number} of {len(jobs)} ({shown}): {problem}; nothing was trained"
    return None


def note_of_sweep(arguments: list[str]) -> str | None:
    """Where the configuration of a named sweep is shown: the keys whose values are not yet those of its jobs."""
    name = _named(arguments)
    if name is None or not SHOWS & flags_of(arguments):
        return None
    with configuration():
        cfg = compose("train", without_flags(arguments), return_hydra_config=True)
    keys = ", ".join(cfg.hydra.sweeper.params or ())
    return f"one configuration is shown; the jobs of the sweep differ in {keys} (conf/sweep/{name}.yaml)"


def sweep_problem(arguments: list[str]) -> str | None:
    """What a sweep over recorded drives lacks, in one sentence."""
    name = _named(arguments)
    if name is None or not name.startswith(OF_DRIVES):
        return None
    roots = next((value_of(text) for text in arguments if text.startswith("data.root=")), None)
    if roots is None:
        return (
            f"+sweep={name} trains on recorded drives: give their folders, data.root=DIR,DIR (conf/sweep/{name}.yaml)"
        )
    absent = [root for root in ([roots] if Path(roots).is_dir() else roots.split(",")) if not Path(root).is_dir()]
    if absent:
        return f"data.root names {', '.join(absent)}, which is no folder here: give folders of drives"
    return None


def sweep_status(own: Collection[Path] | None = None) -> int:
    """0, or 1 with a line on standard error where a job of this process's sweep failed; ``own``: only these folders."""
    if SweepFolder.folder is None:
        return 0
    failures = [one for one in read_failures(SweepFolder.folder) if own is None or one[0] in own]
    for folder, failure in failures:
        print(f"sparsestreet train: {folder} failed: {failure.error}", file=sys.stderr)
    if failures:
        print(f"sparsestreet train: {len(failures)} failed; the same command runs them again", file=sys.stderr)
    return 1 if failures else 0


def run_job(cfg: DictConfig, out: Path, train: Callable[[], float | None]) -> float | None:
    """One job of a sweep: skipped where its folder holds its record, and written down where it fails.

    Answers with the PSNR that ``train`` answered with or the record holds, NaN for a job that failed, or that another
    process is at. Where the folder holds another run, the whole sweep ends with status 2, so that nothing is written
    into that one.
    """
    from sparsestreet.cli.runs.run import this_command

    try:
        done = finished(cfg, out)
        if done is None and not holds_same_run(cfg, out) and (problem := folder_problem(cfg, out)):
            print(f"sparsestreet train: {problem}", file=sys.stderr)
            sys.exit(2)
        if done is None:
            done = train()
        else:
            log.info("%s holds a complete record of this configuration: skipped", out)
            give_back(cfg, out, of_sweep=True)  # which a kill may have kept it from
    except FolderTakenError as error:
        log.error("%s", error)  # a word in that folder would speak of the run that is under way
        return math.nan
    except Exception as error:  # a sweep goes on, whatever one job dies of
        log.exception("%s failed", out)
        command = this_command(["train", *HydraConfig.get().overrides.task])
        trace = "".join(traceback.format_exception(error))
        FAILURE.write(
            out, FailedRun(label=cfg.name, seed=cfg.seed, command=command, error=sentence(error), trace=trace)
        )
        return math.nan
    FAILURE.remove(out)
    return done


def finished(cfg: DictConfig, out: Path) -> float | None:
    """The PSNR of a folder that holds the complete record of this very job; None where it has to be trained."""
    try:
        summary = SUMMARY.read(out)
    except RecordError:
        return None
    if not is_whole(out):
        return None
    seen = summary.run.config.get("training_views.images")
    config = flat_config(resolved(with_images(cfg, seen) if isinstance(seen, int) else cfg))
    if not same_run(summary.run.config, config) or summary.run.steps < summary.run.max_steps:
        return None
    return summary.mean("psnr_full")


def sentence(error: BaseException) -> str:
    """The reason without Hydra's wrapping."""
    while isinstance(error, InstantiationException) and error.__cause__ is not None:
        error = error.__cause__
    return str(error) or type(error).__name__


def _named(arguments: list[str]) -> str | None:
    return next((text.partition("=")[2] for text in arguments if text.startswith("+sweep=")), None)
