"""What effects add to frames, beside predictions."""

import pytest
import torch

from sparsestreet.bench import costs
from sparsestreet.bench.costs import Street, run_costs
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import TimingBudget
from sparsestreet.scene.effects import AffineSettings, Cost, HoodSettings, LensSettings, Sky, SkySettings
from sparsestreet.types import View
from tests.bench.test_records import PROVENANCE
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import small_scene
from tests.scene.street import training_data

EFFECTS = {
    "hood": HoodSettings(when="on"),
    "sky": SkySettings(when="on", resolution=2),
    "lens": LensSettings(when="on"),
    "affine": AffineSettings(when="on"),
}
ONCE = TimingBudget(repeats=3, least=1)


def street() -> Street:
    frame = make_frame()
    return Street(dict(small_scene().nodes.items()), View(frame.camera, frame.time, *frame.indices))


def test_images_in_sizes_and_rows_in_numbers(tmp_path):
    """What a scene has no part of (a hood) costs nothing; what acts on images is timed on the trained street."""
    file, said = RecordFile(tmp_path / "costs.jsonl", PROVENANCE), []
    sizes = (Size(24, 16, 50), Size(24, 16, 100))
    made = run_costs(EFFECTS, training_data(), street(), (1.0, 2.0), sizes, ONCE, file, said.append)
    camera = street().view.camera
    assert [(one.effect, one.width, one.rows) for one in made] == [
        *(("sky", width, 4) for width in (camera.width, 2 * camera.width)),
        *(("lens", 24, rows) for rows in (50, 100)),
        *(("affine", width, 4) for width in (camera.width, 2 * camera.width)),
    ]
    assert [one.bytes for one in made] == [one.predicted_bytes for one in made] == [288, 288, 0, 0, 48, 48]
    assert [record["effect"] for record in read_records(file.path)] == [one.effect for one in made]
    assert [line.split(":")[0] for line in said[6:]] == ["sky", "lens", "affine"]


def test_only_the_effect_that_is_timed_is_in_the_view():
    seen = {name: street().through(name).camera for name in ("sky", "lens", "shutter")}
    assert [(one.distortion is not None, one.shutter is not None) for one in seen.values()] == [
        (False, False),
        (True, False),
        (False, True),
    ]


def test_a_street_in_another_size_is_the_same_view():
    camera = street().view.camera
    scaled = street().scaled(2.0).view.camera
    corner = torch.tensor([camera.width, camera.height, 1.0])
    ray = torch.linalg.inv(camera.intrinsics) @ corner
    torch.testing.assert_close((scaled.intrinsics @ ray)[:2], 2 * corner[:2])


def test_a_cost_is_the_median_of_pairs(monkeypatch):
    """The clock ticks by 5 ms in frames with the effect and by 3 in those without."""
    clock = iter(float(tick) for tick in range(10**6))
    monkeypatch.setattr(costs.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(costs.time, "process_time", lambda: next(clock))

    def frame(scene, view, options) -> None:
        for _ in range(4 if scene.effects else 2):
            next(clock)

    monkeypatch.setattr(costs, "frame_image", frame)
    sky = Sky(SkySettings(resolution=2))
    made = costs._cost("sky", sky, Cost(ms_per_frame=1500.0), street(), ONCE)
    assert made.ms.median == pytest.approx(2000.0)
    assert made.frame.median == pytest.approx(3000.0)
    assert made.firm
    assert "predicted 1500.000 (-25 %)" in str(made)
