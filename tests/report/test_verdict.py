"""The sentence on top of a sweep's page, against numbers worked out by hand."""

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO
from sparsestreet.report.arms import arms
from sparsestreet.report.verdict import verdict
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record


def runs(label: str, psnr: list[float], gaussians: int, **changes):
    return [
        make_summary(label, seed, value, {"background": gaussians}, scene=f"street {seed}", **changes)
        for seed, value in enumerate(psnr)
    ]


def said(*made):
    return verdict(arms([record(run, f"{run.run.label}{run.run.seed}") for some in made for run in some]), DRIVESTUDIO)


PLAIN = runs("m", [25.0, 26.0, 27.0], 1000)
GOOD = runs("m+removal", [24.9, 25.8, 26.7], 400)
"""-0.1, -0.2, -0.3: t(2) = 4.303, sd 0.1, so 0.248 to each side."""
SMALLEST = runs("m+masks", [24.5, 25.5, 26.5], 100)
"""-0.5 each."""


def test_the_smallest_arm_within_the_loss():
    larger = runs("m+paper", [25.0, 26.0, 27.0], 500)
    assert said(PLAIN, GOOD, SMALLEST, larger) == (
        "m: of 3 arms the smallest within 0.3 dB is m+removal, with 40 % of the Gaussians, -0.20 dB [-0.45, +0.05] of "
        "held-out PSNR, n = 3.",
        "Intervals that reach beyond 0.3 dB: m+removal. More scenes or seeds may change this.",
    )


def test_none_is_within_the_loss():
    assert said(PLAIN, SMALLEST) == (
        "m: none is smaller within 0.3 dB; m+masks has 10 % of the Gaussians, -0.50 dB [-0.50, -0.50] of held-out "
        "PSNR, n = 3.",
    )


def test_two_pairs_say_nothing():
    assert said(PLAIN[:2], GOOD[:2]) == ()
    assert said(PLAIN, GOOD[1:]) == ()  # of three seeds the arm has two
    assert said(PLAIN) == ()
    assert said(GOOD) == ()


def test_a_larger_arm_and_a_control_are_not_chosen():
    larger, control = runs("m+masks", [25.0, 26.0, 27.0], 1100), runs("m+random", [25.0, 26.0, 27.0], 50)
    (sentence,) = said(PLAIN, larger, control)
    assert sentence.startswith("m: none is smaller within 0.3 dB; m+masks has 110 % of the Gaussians")


def test_a_limit_of_the_plain_run_is_named():
    found = said(runs("m", [25.0, 26.0, 27.0], 1000, caps={"background": 1000}), GOOD)
    assert found[-1] == "A limit ended the growth of m: shares of it are shares of that limit."


@pytest.mark.parametrize("label", ["a", "b"])
def test_each_method_has_its_sentence(label):
    others = [run for name in ("a", "b") for run in runs(name, [25.0, 26.0, 27.0], 1000)]
    smaller = [run for name in ("a", "b") for run in runs(f"{name}+removal", [25.0, 26.0, 27.0], 500)]
    found = said(others, smaller)
    assert [sentence[0] for sentence in found] == ["a", "b"]
    assert f"{label}: the smallest within 0.3 dB is {label}+removal, with 50 %" in found["ab".index(label)]
