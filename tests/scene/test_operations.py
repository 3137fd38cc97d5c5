"""How much a scene asks of the host: dispatched operations, which do not grow with what is in it."""

from collections import Counter

import pytest
import torch

from sparsestreet.bench.step import CountedOperations
from sparsestreet.phases import PhaseRecorder, WallClock
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from tests.scene.street import background, degree, keyframes, pose, random_rows, rigid, static_mask, track, view_at
from tests.typed import as_a


def street(instances: int, masked: bool) -> SceneGraph:
    tracks = [track(str(i), [0, 1], [pose(0.1 * i, (i, 0, 0)), pose(0.2, (i, 1, 0))]) for i in range(instances)]
    of_rows = torch.arange(instances).repeat_interleave(3)
    mask = static_mask() if masked else None
    road = background(random_rows(5, 0, mask=mask), mask)
    cars = rigid(random_rows(len(of_rows), 1, instances=of_rows, dtype=torch.float32), keyframes(tracks, 2))
    return SceneGraph({"road": road, "cars": cars})


def operations(scene: SceneGraph) -> int:
    """Of activation and its backward."""
    recorder, counts = PhaseRecorder(WallClock()), Counter()
    recorder.start()
    with CountedOperations(recorder, counts):
        placed = scene.gaussians_at(view_at(0.5), degree(3)).gaussians
        fields = (placed.means, placed.scales, placed.dense_sh())
        torch.stack([(field * field).sum() for field in fields]).sum().backward()
    recorder.stop()
    return sum(counts.values())


@pytest.mark.parametrize("masked", [False, True])
def test_operations_do_not_grow_with_the_number_of_instances(masked):
    few, many = (street(instances, masked) for instances in (2, 40))
    assert operations(few) == operations(many) > 10
    assert as_a(Rigid, many.nodes["cars"]).rotation_deltas.grad.abs().sum() > 0
