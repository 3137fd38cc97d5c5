"""``sparsestreet report verify``: whether a bundle agrees with itself, and a row of it with what training gives."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from sparsestreet.atomic import atomic_folder
from sparsestreet.cli.commands.options import OptionError, run_command
from sparsestreet.cli.config.compose import PATHS, as_typed, composed, quoted, resolved, with_images
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.validate import config_problem, override_problem
from sparsestreet.cli.runs.folder import CONFIGURATION, TRACKS_FILE, received_words, without_environment
from sparsestreet.metrics.definitions import PROTOCOLS
from sparsestreet.naming import one_line, printable
from sparsestreet.records.configuration import IDENTITY_KEYS, config_hash, flat_config, only, without
from sparsestreet.records.run import RUN, RunDescription, this_source
from sparsestreet.records.summary import SUMMARY, RunSummary
from sparsestreet.report.bundle import SCENE
from sparsestreet.report.bundle_check import Unpacked, unpacked
from sparsestreet.report.repeated import comparisons, verdict
from sparsestreet.report.variants import COUNT_KEYS

USAGE = """\
sparsestreet report verify FILE.zip [row=NUMBER|LABEL [evaluate=true] [out=DIR] [data.root=DIR] [key=value ...]]

Checks a bundle that sparsestreet report bundle=FILE.zip wrote: its bytes, its records, and that these give its tables.
Each fault is a line.

With row=, a row is then trained again, with the configuration of its record and the data of data.root, in out
(outputs/verify/FILE/NUMBER); with evaluate=true its scene is measured again instead, if the bundle has it. Data of
another hash, and a configuration that this version composes otherwise, are refused. A line says whether quality,
Gaussians and MB hold. Other words go to train: trainer=gpu, cache=DIR. parts=[MODULE] trusts a module that the row
names (docs/extending.md).

Exit status: 0 all holds, 1 something does not, 2 wrong usage.
"""

_SEEDS = ("seed", "*.seed")
"""Options that are no part of a configuration's identity, and yet of a run's."""


@dataclass(frozen=True)
class VerifyRequest:
    """The command's own options. Raises ValueError where they contradict each other."""

    bundle: Path
    row: str | None = None
    evaluate: bool = False
    out: Path | None = None
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.row is None and (self.evaluate or self.out is not None or self.parts):
            raise ValueError("evaluate, out and parts go with a row: say row=NUMBER")


def verify(arguments: Sequence[str]) -> int:
    """Check a bundle, and a row of it; statuses as ``USAGE`` says."""
    own = {field.name for field in fields(VerifyRequest)}
    mine = [text for text in arguments if "=" not in text or text.partition("=")[0] in own or Path(text).exists()]
    others = [text for text in arguments if text not in mine]
    action = partial(_verify, typed=as_typed(others))
    return run_command("report verify", USAGE, mine, VerifyRequest, action, positional=("bundle",))


def _verify(request: VerifyRequest, typed: list[str]) -> None:
    if typed and request.row is None:
        raise OptionError(f"{typed[0]} goes with a row: say row=NUMBER")
    with unpacked(request.bundle) as bundle:
        faults = list(bundle.faults())
        for fault in faults:
            print(printable(fault))
        if faults:
            raise ValueError(f"{request.bundle} does not hold: {len(faults)} of its parts disagree")
        summaries = bundle.summaries()
        print(f"{request.bundle}: {len(summaries)} runs, whose bytes, records and tables agree")
        if request.row is None:
            return
        try:
            number = bundle.bundle.row(request.row)
        except ValueError as error:
            raise OptionError(str(error)) from error
        recorded = summaries.pop(number - 1)
        found = _again(request, typed, bundle, number, recorded)
    compared = comparisons(recorded, found, summaries, PROTOCOLS[bundle.bundle.protocol])
    said = printable(f"row {number}, {verdict(recorded, found, compared, trained=not request.evaluate)}")
    if not all(one.holds for one in compared):
        raise ValueError(said)
    print(said)


def _again(request: VerifyRequest, typed: list[str], bundle: Unpacked, number: int, recorded: RunSummary) -> RunSummary:
    """Train or measure a row again, once its configuration and data are those of the record."""
    run, source = recorded.run, Path(f"{request.bundle}, row {number}")
    out = request.out or Path("outputs/verify") / request.bundle.stem / str(number)
    words = [*_words(run, typed, source, request.parts), *typed]
    if problem := override_problem(words):
        raise ValueError(f"{source}: {problem}")
    cfg = _configuration(words, run, source)
    _check_data(cfg, run, source)
    if (commit := this_source().commit) != run.source.commit:
        print(f"row {number} is of commit {one_line(str(run.source.commit))[:9]}, this is {str(commit)[:9]}")
    if request.evaluate:
        _measure(bundle, number, run, cfg, out, request.parts)
    else:
        _train([*words, f"out={quoted(str(out))}"])
    return SUMMARY.read(out)


