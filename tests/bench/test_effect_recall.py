"""Effects that are planted in streets, and the table of what plans see of them."""

from benchmarks import effect_recall
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.records.run import EffectDecision
from tests.bench.test_records import PROVENANCE


def decision(name: str, on: bool) -> EffectDecision:
    return EffectDecision(
        name=name, on=on, source="measured", reason="", value=None, unit="", threshold=None, noise=None, numbers=0,
        ms=0.0, gain=None,
    )  # fmt: skip


def test_a_plan_that_misses_an_effect_is_wrong(tmp_path):
    """A plan that sees everything but the hood: each street with a hood is wrong, and no other."""
    seen = {"lens": "lens=[-0.038", "shutter": "readout=0.018", "exposure": "exposure_walk=0.18"}

    def plan(options):
        words = " ".join(options)
        on = {name for name, word in seen.items() if word in words}
        on |= {"exposure"} if "white_balance=0.18" in words else set()
        on |= {"camera_poses"} if "pose_noise=[0.12" in words else set()
        on |= {"box_poses"} if "box_noise=[0.038" in words else set()
        on |= set() if "tunnel=true" in words else {"sky"}
        names = ("sky", "hood", *seen, "camera_poses", "box_poses")
        return [decision(name, name in on) for name in names]

    file, said = RecordFile(tmp_path / "effects.jsonl", PROVENANCE), []
    asked = effect_recall.run_planted(plan, [0], file, said.append)
    assert [one.planted for one in asked if not one.right] == ["hood", "three at once"]
    assert len(read_records(file.path)) == len(asked) == 2 * len(effect_recall.PLANTS) + 3
    assert "| hood | 2 | 1 | **1** | **0** | 0 | 0 | 0 | 0 | 0 |" in said
