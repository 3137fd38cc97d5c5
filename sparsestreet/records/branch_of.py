"""``RUN/branch_of.json``: the run whose checkpoint this one began with, if it did not begin at step 0."""

import re
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import version


@dataclass(frozen=True, kw_only=True)
class BranchOf:
    """A run that has its first steps in common with this one."""

    format: int = version(1, "train the run again")
    run: str
    """Its folder, from this one; it need not be there any more."""
    label: str
    """Its column in a table."""
    moment: float
    """The fraction of the run before which the checkpoint was kept."""


BRANCH_OF = JsonFile("branch_of.json", BranchOf)


def kept_before(moment: float) -> str:
    """The name of the checkpoint that has the last step before what happens after a fraction of the run.

    >>> kept_before(0.93334)
    'before_0.93334.ckpt'
    """
    return f"before_{moment!r}.ckpt"


def moment_of(checkpoint: Path) -> float | None:
    """The fraction of the run before which a checkpoint was kept; None: it is another one.

    >>> moment_of(Path("checkpoints/before_0.6.ckpt")), moment_of(Path("checkpoints/last.ckpt"))
    (0.6, None)
    """
    found = re.fullmatch(r"before_([\d.e-]+)\.ckpt", checkpoint.name)
    return float(found[1]) if found else None
