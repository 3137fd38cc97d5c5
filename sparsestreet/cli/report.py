"""``sparsestreet report DIR ...``: tables from the records of runs."""

import sys
from pathlib import Path

from rich.console import Console

from sparsestreet.evaluation.report import collect, markdown, tables
from sparsestreet.evaluation.strict_json import RecordError

USAGE = """\
sparsestreet report DIR [DIR ...] [baseline=NAME] [markdown=FILE]

One table per scene of all runs below the folders; with a baseline, differences to it, paired by seed.
"""


def report(arguments: list[str]) -> int:
    """Print the tables; 2 on wrong usage, 1 if records are missing or malformed."""
    options = dict(text.split("=", 1) for text in arguments if "=" in text)
    roots = [Path(text) for text in arguments if "=" not in text and not text.startswith("-")]
    if not roots or set(options) - {"baseline", "markdown"}:
        print(USAGE)
        return 0 if "--help" in arguments else 2
    try:
        records = collect(roots)
        drawn = tables(records, options.get("baseline"))
    except (RecordError, FileNotFoundError, ValueError) as error:
        print(f"sparsestreet report: {error}", file=sys.stderr)
        return 1
    for table in drawn:
        Console().print(table)
    if "markdown" in options:
        Path(options["markdown"]).write_text(markdown(records, options.get("baseline")))
    return 0
