"""Equal counts: what several passes leave, and the paper's rule and ours at a given number of each node."""

import pytest
import torch

from sparsestreet.pruning import Floors, ImportanceRule, LeaveOneOutRule, RenderContext
from sparsestreet.pruning.select import keep_counts
from tests.pruning.test_rules import CONTEXT, frame_of, scene_of


@pytest.mark.parametrize("keep", [0.512, 512, {"road": 512.0}])
def test_several_passes_leave_the_same_share_each_and_end_at_the_number(keep):
    """The cube root of 0.512 is 0.8."""
    rows = 1000
    for passed, left in enumerate((800, 640, 512)):
        context = RenderContext(passes=3, passed=passed)
        scores = torch.rand(rows, generator=torch.Generator().manual_seed(passed))
        selection = keep_counts({"road": scores}, keep, {"road": Floors(0)}, context)["road"]
        assert selection.keep.nonzero().squeeze(1).tolist() == sorted(scores.topk(left).indices.tolist())
        rows = left


def test_a_node_that_has_fewer_keeps_all():
    for passed in range(3):
        context = RenderContext(passes=3, passed=passed)
        kept = keep_counts({"road": torch.rand(5)}, {"road": 9, "trees": 2}, {"road": Floors(0)}, context)
        assert bool(kept["road"].keep.all())
    assert len(keep_counts({"road": torch.rand(0)}, 9, {"road": Floors(0)}, RenderContext())["road"].keep) == 0


def test_the_papers_rule_and_ours_keep_a_number_of_what_they_rank_highest():
    # Blend weights 0.3, 0.35, 0.28; without the first and the second the image changes by more than without the third.
    scene = scene_of([0.3, 0.5, 0.8], [2.0, 3.0, 4.0])
    frames = [frame_of(scene, offset=5)]
    for number, kept in ((2, [0, 1]), (1.001, [1])):
        selection = ImportanceRule(gate=False, keep={"background": number}).select(scene, frames, CONTEXT)
        assert selection["background"].keep.nonzero().squeeze(1).tolist() == kept
    # White discs over black: the image loses T_all * alpha / (1 - alpha) without one, most without the last.
    rule = LeaveOneOutRule(allowed_db=0.0, keep={"background": 2})
    assert rule.select(scene, frames, CONTEXT)["background"].keep.tolist() == [False, True, True]


def test_a_rule_that_keeps_and_removes_a_number_is_refused():
    with pytest.raises(ValueError, match="removes or keeps a number, got remove=3 and keep=4"):
        ImportanceRule(remove=3, keep=4)
    for make in (ImportanceRule, lambda **options: LeaveOneOutRule(0.1, **options)):
        with pytest.raises(ValueError, match="keep must be a fraction"):
            make(keep=-1)
