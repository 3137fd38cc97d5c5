"""Beside the recorded path: where views go, what is compared with what, and what is said of few images."""

import dataclasses

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation import novel as novel_module
from sparsestreet.evaluation.evaluate import screen_image
from sparsestreet.evaluation.novel import evaluate_novel, novel_path, read_novel, shifted_views, write_novel
from sparsestreet.metrics.distances import frechet_distance, kernel_distance
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, replace_render, small_scene

SCENE = small_scene()


class MeanColor:
    """Two features that a test can compute: mean red and mean green."""

    name = "mean_color"

    def __call__(self, image):
        return image.double().mean((0, 1)).numpy()[:2]


def turned(frame, degrees):
    """A frame whose camera looks to the right, from (1, 2, 3)."""
    angle = np.radians(degrees)
    world_from_camera = torch.eye(4)
    world_from_camera[0, 0] = world_from_camera[2, 2] = np.cos(angle)
    world_from_camera[0, 2], world_from_camera[2, 0] = np.sin(angle), -np.sin(angle)
    world_from_camera[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    return dataclasses.replace(
        frame, camera=dataclasses.replace(frame.camera, camera_from_world=torch.linalg.inv(world_from_camera))
    )


def rig(count):
    """A front camera that looks along z and one that looks along x, at each instant."""
    return [turned(make_frame(frame, camera), 90 * camera) for frame in range(count) for camera in (1, 0)]


def evaluate(frames, offsets=(2.0,), truth=None, extractor=None, **replaced):
    options = {"command": "c", "truth": truth or {}, "extractor": extractor, "absent": "no weights"} | replaced
    return evaluate_novel(SCENE, Frames.of(tuple(frames)), offsets, OPTIONS, **options)


def test_a_rig_moves_along_its_front_cameras_lateral_axis():
    views = shifted_views(rig(3), 2.0)
    assert [(view.frame_index, view.camera_index) for view in views] == [(None, 1), (None, 0)] * 3
    for view, before in zip(views, rig(3), strict=True):
        torch.testing.assert_close(view.camera.position, torch.tensor([3.0, 2.0, 3.0]))  # right of the front is x
        assert torch.equal(view.camera.camera_from_world[:3, :3], before.camera.camera_from_world[:3, :3])
        assert view.time == before.time


def test_a_ramp_reaches_the_whole_shift_at_the_last_instant():
    views = shifted_views(rig(3), -2.0, ramp=True)
    positions = [round(float(view.camera.position[0]), 5) for view in views]
    assert positions == [1.0, 1.0, 0.0, 0.0, -1.0, -1.0]
    (alone,) = shifted_views(rig(1)[:1], 2.0, ramp=True)  # one instant, one view: nothing to grow over
    assert float(alone.camera.position[2]) == pytest.approx(3 - 2)  # right of one that looks along x is -z


def test_distances_are_of_shifted_renders_and_real_images():
    frames = rig(3)
    record = evaluate(frames, (1.0, 2.0), extractor=MeanColor())
    assert [shift.offset for shift in record.shifts] == [1.0, -1.0, 2.0, -2.0]
    assert (record.real_views, record.absent, {shift.views for shift in record.shifts}) == (6, None, {6})
    real = np.stack([MeanColor()(frame.image.float() / 255) for frame in frames])
    for shift in record.shifts:
        ours = [MeanColor()(screen_image(SCENE, view, OPTIONS)) for view in shifted_views(frames, shift.offset)]
        expected = {"frechet_mean_color": frechet_distance(np.stack(ours), real)}
        assert shift.distances == expected | {"kernel_mean_color": kernel_distance(np.stack(ours), real)}
        assert (shift.psnr, shift.true_views) == (None, 0)
    left, right = (shift.distances["frechet_mean_color"] for shift in record.shifts[2:])
    assert record.mean(2.0, "frechet_mean_color") == pytest.approx((left + right) / 2)
    assert (record.mean(3.0, "frechet_mean_color"), record.mean(2.0, "fid")) == (None, None)


def test_the_truth_is_compared_at_its_own_pose(monkeypatch):
    error = {5: 0.1, 6: 0.01}
    replace_render(monkeypatch, lambda view: view.image.float() / 255 + error[view.frame_index])
    truth = [make_frame(index) for index in error]
    truth = [dataclasses.replace(frame, image=frame.image // 2) for frame in truth]
    record = evaluate(rig(2), (1.0, 2.0), truth={-2.0: Frames.of(tuple(truth))})
    assert [shift.psnr for shift in record.shifts[:3]] == [None] * 3
    assert record.shifts[3].psnr == pytest.approx((20 + 40) / 2, abs=0.01)  # 16 bits at 40 dB: 7.6e-6 of 0.01
    assert record.shifts[3].true_views == 2
    assert (record.absent, record.shifts[3].distances) == ("no weights", {})


def test_two_images_have_a_distance_and_one_has_none():
    two = evaluate(rig(1), extractor=MeanColor())
    assert all(np.isfinite(list(shift.distances.values())).all() for shift in two.shifts)
    one = evaluate(rig(1)[:1], extractor=MeanColor())
    assert [shift.distances for shift in one.shifts] == [{}, {}]
    assert "at least two images: hold out more views" in one.absent


@pytest.mark.parametrize(("frames", "offsets"), [([], [1.0]), (rig(1), []), (rig(1), [1.0, 0.0]), (rig(1), [-1.0])])
def test_nothing_to_shift_is_an_error(frames, offsets):
    with pytest.raises(ValueError, match="novel views need recorded ones and offsets above 0 m"):
        evaluate(frames, offsets)


def test_one_image_is_alive_at_a_time(monkeypatch):
    alive = count_live(monkeypatch)
    evaluate(rig(3), (1.0, 2.0), extractor=MeanColor())
    assert alive["rendered"] == 4 * 6
    assert alive["most"] <= 2  # the one that is looked at, and the one that takes its name


def count_live(monkeypatch):
    import weakref

    seen = {"most": 0, "rendered": 0}
    references = []

    def counted(scene, view, options):
        image = screen_image(scene, view, options)
        references.append(weakref.ref(image))
        seen["rendered"] += 1
        seen["most"] = max(seen["most"], sum(one() is not None for one in references))
        return image

    monkeypatch.setattr(novel_module, "screen_image", counted)
    return seen


def test_novel_round_trip(tmp_path):
    record = dataclasses.replace(evaluate(rig(2), ramp=True), absent="none here")
    write_novel(novel_path(tmp_path), record)
    assert read_novel(tmp_path / "records" / "novel.json") == record
    assert record.ramp
