"""The figure of quality against time."""

import pytest

from sparsestreet.metrics.protocols import DRIVESTUDIO
from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.figures_readme import _paint, time_figure
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, write_sweep


@pytest.mark.lengthy
@pytest.mark.parametrize("curves", [True, False])
def test_it_is_written_with_and_without_curves(tmp_path, curves):
    found = arms(collect([write_sweep(tmp_path / "sweep", curves=curves)]))
    time_figure(found, DRIVESTUDIO, tmp_path / "figures" / "time.png")
    assert (tmp_path / "figures" / "time.png").read_bytes().startswith(b"\x89PNG")


def test_without_held_out_views_there_is_none(tmp_path):
    found = arms([record(make_summary(psnr=None, training_psnr=20.0, split="none"))])
    with pytest.raises(ValueError, match="no run was evaluated on held-out views"):
        time_figure(found, DRIVESTUDIO, tmp_path / "time.png")


def test_arms_of_one_method_differ_in_color_and_those_of_several_by_method():
    one = arms([record(make_summary(label)) for label in ("a", "a+paper")])
    assert len({_paint(arm, one) for arm in one}) == 2
    several = [*one, *arms([record(make_summary("b"))])]
    assert len({_paint(arm, several) for arm in one}) == 1
    assert len({_paint(arm, several) for arm in several}) == 2
