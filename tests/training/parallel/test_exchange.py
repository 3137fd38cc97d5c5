"""What processes tell each other: sums in order, gradients of rows that any saw, scenes that must be the same."""

from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, nn

from sparsestreet.pruning import LeaveOneOutRule, RenderContext
from sparsestreet.pruning.ranges import depth_costs
from sparsestreet.ranks import ALONE, LostProcessError, Ranks
from sparsestreet.scene.density import DensityStatistics
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.state import RenderOptions
from sparsestreet.training.adam import RowAdam
from sparsestreet.training.parallel import DisagreementError, check_agreement, checksum, exchange
from tests.training.parallel.several import PATIENCE, several
from tests.training.stubs import background, frame_at, rigid, set_rows

SIZE = 3
ORDERED = torch.tensor([[1e8, 1.0], [1.0, 2.0], [-1e8, 3.0]])
"""Values of three processes: in float32, 1e8 + 1 is 1e8, so that another order gives 1."""


def gradients(rank: int) -> list[Tensor | None]:
    """Of a table of which each process sees other rows, a number, a face alone, nothing, and an empty table."""
    table = torch.zeros(6, 2, 3)
    table[rank] = rank + 1.0
    table[4, 1, 2] = 0.5
    lone = torch.full((2,), 7.0) if rank == 1 else None
    return [table, torch.tensor(float(rank)), lone, None, torch.zeros(0, 3)]


SHAPES = [(6, 2, 3), (), (2,), (4,), (0, 3)]


class Counted(Ranks):
    """Writes down how many numbers travel."""

    def sum(self, values: Tensor) -> Tensor:
        travelled.append(values.numel())
        return super().sum(values)


travelled: list[int] = []


def scene(difference: float = 0.0) -> SceneGraph:
    nodes = {"road": background(5), "cars": rigid(4)}
    if difference:
        set_rows(nodes["cars"], "opacity_logits", {2: difference})
    return SceneGraph(nodes)


def scores(ranks: Ranks) -> dict[str, Tensor]:
    """What pruning decides from: costs of rows, and the floors of the objects, by all views."""
    street = SceneGraph({"road": background(12), "cars": rigid(8, min_instance_gaussians=600.0)})
    set_rows(street.nodes["cars"], "opacity_logits", {1: 9.0})
    frames = [frame_at(index, 16 + 8 * index, 16) for index in range(5)]
    # From a meter to 30 across each image, so that some are right; the last view is without lidar.
    depths = [torch.linspace(1.0, 30.0, 16 + 8 * index).expand(16, -1) for index in range(4)]
    frames = [replace(frame, depth=depth) for frame, depth in zip(frames, [*depths, None], strict=True)]
    context = RenderContext(options=RenderOptions(), ranks=ranks)
    rule = LeaveOneOutRule(allowed_db=0.1)
    floors = rule.floors(street, frames, context)["cars"].instances
    assert floors is not None
    costs = rule.costs(street, frames, context) | {"floors": floors.least}
    return costs | {f"depth of {name}": cost for name, cost in depth_costs(street, frames, context).items()}


def statistics_of(rank: int) -> DensityStatistics:
    statistics = DensityStatistics(3, watched=["peaks"])
    radii = torch.tensor([[4.0, 0.0, 1.0], [2.0, 0.0, 8.0], [0.0, 0.0, 3.0]])[rank]
    statistics.add(torch.full((3, 2), rank + 1.0), radii, 16, 16, {"peaks": torch.full((3,), 2.0**rank)})
    return statistics


def refused_of(ranks: Ranks) -> dict[str, Tensor]:
    """What a step refuses where one process has a NaN in a row that others saw too."""
    rows = nn.Parameter(torch.ones(5, 3))
    rows.grad = torch.zeros(5, 3)
    rows.grad[1:4] = ranks.rank + 1.0
    if ranks.rank == 1:
        rows.grad[2, 1] = torch.nan
    optimizer = RowAdam([{"params": [rows], "lr": 0.5}])
    exchange([rows], ranks)
    optimizer.step()
    assert optimizer.refused is not None
    return {"counts": optimizer.refused.counts, "rows": rows.detach()}


def talk(rank: int) -> dict[str, Any]:
    """All that is asked of three processes, in one go; the last dies at the end."""
    dist.init_process_group("gloo", rank=rank, world_size=SIZE, timeout=timedelta(seconds=PATIENCE))
    ranks, said = Counted(rank, SIZE, lambda: "after step 7"), {}
    parameters = [nn.Parameter(torch.ones(shape)) for shape in SHAPES]
    for parameter, gradient in zip(parameters, gradients(rank), strict=True):
        parameter.grad = gradient
    said["word"] = exchange(parameters, ranks, word=[0, 15, 2][rank])
    said["travelled"] = travelled[:]
    said["gradients"] = [parameter.grad for parameter in parameters]
    said["sum"] = ranks.sum(ORDERED[rank].clone())
    said["largest"] = ranks.largest(torch.tensor([rank, -rank]))
    said["gathered"] = ranks.gathered(f"process {rank}")
    said["scores"] = scores(ranks)
    said["refused"] = refused_of(Ranks(rank, SIZE))
    statistics = statistics_of(rank)
    statistics.total(ranks)
    said["statistics"] = statistics.state_dict()
    check_agreement(scene(), ranks)
    try:
        check_agreement(scene(0.25 if rank == 1 else 0.0), ranks)
    except DisagreementError as error:
        said["differ"] = str(error)
    if rank < 2:
        try:
            ranks.sum(torch.ones(3))
        except LostProcessError as error:
            said["lost"] = str(error)
    return said


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder: Path = tmp_path_factory.mktemp("answers")
    return several(SIZE, talk, folder)


