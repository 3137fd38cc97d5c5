"""Beside the recorded path: where views go, what is compared with what, and what is said of few images."""

import dataclasses

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.evaluation import extra as novel_module
from sparsestreet.evaluation.evaluate import screen_image
from sparsestreet.evaluation.extra import evaluate_novel, shifted_views
from sparsestreet.metrics.distances import frechet_distance, kernel_distance
from sparsestreet.metrics.lpips import Lpips
from sparsestreet.types import Frame
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, replace_render, small_scene
from tests.typed import there

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


class MeanDifference(Lpips):
    def __init__(self):
        pass

    def layer_maps(self, image, truth):
        return ((image - truth).mean(-1),)


def rig(count):
    """A front camera that looks along z and one that looks along x, at each instant."""
    return [turned(make_frame(frame, camera), 90 * camera) for frame in range(count) for camera in (1, 0)]


def evaluate(frames, offsets=(2.0,), truth=None, extractor=None, **replaced):
    extractors = [] if extractor is None else [extractor]
    options = {"command": "c", "truth": truth, "extractors": extractors, "missing": {"fid": "no weights"}} | replaced
    return evaluate_novel(SCENE, as_frames(tuple(frames)), offsets, OPTIONS, **options)


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


@pytest.mark.lengthy
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
        assert (shift.truth, shift.true_views) == ({}, 0)
    assert record.missing == {"fid": "no weights"}


def test_the_truth_of_each_shifted_view_is_compared_by_region(monkeypatch):
    """The front camera's render is 0.1 off among people and 0.01 elsewhere, the other's 0.1; one view has no truth."""
    people = torch.zeros(make_frame().image.shape[:2], dtype=torch.bool)
    people[:5] = True
    blank = torch.full((*people.shape, 3), 102, dtype=torch.uint8)
    nowhere = torch.zeros_like(people)

    def rendered(view):
        error = torch.where(people, 0.1, 0.01) if view.camera_index == 0 else torch.full(people.shape, 0.1)
        return 0.4 + error[..., None].expand(-1, -1, 3)

    def truth(view):
        assert view.frame_index is None
        if view.time > 0 and view.camera_index == 1:
            return None
        human = people if view.camera_index == 0 else nowhere
        return Frame(view.camera, view.time, image=blank, human=human, vehicle=~human)

    replace_render(monkeypatch, rendered)
    # A perceptual distance that is the mean difference: 0.1 and, of the front camera, less where nobody is.
    right, left = evaluate(rig(2), truth=truth, lpips=MeanDifference()).shifts
    assert right.truth == left.truth
    assert (right.views, right.true_views) == (4, 3)
    share = float(people.float().mean())
    front = -10 * np.log10(share * 0.01 + (1 - share) * 0.0001)
    # Rounding of 0.4 to float32 is 3e-8 of an error of 0.01: 3e-5 dB.
    assert right.truth["psnr_full"] == pytest.approx((2 * front + 20) / 3, abs=1e-4)
    assert right.truth["psnr_human"] == pytest.approx(20, abs=1e-4)
    assert right.truth["psnr_vehicle"] == pytest.approx((40 + 40 + 20) / 3, abs=1e-4)
    assert right.truth["lpips_alex"] == pytest.approx((2 * (0.01 + 0.09 * share) + 0.1) / 3, abs=1e-6)
    assert "lpips_alex" not in evaluate(rig(2), truth=truth).shifts[0].truth


def test_two_images_have_a_distance_and_one_has_none():
    two = evaluate(rig(1), extractor=MeanColor())
    assert all(np.isfinite(list(shift.distances.values())).all() for shift in two.shifts)
    one = evaluate(rig(1)[:1], extractor=MeanColor())
    assert [shift.distances for shift in one.shifts] == [{}, {}]
    assert "at least two images: hold out more views" in there(one.absent)
    assert one.missing == dict.fromkeys(("fid", "frechet_mean_color", "kernel_mean_color"), one.absent)
    none = evaluate(rig(1))
    assert (none.absent, [shift.distances for shift in none.shifts]) == ("no weights", [{}, {}])


class MeanBlue(MeanColor):
    """FID's name, and one feature."""

    name = "inception"

    def __call__(self, image):
        return image.double().mean((0, 1)).numpy()[2:]


@pytest.mark.lengthy
def test_each_extractor_has_distances_of_its_own():
    both = evaluate(rig(2), extractors=[MeanBlue(), MeanColor()]).shifts
    alone = [evaluate(rig(2), extractor=one).shifts for one in (MeanBlue(), MeanColor())]
    assert set(both[0].distances) == {"fid", "kid", "frechet_mean_color", "kernel_mean_color"}
    for shift, first, second in zip(both, *alone, strict=True):
        assert shift.distances == first.distances | second.distances


@pytest.mark.parametrize(("frames", "offsets"), [([], [1.0]), (rig(1), []), (rig(1), [1.0, 0.0]), (rig(1), [-1.0])])
def test_nothing_to_shift_is_an_error(frames, offsets):
    with pytest.raises(ValueError, match="novel views need recorded ones and offsets above 0 m"):
        evaluate(frames, offsets)


@pytest.mark.lengthy
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
