"""``sparsestreet report DIR ...``: tables from the records of runs."""

import sys
from pathlib import Path

from rich.console import Console

from sparsestreet.evaluation.report import collect, figure, markdown, sections, tables
from sparsestreet.evaluation.strict_json import RecordError
from sparsestreet.metrics.protocols import DRIVESTUDIO, PROTOCOLS

USAGE = """\
sparsestreet report DIR [DIR ...] [baseline=NAME] [sections=scenes|mean|all] [protocol=drivestudio|strict]
                            [markdown=FILE] [figure=FILE.png]

Tables of all runs below the folders: one per scene, then the mean over scenes. Runs of one label and one configuration
are repeats and share a column; a label's other configurations have columns named by the options that differ. With a
baseline (label or name of a column), differences to it, paired by scene and seed. The figure shows PSNR against size.

The protocol chooses definitions: drivestudio as in published tables; strict counts 8 bits, leaves out the hood of the
recording car, takes the Gaussian window of SSIM, and both networks of LPIPS. A record holds all of them.
"""

OPTIONS = ("baseline", "sections", "protocol", "markdown", "figure")
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
    # A run's folder may have an equals sign in its name; what has one and is no folder is a slip.
    protocol = PROTOCOLS.get(options.get("protocol", DRIVESTUDIO.name))
    if (
        not roots
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
