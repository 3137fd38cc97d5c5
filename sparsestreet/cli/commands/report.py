"""``sparsestreet report DIR ...``: tables from the records of runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import yaml
from rich.console import Console

from sparsestreet.cli.commands.options import run_command
from sparsestreet.files import read_yaml
from sparsestreet.metrics.definitions import PROTOCOLS, Protocol
from sparsestreet.report.bundle import write_bundle
from sparsestreet.report.collect import collect, keep_records
from sparsestreet.report.figures import time_figure
from sparsestreet.report.sections import section_tables, sections, sections_markdown
from sparsestreet.report.sweep import sweep_records, write_report
from sparsestreet.report.variants import variants

USAGE = """\
sparsestreet report DIR [DIR ...] [baseline=NAME] [protocol=drivestudio|strict] [markdown=FILE] [records=FILE.jsonl]
sparsestreet report sweep=DIR [protocol=drivestudio|strict] [figure=FILE.png]
sparsestreet report DIR|sweep=DIR bundle=FILE.zip [scenes=true]
sparsestreet report verify FILE.zip [row=NUMBER]

Tables of all runs below the folders: one per scene, then the mean over scenes. Runs of one label and one configuration
are repeats and share a column; a label's other configurations have columns named by the options that differ. With a
baseline (label or name of a column), differences to it, paired by scene and seed.
records=FILE writes a line of JSON for each run or job: what made it, and what was measured. scripts/check_numbers.py
compares a page's numbers with such a file.

Of a sweep (sparsestreet train +sweep=NAME) DIR/report is written: tables.md, tables.tex and tables.csv in the layout of
the paper, with its published figures in columns of their own, paired differences with intervals, the best arm at one
quality and at one size; figures; and index.html, all of it in one file for a browser. Its figure=FILE shows quality
against the seconds of training and the milliseconds of a frame.

bundle=FILE.zip writes records and tables for others, who check them, and train a row again, with report verify; with
scenes, each run's scene goes along. Folders of this machine are left out.

The protocol chooses definitions: drivestudio as in published tables; strict counts 8 bits, leaves out the hood of the
recording car, takes the Gaussian window of SSIM, and both networks of LPIPS. A record holds all of them.
"""


@dataclass(frozen=True)
class ReportRequest:
    """The command's options. Raises ValueError where they contradict each other."""

    folders: tuple[Path, ...] = ()
    sweep: Path | None = None
    baseline: str | None = None
    protocol: Literal["drivestudio", "strict"] = "drivestudio"
    markdown: Path | None = None
    figure: Path | None = None
    records: Path | None = None
    bundle: Path | None = None
    scenes: bool = False

    def __post_init__(self) -> None:
        if bool(self.folders) == (self.sweep is not None):
            raise ValueError("name folders of runs, or sweep=DIR: one of both")
        if self.sweep is not None and (self.baseline or self.markdown):
            raise ValueError("a sweep's report has all tables: sweep=DIR goes with protocol, figure, records, bundle")
        if self.sweep is None and self.figure is not None:
            raise ValueError("the figure is of a sweep: say sweep=DIR, or leave figure out")
        if self.scenes and self.bundle is None:
            raise ValueError("scenes go into a bundle: say bundle=FILE.zip")
        if self.bundle is not None and self.bundle.suffix != ".zip":
            raise ValueError(f"bundle must end in .zip, got {self.bundle.name!r}")


def report(arguments: list[str]) -> int:
    """Print the tables; 2 on wrong usage, 1 if records are missing or malformed."""
    if arguments[:1] == ["verify"]:
        from sparsestreet.cli.commands.verify import verify  # torch, once a row is trained

        return verify(arguments[1:])
    return run_command("report", USAGE, arguments, ReportRequest, _report, positional="folders")


def _report(request: ReportRequest) -> None:
    protocol = PROTOCOLS[request.protocol]
    if request.records is not None:
        keep_records(collect(request.folders or [request.sweep or Path()]), request.records)
        print(f"{request.records}: a line for each run")
    if request.bundle is not None:
        _write_bundle(request, request.bundle)
    if request.sweep is not None:
        _report_sweep(request.sweep, protocol, request.figure)
        return
    found = sections(collect(request.folders), request.baseline, protocol)
    console = Console()
    for part in section_tables(found, console.width):
        console.print(part)
    if request.markdown is not None:
        request.markdown.write_text(sections_markdown(found))


def _report_sweep(folder: Path, protocol: Protocol, picture: Path | None) -> None:
    """Write the report of a sweep and say where."""
    written = write_report(folder, sweep_name(folder), protocol)
    if picture is not None:
        time_figure(variants(sweep_records(folder)), protocol, picture)
    for sentence in (*written.notes, *written.summary_line):
        print(sentence)
    print(f"{written.folder}: tables.md, tables.tex, tables.csv, figures, index.html")


def _write_bundle(request: ReportRequest, path: Path) -> None:
    from sparsestreet.cli.commands.verify import pack_scene  # torch, where scenes are packed

    sweep = request.sweep
    size = write_bundle(
        records := collect(request.folders) if sweep is None else sweep_records(sweep),
        path,
        protocol=request.protocol,
        baseline=request.baseline,
        of_sweep=sweep is not None,
        sweep=None if sweep is None else sweep_name(sweep),
        pack=pack_scene if request.scenes else None,
    )
    print(f"{path}: {len(records)} runs, {size / 1e6:.2f} MB; sparsestreet report verify {path} checks it")


def sweep_name(folder: Path) -> str | None:
    """Which of conf/sweep a folder is of; None for any other sweep. ``NAME_paper`` and ``NAME_others`` add rows to
    the folder of NAME."""
    path = folder / "multirun.yaml"
    name = read_yaml(path, yaml.safe_load) if path.is_file() else None
    for key in ("hydra", "runtime", "choices", "sweep"):
        name = name.get(key) if isinstance(name, dict) else None
    return name and name.removesuffix("_paper").removesuffix("_others")