def test_gradients_are_summed_over_the_processes(answers):
    dense = [[one if one is not None else torch.zeros(shape) for one, shape in zip(gradients(r), SHAPES, strict=True)]
             for r in range(SIZE)]  # fmt: skip
    expected = [torch.stack(parts).sum(0) for parts in zip(*dense, strict=True)]
    for answer in answers:
        for index, (got, wanted) in enumerate(zip(answer["gradients"], expected, strict=True)):
            if index == 3:
                assert got is None  # no process has one: Adam must not count the step
            else:
                assert torch.equal(got, wanted)


def test_only_rows_that_some_process_saw_travel(answers):
    """Rows 0, 1, 2 and 4 of the table, six numbers each; the number; the two of the face."""
    assert [answer["travelled"] for answer in answers] == [[4 * 6 + 1 + 2]] * SIZE


def test_the_largest_word_travels_along(answers):
    assert [answer["word"] for answer in answers] == [15] * SIZE


def test_sums_have_the_order_of_the_processes(answers):
    in_order = (ORDERED[0] + ORDERED[1]) + ORDERED[2]
    assert in_order.tolist() == [0.0, 6.0]
    for answer in answers:
        assert torch.equal(answer["sum"], in_order)
        assert answer["largest"].tolist() == [2, 0]
        assert answer["gathered"] == ["process 0", "process 1", "process 2"]


def test_a_gradient_that_is_not_finite_in_one_process_is_refused_by_all(answers):
    """Adam's first step is one rate."""
    for answer in answers:
        assert answer["refused"]["counts"].tolist() == [[1, 2]]
        assert answer["refused"]["rows"][:, 0].tolist() == pytest.approx([1.0, 0.5, 1.0, 0.5, 1.0])


def test_pruning_scores_views_together(answers):
    """Costs are sums of float64 over other groups of views."""
    alone = scores(ALONE)
    assert alone["floors"].tolist() == [3, 4]  # by the widest image, which the second process looks at
    for answer in answers:
        assert torch.equal(answer["scores"]["floors"], alone["floors"])
        assert (alone["depth of road"] > 0).sum() > 1
        for node in ("road", "cars", "depth of road", "depth of cars"):
            torch.testing.assert_close(answer["scores"][node], alone[node], rtol=1e-6, atol=0)


def test_statistics_are_those_of_all_views(answers):
    """By hand: radii over the longer side of 16 pixels, norms of (1, 1), (2, 2) and (3, 3) times half the image."""
    for answer in answers:
        found = answer["statistics"]
        assert found["visits"].tolist() == [2, 0, 3]
        assert found["largest_screen"].tolist() == [4 / 16, 0.0, 8 / 16]
        assert found["gradient_sum"].tolist() == pytest.approx([3 * 8 * 2**0.5, 0.0, 6 * 8 * 2**0.5])
        assert found["watched"]["peaks"].tolist() == [3.0, 0.0, 7.0]


def test_scenes_that_differ_in_a_bit_stop_all_and_name_the_node(answers):
    for rank, answer in enumerate(answers):
        assert answer["differ"].startswith(f"after step 7: 'cars' differs between process {rank} (4 Gaussians)")


def test_a_process_that_ends_is_named_in_one_sentence(answers):
    for rank in range(2):
        lost = answers[rank]["lost"]
        assert "\n" not in lost
        assert lost.startswith(
            f"after step 7: one of the 3 processes that train together no longer answers process {rank}"
        )
        assert "resume=RUN" in lost
    assert "lost" not in answers[2]


def test_a_checksum_tells_two_parameters_that_change_places():
    first, second = torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, 4.0]])

    def module(*weights: Tensor) -> nn.Module:
        return nn.ParameterList([nn.Parameter(weight) for weight in weights])

    assert bool(checksum(module(first, second)) == checksum(module(first, second)))
    assert bool(checksum(module(first, second)) != checksum(module(second, first)))


def test_alone_nothing_is_shared():
    values = torch.tensor([1.0, 2.0])
    assert ALONE.sum(values) is values
    assert ALONE.largest(values) is values
    assert ALONE.gathered(3) == [3]
    assert ALONE.share([1, 2]) == [1, 2]
    assert [list(Ranks(rank, 3).share([0, 1, 2, 3])) for rank in range(3)] == [[0, 3], [1], [2]]
    check_agreement(scene(), ALONE)
