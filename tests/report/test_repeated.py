"""What counts as noise when a run is made again."""

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.repeated import Comparison, comparisons, repeats_of, verdict
from tests.evaluation.frames import make_summary


def psnr_of(recorded: RunSummary, found: RunSummary, *others: RunSummary) -> Comparison:
    return next(one for one in comparisons(recorded, found, others, DRIVESTUDIO) if one.quantity.name == "PSNR")


def seeds(*psnr: float, **more) -> list[RunSummary]:
    return [make_summary("plain", seed, value, **more) for seed, value in enumerate(psnr)]


@pytest.mark.parametrize(("found", "holds"), [(25.0, True), (25.049, True), (24.951, True), (25.06, False)])
def test_alone_the_stated_noise_counts(found, holds):
    assert psnr_of(*seeds(25.0), make_summary(psnr=found)).holds is holds


def test_other_seeds_say_what_noise_is_and_the_row_itself_does_not():
    """Their standard deviation is 0.1 dB; that of all three, with the row that was changed by 0.5 dB, 0.35 dB."""
    recorded, *others = seeds(25.5, 25.0, 25.2, 25.1)
    one = psnr_of(recorded, make_summary(psnr=25.0), *others)
    assert (one.repeats, one.holds) == (3, False)
    assert one.noise == pytest.approx(2 * 2**0.5 * 0.1)
    assert psnr_of(recorded, make_summary(psnr=25.25), *others).holds


def test_one_other_seed_and_a_small_spread_say_nothing():
    recorded, *others = seeds(25.0, 27.0)
    assert psnr_of(recorded, recorded, *others).noise == 0.05
    recorded, *others = seeds(25.0, 27.0, 27.001)
    assert (psnr_of(recorded, recorded, *others).noise, psnr_of(recorded, recorded, *others).repeats) == (0.05, 0)


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 0},
        {"label": "ours"},
        {"scene": "b"},
        {"data_hash": "ba9876543210"},
        {"split": "none"},
        {"config": {"a": 1}},
        {"config": {"data.log.first_frame": 5}},
    ],
    ids=lambda other: next(iter(other)),
)
def test_a_repeat_differs_in_its_seed_alone(other):
    run = make_summary("plain", 0)
    assert repeats_of(run, [make_summary("plain", 1)])
    assert not repeats_of(run, [make_summary(**{"label": "plain", "seed": 1, **other})])


def test_counts_and_bytes_count_by_their_part_and_a_lost_number_does_not_hold():
    recorded = make_summary(gaussians={"background": 1000})
    found = make_summary(gaussians={"background": 1019}, vehicle_psnr=None)
    said = {one.quantity.name: one for one in comparisons(recorded, found, (), DRIVESTUDIO)}
    assert said.keys() == {"PSNR", "vehicles", "SSIM", "Gaussians", "MB"}  # neither has people
    assert [name for name, one in said.items() if not one.holds] == ["vehicles"]
    fewer = make_summary(gaussians={"background": 979})
    assert [one.quantity.name for one in comparisons(recorded, fewer, (), DRIVESTUDIO) if not one.holds] == [
        "Gaussians",
        "MB",
    ]


def test_the_verdict_is_one_line():
    recorded, again = seeds(25.5, 25.0)
    line = verdict(recorded, again, comparisons(recorded, again, (), DRIVESTUDIO), trained=True)
    assert "PSNR 25.000 dB, recorded 25.500 dB (± 0.050 dB): DOES NOT HOLD; vehicles 22.000 dB, as recorded" in line
    assert line.endswith("does not hold, not to the bit, on the same machine and commit")
    assert "\n" not in verdict(make_summary("a\n"), again, (), trained=True)
