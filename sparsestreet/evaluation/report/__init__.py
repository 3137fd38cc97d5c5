"""Tables and a figure of many runs, from their records alone (no torch import)."""

from sparsestreet.evaluation.report.collect import RunRecord, collect
from sparsestreet.evaluation.report.drawing import figure, markdown, tables
from sparsestreet.evaluation.report.sections import Row, Section, sections
from sparsestreet.evaluation.report.spread import Spread, spread
from sparsestreet.evaluation.report.variants import Variant, variants

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
