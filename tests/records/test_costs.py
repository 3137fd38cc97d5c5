"""cost.json: round trip, who writes what, and what is made of stages and noted steps."""

import json
import mmap

import pytest
import torch

from sparsestreet.evaluation.speed import forget_peaks, peak_megabytes
from sparsestreet.records.costs import (
    COSTS,
    STEP_PHASES,
    CostRecord,
    EffectGain,
    NodeCost,
    StepPhase,
    stage_costs,
    step_costs,
    update_costs,
)
from sparsestreet.records.strict_json import RecordError
from tests.evaluation.frames import NOISE

MEASURED = CostRecord(
    wall_seconds=100.0,
    phases={"data": 30.0, "train": 69.5, "other": 0.5},
    step_ms={"splat": 3.5},
    passes={"ImportanceRule at step 28000": 2.5},
    peak_host_mb=812.5,
    frame_ms={"splat": 2.0, "output": 0.5},
    nodes={"background": NodeCost(1000, 0.236, 0.75, 1.75)},
    effects={"sky": 0.25},
    noise=NOISE,
)


@pytest.mark.parametrize("wall", [97.0, 103.0])
def test_phases_that_are_not_the_wall_clock_are_refused(tmp_path, wall):
    path = COSTS.path(tmp_path)
    COSTS.write(tmp_path, MEASURED)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"wall_seconds": wall}))
    with pytest.raises(RecordError, match=f"the phases are 100 s of {wall:g} s of wall clock"):
        COSTS.read(tmp_path)


def test_training_and_evaluation_keep_each_others_parts(tmp_path):
    update_costs(tmp_path, nodes=MEASURED.nodes, effects=MEASURED.effects, frame_ms=MEASURED.frame_ms, noise=NOISE)
    alone = COSTS.read(tmp_path)
    assert (alone.nodes, alone.wall_seconds, alone.phases) == (MEASURED.nodes, None, {})
    update_costs(
        tmp_path,
        wall_seconds=100.0,
        phases=MEASURED.phases,
        step_ms=MEASURED.step_ms,
        passes=MEASURED.passes,
        peak_host_mb=MEASURED.peak_host_mb,
    )
    assert COSTS.path(tmp_path) == tmp_path / "records" / "cost.json"
    assert COSTS.read(tmp_path) == MEASURED
    # A record from before gains were measured has none.
    update_costs(tmp_path, gains={"sky": EffectGain(1.0, None, 2.0, 3)})
    assert COSTS.read(tmp_path).gains == {"sky": EffectGain(1.0, None, 2.0, 3)}
    entries = json.loads(COSTS.path(tmp_path).read_text())
    del entries["gains"]
    COSTS.path(tmp_path).write_text(json.dumps(entries))
    assert COSTS.read(tmp_path).gains == {}


def test_stages_become_phases_and_passes():
    seconds = {"train": 5.0, "prune/Rule at step 7": 1.0, "prune/Rule at step 9": 2.0, "other": 0.25}
    phases, passes = stage_costs(seconds)
    assert phases == {"train": 5.0, "prune": 3.0, "other": 0.25}
    assert passes == {"Rule at step 7": 1.0, "Rule at step 9": 2.0}


def test_steps_are_medians_of_parts(tmp_path):
    """Losses and backward passes are sums within a step; a part counts in the steps that have it."""
    assert step_costs(tmp_path) == {}
    rows = [
        *((1, name, ms) for name, ms in (("loss l1", 1), ("loss sky", 2), ("backward", 4), ("splat backward", 8))),
        *((1, name, ms) for name, ms in (("scene backward", 16), ("sky backward", 32), ("ssim backward", 64))),
        *((1, name, ms) for name, ms in (("loop", 0.5), ("logging", 0.25), ("density statistics", 16))),
        *((2, name, ms) for name, ms in (("loss l1", 5), ("backward", 14), ("loop", 0.25))),
    ]
    STEP_PHASES.write(tmp_path, [StepPhase(step, name, float(ms)) for step, name, ms in rows])
    assert STEP_PHASES.path(tmp_path).read_text().splitlines()[:2] == ["step,phase,milliseconds", "1,loss l1,1.0000"]
    assert step_costs(tmp_path) == {"losses": 4.0, "backward": 69.0, "loop": 0.5, "density": 16.0}


@pytest.mark.lengthy
def test_a_peak_is_seen_and_forgotten():
    """Pages of the system's: an allocator may keep what is freed (``keep_freed_memory`` asks it to)."""
    forget_peaks()
    before, on_device = peak_megabytes(torch.device("cpu"))
    with mmap.mmap(-1, 400_000_000) as pages:
        for page in range(0, len(pages), mmap.PAGESIZE):
            pages[page] = 1
        during = peak_megabytes(torch.device("cpu"))[0]
    assert on_device is None
    assert 380 < during - before < 420  # the kernel counts pages in batches for each thread
    forget_peaks()
    after = peak_megabytes(torch.device("cpu"))[0]
    assert after < during - 380 or not _peaks_can_be_forgotten()


def _peaks_can_be_forgotten() -> bool:
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        return False
    return True
