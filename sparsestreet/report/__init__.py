"""Tables and a figure that compare many runs, made from their records alone."""

from sparsestreet.report.collect import RunRecord, collect
from sparsestreet.report.drawing import figure, markdown, tables
from sparsestreet.report.sections import Row, Section, sections
from sparsestreet.report.spread import Spread, spread
from sparsestreet.report.variants import Variant, variants

__all__ = [
    "Row",
    "RunRecord",
    "Section",
    "Spread",
    "Variant",
    "collect",
    "figure",
    "markdown",
    "sections",
    "spread",
    "tables",
    "variants",
]
