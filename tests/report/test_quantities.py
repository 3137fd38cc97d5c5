"""Which definitions a protocol puts into a table."""

import dataclasses

from sparsestreet.metrics.definitions import DEFINITIONS, DRIVESTUDIO, STRICT
from sparsestreet.records.quality import HELD_OUT, MetricSummary
from sparsestreet.report import sections
from tests.evaluation.frames import make_summary
from tests.report.test_sections import cells, records


def shown(summary, protocol):
    (section,) = sections(records(summary), protocol=protocol)
    return {heading: cell.mean for heading, cell in cells(section.rows[0], section).items() if cell is not None}


def test_a_protocol_chooses_the_columns():
    """Every metric has a value of its own."""
    values = {name: float(place) for place, name in enumerate(DEFINITIONS, start=1)}
    quality = {HELD_OUT: {name: MetricSummary(value, 0.0, 6, 0) for name, value in values.items()}}
    summary = dataclasses.replace(make_summary(), quality=quality)
    headings = ("vehicle PSNR", "vehicle SSIM", "human PSNR", "human SSIM")
    for protocol, lpips in ((DRIVESTUDIO, ("LPIPS alex",)), (STRICT, ("LPIPS alex", "LPIPS vgg"))):
        found = shown(summary, protocol)
        names = (*("PSNR", "SSIM"), *lpips, *headings)
        metrics = (protocol.psnr, protocol.ssim, *protocol.lpips, *protocol.vehicle, *protocol.human)
        assert {name: found[name] for name in names} == {
            name: values[metric] for name, metric in zip(names, metrics, strict=True)
        }
        assert found["near PSNR"] == values["psnr_near_lidar"]
    assert "LPIPS vgg" not in shown(summary, DRIVESTUDIO)
