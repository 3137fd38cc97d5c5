"""``sparsestreet report DIR ...``: tables from the records of runs."""

import sys
from pathlib import Path

from omegaconf import OmegaConf
from rich.console import Console

from sparsestreet.metrics.protocols import DRIVESTUDIO, PROTOCOLS, Protocol
from sparsestreet.records.strict_json import RecordError
from sparsestreet.report import collect, figure, markdown, sections, tables
from sparsestreet.report.arms import arms
from sparsestreet.report.figures_readme import time_figure
from sparsestreet.report.sweep import sweep_records, write_report

USAGE = """\
sparsestreet report DIR [DIR ...] [baseline=NAME] [sections=scenes|mean|all] [protocol=drivestudio|strict]
                            [markdown=FILE] [figure=FILE.png]
sparsestreet report sweep=DIR [protocol=drivestudio|strict] [figure=FILE.png]

Tables of all runs below the folders: one per scene, then the mean over scenes. Runs of one label and one configuration
are repeats and share a column; a label's other configurations have columns named by the options that differ. With a
baseline (label or name of a column), differences to it, paired by scene and seed. The figure shows PSNR against size.

Of a sweep (sparsestreet train +sweep=NAME) DIR/report is written: tables.md, tables.tex and tables.csv in the layout of
the paper, with its published figures in columns of their own, paired differences with intervals, the best arm at one
quality and at one size; figures; and index.html, all of it in one file for a browser. Its figure=FILE shows quality
against the seconds of training and the milliseconds of a frame.

The protocol chooses definitions: drivestudio as in published tables; strict counts 8 bits, leaves out the hood of the
recording car, takes the Gaussian window of SSIM, and both networks of LPIPS. A record holds all of them.
"""

OPTIONS = ("sweep", "baseline", "sections", "protocol", "markdown", "figure")
SECTIONS = ("scenes", "mean", "all")


def report(arguments: list[str]) -> int:
    """Print the tables; 2 on wrong usage, 1 if records are missing or malformed."""
    if "--help" in arguments:
        print(USAGE)
        return 0
    options, roots = {}, []
    for text in arguments:
        key, equals, value = text.partition("=")
        if equals and key in OPTIONS:
            options[key] = value
        else:
            roots.append(Path(text))
    wanted = options.get("sections", "all")
    protocol = PROTOCOLS.get(options.get("protocol", DRIVESTUDIO.name))
    if "sweep" in options and not roots and protocol is not None and options.keys() <= {"sweep", "protocol", "figure"}:
        return _report_sweep(Path(options["sweep"]), protocol, options.get("figure"))
    # A run's folder may have an equals sign in its name; what has one and is no folder is a slip.
    if (
        "sweep" in options
        or not roots
        or wanted not in SECTIONS
        or protocol is None
        or any("=" in str(root) and not root.exists() for root in roots)
    ):
        print(USAGE, file=sys.stderr)
        return 2
    try:
        records = collect(roots)
        found = sections(records, options.get("baseline"), protocol)
        if "figure" in options:
            figure(records, Path(options["figure"]))
    except (RecordError, FileNotFoundError, ValueError) as error:
        print(f"sparsestreet report: {error}", file=sys.stderr)
        return 1
    shown = [one for one in found if wanted in ("all", "mean" if one.over_scenes else "scenes")]
    if not shown:
        print("sparsestreet report: no configuration was run on two scenes, so there is no mean", file=sys.stderr)
        return 1
    console = Console()
    for part in tables(shown, console.width):
        console.print(part)
    if "markdown" in options:
        Path(options["markdown"]).write_text(markdown(shown))
    return 0


def _report_sweep(folder: Path, protocol: Protocol, picture: str | None) -> int:
    """Write the report of a sweep and say where; 1 if records are missing or malformed."""
    try:
        written = write_report(folder, sweep_name(folder), protocol)
        if picture is not None:
            time_figure(arms(sweep_records(folder)), protocol, Path(picture))
    except (RecordError, FileNotFoundError, ValueError) as error:
        print(f"sparsestreet report: {error}", file=sys.stderr)
        return 1
    for note in written.notes:
        print(note)
    print(f"{written.folder}: tables.md, tables.tex, tables.csv, figures, index.html")
    return 0


def sweep_name(folder: Path) -> str | None:
    """Which of conf/sweep a folder is of; None for any other sweep. ``NAME_paper`` adds rows to the folder of NAME."""
    path = folder / "multirun.yaml"
    name = OmegaConf.select(OmegaConf.load(path), "hydra.runtime.choices.sweep") if path.is_file() else None
    return name and name.removesuffix("_paper")
