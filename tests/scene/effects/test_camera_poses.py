"""Gradients of camera poses against finite differences, and which views a correction reaches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.evidence.poses import PoseNoise
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, moved
from sparsestreet.geometry.trajectories import Trajectories, smoothed
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.scene.effects import Finding
from sparsestreet.scene.effects import poses as camera_poses
from sparsestreet.scene.effects.poses import CameraPoses, CameraPosesSettings, RecordedPoses
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.state import FINISHED
from sparsestreet.types import Camera, Frame, Gaussians, Shutter, View
from tests.scene.street import camera_at, random_rows, training_data

SETTINGS = CameraPosesSettings(weight=0.01)
EXPECTED, START = 0.02, 0.01
"""Radians that the poses are taken to be off; meters and radians of all corrections at the start."""
PLAIN = replace(camera_at(-6.0, width=17, height=11), intrinsics=torch.tensor([[9.0, 0, 8], [0, 9, 5], [0, 0, 1]]))
BENT = replace(PLAIN, distortion=torch.tensor([-0.2, 0.05, 0.01, 0.0, 0.0]))
ROLLING = replace(PLAIN, shutter=Shutter(torch.tensor([0.3, 0.0, 0.1]), torch.tensor([0.0, 0.1, 0.02])))


def doubled(camera: Camera) -> Camera:
    lens = None if camera.distortion is None else camera.distortion.double()
    shutter = camera.shutter
    if shutter is not None:
        shutter = replace(shutter, translation=shutter.translation.double(), rotation=shutter.rotation.double())
    pose = camera.camera_from_world.double()
    return replace(
        camera, camera_from_world=pose, intrinsics=camera.intrinsics.double(), distortion=lens, shutter=shutter
    )


def gaussians(degree: int) -> Gaussians:
    draw = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    sh = 0.3 * normal(12, (degree + 1) ** 2, 3)
    # Away from the origin: the pivot is the camera's center, and long quaternions turn like short ones.
    return Gaussians(
        normal(12, 3) + torch.tensor([0.0, 0.0, 1.5]),
        2 * normal(12, 4),
        torch.rand(12, 3, generator=draw).double() * 0.5 + 0.2,
        torch.full((12,), 0.6, dtype=torch.float64),
        sh,
    )


def effect(camera: Camera, *, indices=((0, 0),), times=(0.5,), dtype=torch.float64) -> CameraPoses:
    """Corrections of images that one camera took, with values."""
    poses = camera.camera_from_world.repeat(len(indices), 1, 1)
    expected = torch.full((len(indices),), EXPECTED)
    start = torch.full((len(indices), 6), START)
    made = CameraPoses(SETTINGS, RecordedPoses(indices, times, poses), start, expected).to(dtype)
    with torch.no_grad():
        shifts = torch.linspace(-0.2, 0.3, 3 * len(indices)) - START
        made.translations.copy_((shifts / (10 * EXPECTED)).reshape(-1, 3))
        turns = torch.linspace(0.15, -0.1, 3 * len(indices)) - START
        made.rotations.copy_((turns / EXPECTED).reshape(-1, 3))
    return made


def loss_of(poses: CameraPoses, rows: Gaussians, view: View, settings: SplatSettings, *, wrapped: bool) -> torch.Tensor:
    """A random combination of all pixels of color, alpha and depth."""
    seen = poses.view(view, FINISHED)
    drawn = splat(poses.gaussians(rows, seen) if wrapped else rows, seen.camera, settings=settings, backend="reference")
    draw = torch.Generator().manual_seed(5)
    images = drawn.rgb, drawn.alpha, drawn.alpha * drawn.depth  # a depth of almost nothing jumps
    parts = [(image * torch.randn(image.shape, generator=draw, dtype=torch.float64)).sum() for image in images]
    return torch.stack(parts).sum()


def both_gradients(camera: Camera, degree: int, settings: SplatSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """(backward, central differences) of translation and rotation."""
    camera = doubled(camera)
    poses, view = effect(camera), View(camera, 0.5, 0, 0)
    rows = gaussians(degree)
    rows = replace(rows, means=rows.means.requires_grad_(), quaternions=rows.quaternions.requires_grad_())
    loss_of(poses, rows, view, settings, wrapped=True).backward()
    found = torch.cat((poses.translations.grad[0], poses.rotations.grad[0]))
    differences = []
    with torch.no_grad():
        for parameter, unit in ((poses.translations, 10 * EXPECTED), (poses.rotations, EXPECTED)):
            for axis in range(3):
                step, ends = 1e-6 / unit, []
                for sign in (1, -1):
                    parameter[0, axis] += sign * step
                    ends.append(loss_of(poses, rows, view, settings, wrapped=False))
                    parameter[0, axis] -= sign * step
                differences.append((ends[0] - ends[1]) / (2 * step))
    return found, torch.stack(differences)


SMOOTH = SplatSettings(alpha_min=1e-9, transmittance_min=1e-12)
"""Without jumps at the cut-offs, which differences see and derivatives do not."""


@pytest.mark.parametrize("camera", [PLAIN, BENT, ROLLING], ids=["pinhole", "lens", "shutter"])
def test_the_gradient_is_that_of_a_camera_that_moves(camera: Camera):
    found, differences = both_gradients(camera, 0, SMOOTH)
    assert differences.abs().min() > 1e-3
    # Differences of 1e-6 in float64 are good to about 1e-9 of the loss, which is about 10.
    torch.testing.assert_close(found, differences, rtol=1e-5, atol=1e-6)


def test_colors_that_depend_on_the_direction_bias_turns_alone():
    found, differences = both_gradients(PLAIN, 3, SMOOTH)
    torch.testing.assert_close(found[:3], differences[:3], rtol=1e-5, atol=1e-6)
    # Rows whose harmonics of all degrees are equally large: far more than a street has.
    assert 1e-3 < float((found[3:] - differences[3:]).norm() / differences[3:].norm()) < 0.1


def test_every_step_asks_once_what_the_step_before_has_learned(monkeypatch: pytest.MonkeyPatch):
    """To ask waits for a GPU. Each rendering has the newest pose and its gradient, whatever image it is of."""
    asked = []
    answer = CameraPoses.corrections
    monkeypatch.setattr(CameraPoses, "corrections", lambda self: asked.append(1) or answer(self))
    poses = effect(PLAIN, indices=((0, 0), (2, 0)), times=(0.0, 1.0), dtype=torch.float32)
    rows = random_rows(5, 0)
    given = Gaussians(rows.means, rows.quaternions, rows.log_scales.exp(), rows.opacity_logits.sigmoid(), rows.sh_dc)
    for frame in (0, 0, 2, 0):
        asked.clear()
        view = View(PLAIN, 0.5 * frame, frame, 0)
        seen = poses.view(view, FINISHED)
        assert torch.equal(seen.camera.camera_from_world, corrected(effect_of(poses), view))
        asked.clear()
        wrapped = poses.gaussians(given, seen)
        assert not asked
        assert wrapped is not given
        with torch.no_grad():
            poses.translations.add_(0.1)


def effect_of(poses: CameraPoses) -> CameraPoses:
    """The same corrections in an effect that has seen no view."""
    fresh = CameraPoses(poses.settings, poses.recorded, poses.start, poses.expected)
    fresh.load_state_dict(poses.state_dict())
    return fresh


def corrected(poses: CameraPoses, view: View) -> torch.Tensor:
    return poses.view(view, FINISHED).camera.camera_from_world


def test_an_image_has_its_own_correction_and_other_views_have_none():
    poses = effect(PLAIN, indices=((0, 0), (2, 0)), times=(0.0, 1.0), dtype=torch.float32)
    with torch.no_grad():
        poses.start.zero_()
        poses.rotations.zero_()
        poses.translations.copy_(torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]) / (10 * EXPECTED))
    pose = PLAIN.camera_from_world
    for frame, time, shift in ((0, 0.0, [0.1, 0.0, 0.0]), (2, 1.0, [0.0, 0.2, 0.0]), (1, 0.25, [0.075, 0.05, 0.0])):
        got = corrected(poses, View(PLAIN, time, frame, 0)) - pose
        torch.testing.assert_close(got[:3, 3], torch.tensor(shift))
    beside = moved(PLAIN, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    # A view beside the path is where it says, also one that a step makes of a training image; so is another camera's.
    for view in (View(beside, 0.0, 0, 0), View(PLAIN, 0.0), View(PLAIN, 0.0, None, 0), View(PLAIN, 0.5, 1, 7)):
        assert poses.view(view, FINISHED) is view


def test_a_view_beside_the_path_moves_no_pose():
    poses = effect(doubled(PLAIN))
    beside = doubled(moved(PLAIN, torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)))
    rows = gaussians(0)
    rows = replace(rows, means=rows.means.requires_grad_())
    seen = poses.view(View(beside, 0.5, 0, 0), FINISHED)
    assert poses.gaussians(rows, seen) is rows
    own = poses.view(View(doubled(PLAIN), 0.5, 0, 0), FINISHED)
    assert poses.gaussians(rows, own).means.grad_fn is not None
    with torch.no_grad():
        assert poses.gaussians(rows, own) is rows


def along(errors: list[float], gain: float) -> tuple[RecordedPoses, torch.Tensor]:
    """A camera that drives to its right, ever faster, recorded with errors; with the corrections that undo them."""
    places = [x + gain * x**2 + error for x, error in enumerate(errors)]
    views = [moved(PLAIN, torch.tensor([0.0, -place, 0.0], dtype=torch.float64)) for place in places]
    corrections = torch.zeros(len(errors), 6, dtype=torch.float64)
    corrections[:, 0] = torch.tensor(errors, dtype=torch.float64)
    poses = torch.stack([camera.camera_from_world for camera in views])
    return RecordedPoses([(x, 0) for x in range(len(errors))], [x / 8 for x in range(len(errors))], poses), corrections


@pytest.mark.parametrize(
    ("errors", "gain"),
    [
        ([0.1, -0.05, 0.08, -0.1, 0.02, 0.07, -0.09, 0.05, -0.03], 0.0),  # each image is off on its own
        ([0.1, 0.11, 0.12, 0.13, 0.14, 0.15, 0.16, 0.17, 0.18], 0.05),  # errors that drift
    ],
    ids=["jumps", "drift"],
)
def test_neighbors_say_the_correction_of_a_held_out_image(errors: list[float], gain: float):
    (recorded, corrections), held_out = along(errors, gain), 4
    kept = [place for place in range(len(errors)) if place != held_out]
    known = RecordedPoses(
        [recorded.indices[place] for place in kept], [recorded.times[place] for place in kept], recorded.poses[kept]
    )
    view = View(replace(PLAIN, camera_from_world=recorded.poses[held_out]), recorded.times[held_out], held_out, 0)
    found = known.predicted(view, corrections[kept])
    assert found is not None
    # Poses are float32: a meter has 1e-7 of it.
    torch.testing.assert_close(found, corrections[held_out], rtol=0, atol=1e-6)


def test_two_images_of_one_camera_and_frame_are_an_error():
    with pytest.raises(ValueError, match="every image has a frame and a camera of its own"):
        RecordedPoses([(0, 0), (0, 0)], [0.0, 0.0], torch.eye(4).repeat(2, 1, 1))


def test_the_term_is_that_of_the_image_of_the_step():
    poses, view = effect(PLAIN, dtype=torch.float32), View(PLAIN, 0.5, 0, 0)
    with torch.no_grad():
        poses.translations.fill_(1.0)
        poses.rotations.fill_(2.0)
    torch.testing.assert_close(poses.regularizers(view, FINISHED)["correction"], torch.tensor(0.01 * (3 * 1 + 3 * 4)))
    assert poses.regularizers(View(PLAIN, 0.5, 3, 0), FINISHED) == {}
    unweighted = CameraPoses(replace(SETTINGS, weight=0.0), poses.recorded, poses.start, poses.expected)
    assert unweighted.regularizers(view, FINISHED) == {}


def test_the_log_calls_for_it_where_images_say_that_poses_are_off(monkeypatch: pytest.MonkeyPatch):
    for value, constant, called_for in ((0.6, 0.1, True), (0.4, 3.0, False)):
        found = PoseNoise(value, 0.1, constant, 9, 50, np.zeros(9), np.zeros((9, 2), np.int64))
        monkeypatch.setattr(camera_poses, "pose_noise", lambda *_, found=found: found)
        finding = SETTINGS.detect(training_data())
        assert (finding.called_for, finding.value, finding.noise) == (called_for, value, 0.1)
        assert ("share: check its calibration" in finding.reason) == (constant > 2)
    monkeypatch.setattr(camera_poses, "pose_noise", lambda *_: None)
    finding = SETTINGS.detect(training_data())
    assert (finding.called_for, finding.value, finding.missing) == (False, None, None)
    assert SETTINGS.cost(training_data()).numbers == 6 * 5
    assert len(SETTINGS.build(training_data(), finding, torch.Generator()).translations) == 5


def driven(frames: int, size: float) -> tuple[list[View], torch.Tensor]:
    """A camera on a gentle curve, recorded with turns and shifts that are off by ``size`` (rad, 10 m); and what undoes
    them."""
    draw, views, undone = torch.Generator().manual_seed(5), [], []
    for frame in range(frames):
        along = torch.tensor([0.0, 0.02 * frame**2, -1.0 * frame], dtype=torch.float64)
        camera = moved(replace(PLAIN, width=17), along)
        error = (
            size * torch.randn(6, generator=draw, dtype=torch.float64) * torch.tensor([10, 10, 10, 1, 1, 1]).double()
        )
        views.append(View(camera_poses._moved(camera, error), frame / (frames - 1), frame, 0))
        undone.append(-error)
    return views, torch.stack(undone)


def test_a_smooth_start_moves_centers_by_the_shift_alone_however_far_it_turns():
    views, _ = driven(30, 0.05)
    recorded = RecordedPoses(
        [view.indices for view in views],
        [view.time for view in views],
        torch.stack([view.camera.camera_from_world for view in views]),
    )
    ends = inverse(recorded.poses.double())
    times = torch.tensor([recorded.times])
    path = Trajectories(
        times,
        quat.from_matrix(ends[:, :3, :3]).float()[None],
        ends[None, :, :3, 3].float(),
        torch.ones_like(times, dtype=torch.bool),
        times[:, [0, -1]],
    )
    (turns,), (shifts,) = smoothed(path)
    # To leave the turn out would move centers by their product.
    assert (turns.norm(dim=1) * shifts.norm(dim=1)).max() > 0.01
    for view, correction, turn, shift in zip(views, recorded.to_smooth_paths(), turns, shifts, strict=True):
        own, found = (
            inverse(c.camera_from_world.double()) for c in (view.camera, camera_poses._moved(view.camera, correction))
        )
        torch.testing.assert_close(found[:3, 3] - own[:3, 3], shift.double(), atol=1e-5, rtol=0)  # float32 at 30 m
        wanted = own[:3, :3] @ quat.to_matrix(quat.from_rotation_vector(turn.double()))
        torch.testing.assert_close(found[:3, :3], wanted, atol=2e-6, rtol=0)


@pytest.mark.parametrize(("after", "starts"), [(0.1, True), (0.9, False), (None, False)])
def test_corrections_start_on_a_smooth_path_if_rays_meet_better_there(
    monkeypatch: pytest.MonkeyPatch, after: float | None, starts: bool
):
    """1 px of errors are 1/9 rad at a focal length of 9 px; of 0.01 rad a smooth path leaves little."""
    views, undone = driven(30, 0.01)
    frames = as_frames([Frame.of(view, image=torch.zeros(11, 17, 3, dtype=torch.uint8)) for view in views])
    seen = []

    def found(looked_at: Frames, moving: object) -> PoseNoise | None:
        seen.append(torch.stack([view.camera.camera_from_world for view in looked_at.views]))
        return None if after is None else PoseNoise(after, 0.0, 0.0, 9, 50, np.zeros(9), np.zeros((9, 2), np.int64))

    monkeypatch.setattr(camera_poses, "pose_noise", found)
    finding = Finding(called_for=True, reason="", value=1.0)
    made = SETTINGS.build(replace(training_data(), frames=frames), finding, torch.Generator())
    corrections = made.corrections()
    if not starts:
        assert not corrections.any()
        assert made.expected[0] == pytest.approx(1.0 / 9)
        return
    # Of 30 errors a path with about five degrees of freedom keeps 0.4.
    assert (corrections - undone).square().mean().sqrt() < 0.5 * undone.square().mean().sqrt()
    assert made.expected[0] == pytest.approx(0.3 / 9)
    # The images were looked at from these very poses.
    for view, pose in zip(views, seen[0], strict=True):
        torch.testing.assert_close(made.view(view, FINISHED).camera.camera_from_world, pose, atol=2e-6, rtol=0)


def test_forced_on_without_a_measurement_errors_are_as_large_as_the_threshold():
    data = training_data()
    made = SETTINGS.build(data, Finding(called_for=False, reason=""), torch.Generator())
    assert not made.corrections().any()
    assert made.expected[0] == pytest.approx(0.5 / float(data.views[0].camera.intrinsics[0, 0]))


def test_rates_are_fixed_in_a_unit_that_is_given(monkeypatch: pytest.MonkeyPatch):
    """Adam's first step is a rate long: 1e-5 rad and 10 x 1e-6 m, whatever was measured, in every pose alike."""
    monkeypatch.setattr(camera_poses, "pose_noise", lambda *_: pytest.fail("nothing is to be measured again"))
    rates = {"translations": LearningRate(1e-6), "rotations": LearningRate(1e-5)}
    settings = replace(SETTINGS, weight=0.0, unit=1.0, learning_rates=rates)
    made = settings.build(training_data(), Finding(called_for=True, reason="", value=3.0), torch.Generator())
    assert not made.corrections().any()
    groups = [{"params": [getattr(made, name)], "lr": rate.initial} for name, rate in rates.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    made.translations.grad, made.rotations.grad = torch.full((5, 3), 7.0), torch.full((5, 3), -0.2)
    optimizer.step()
    expected = torch.tensor([-1e-5] * 3 + [1e-5] * 3, dtype=torch.float64).expand(5, 6)
    torch.testing.assert_close(made.corrections(), expected, rtol=1e-6, atol=0)  # float32
    with pytest.raises(ValueError, match="unit must be above 0 radians"):
        replace(SETTINGS, unit=0.0)
