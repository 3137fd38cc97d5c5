"""``RUN/same_as.json``: where the run of this folder was trained, if a job of another sweep did."""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import version


@dataclass(frozen=True, kw_only=True)
class SameAs:
    """A run whose files were taken instead of training it once more."""

    format: int = version(1, "run the sweep again")
    run: str
    """Its folder, from this one; it need not be there any more."""
    label: str
    """The column that it has in its own sweep."""
    command: str
    """The command that trained it."""


SAME_AS = JsonFile("same_as.json", SameAs)