def _words(run: RunDescription, typed: list[str], source: Path, parts: Sequence[str]) -> list[str]:
    """The words of the command that trained a run, but for the places where things lay.

    Raises ValueError for a run that no command makes again, and for words that only the user's own command may say.
    """
    try:
        program, command, *words = shlex.split(run.command)
    except ValueError:
        program, command, words = "", "", []
    if (program, command) != ("sparsestreet", "train"):
        raise ValueError(f"{source} was not made by sparsestreet train: nothing trains it again")
    if run.steps < run.max_steps or run.config.get("budget.minutes") is not None:
        raise ValueError(f"{source} was ended by a clock or a signal at step {run.steps:,}: nothing trains it again")
    kept = received_words(words, (*PATHS, "overwrite"), typed, source, parts)
    return [*kept, *(_counts(run) if run.config.get("count_of") else ())]


def _counts(run: RunDescription) -> list[str]:
    """What a control has from another run, as options of its own."""
    found = only(run.config, COUNT_KEYS)
    return [f"{key}={value}" for key, value in found.items()]


def _configuration(words: list[str], run: RunDescription, source: Path) -> DictConfig:
    """The configuration of the words. Raises ValueError, naming what differs, where it is not that of the record."""
    images = run.config.get("training_views.images")
    cfg = with_images(composed(words), images if isinstance(images, int) else None)
    if problem := config_problem(cfg):
        raise ValueError(f"{source}: {problem}")
    ours = flat_config(resolved(cfg))
    here, there = ({**without(config, IDENTITY_KEYS), **only(config, _SEEDS)} for config in (ours, run.config))
    if config_hash(ours) == run.config_hash and only(here, _SEEDS) == only(there, _SEEDS):
        return cfg
    keys = [key for key in sorted(here.keys() | there.keys()) if here.get(key) != there.get(key)]
    said = ", ".join(
        f"{one_line(key)} ({one_line(str(there.get(key)))} in the record, {one_line(str(here.get(key)))} here)"
        for key in keys[:3]
    )
    commit = one_line(str(run.source.commit))[:9]
    raise ValueError(f"{source} is configured otherwise here, in {len(keys)} options: {said}; take commit {commit}")


def _check_data(cfg: DictConfig, run: RunDescription, source: Path) -> None:
    reader = reader_of(cfg)
    reader.read()  # says what is wrong with the log; makes a synthetic street
    if (found := reader.data_hash()) != run.data_hash:
        raise ValueError(
            f"{source} was made of data with the hash {one_line(run.data_hash)}, {reader.folder} has {found}: name "
            f"the folder of {one_line(run.scene)}, data.root=DIR"
        )


def _train(words: list[str]) -> None:
    from sparsestreet.cli.commands.train import train

    if status := train(words):
        raise SystemExit(status)


def _measure(
    bundle: Unpacked, number: int, run: RunDescription, cfg: DictConfig, out: Path, parts: tuple[str, ...]
) -> None:
    """Lay the run of a scene that the bundle has into a folder, and measure it there."""
    from sparsestreet.cli.commands.evaluate import Options, measure

    with atomic_folder(out) as folder:
        if not bundle.extract(number, SCENE, folder / SCENE):
            raise ValueError(f"{bundle.path} has no scenes: leave evaluate=true out, and row {number} is trained again")
        bundle.extract(number, TRACKS_FILE, folder / TRACKS_FILE)
        RUN.write(folder, run)
        (folder / CONFIGURATION).mkdir(exist_ok=True)
        OmegaConf.save(without_environment(cfg), folder / CONFIGURATION / "config.yaml")
    measure(Options(run=out, device="cpu" if cfg.trainer.accelerator == "cpu" else "cuda", parts=parts))


def pack_scene(run: Path, folder: Path) -> None:
    """Put the scene of a run, and what it has found, into another folder. Raises what opening a scene raises."""
    from sparsestreet.scene.storage import files_beside, load_scene
    from sparsestreet.scene.street_file import save_street

    save_street(folder / SCENE, load_scene(run), files_beside(run))
    if (run / TRACKS_FILE).is_file():
        (folder / TRACKS_FILE).parent.mkdir(exist_ok=True)
        (folder / TRACKS_FILE).write_bytes((run / TRACKS_FILE).read_bytes())
