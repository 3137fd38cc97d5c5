"""Corrections of the poses of cameras and boxes, trained with the scene."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from sparsestreet.evidence.motion import box_jitter
from sparsestreet.evidence.poses import pose_noise, seen_from
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import displacement, without_frames
from sparsestreet.geometry.cameras import exact_position, inverse
from sparsestreet.geometry.trajectories import Trajectories, smoothed
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding, PartlessSettings, neighbors_in_time
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import LearningRate, Rates
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Camera, Gaussians, Track, View

Neighbors = tuple[int, int, float]
"""Places of the images before and behind, and the fraction of the way between them; twice the same where one lacks."""


class RecordedPoses:
    """Training images by frame and camera, on the host."""

    def __init__(
        self, indices: Sequence[tuple[int, int]], times: Sequence[float], poses: Float[Tensor, "n 4 4"]
    ) -> None:
        """``poses`` are camera_from_world. Raises ValueError where two images are one camera's of one frame."""
        self.indices, self.times, self.poses = tuple(indices), tuple(times), poses.cpu()
        self.places = {index: place for place, index in enumerate(self.indices)}
        if len(self.places) < len(self.indices):
            raise ValueError(f"every image has a frame and a camera of its own, got {list(self.indices)}")
        self._by_camera: dict[int, list[int]] = defaultdict(list)
        for place in sorted(range(len(self.times)), key=self.times.__getitem__):
            self._by_camera[self.indices[place][1]].append(place)
        self._inner = self._with_two_neighbors()

    def place(self, view: View) -> int | None:
        """Of the image that a view belongs to; None: it was not trained on."""
        if view.frame_index is None or view.camera_index is None:
            return None
        return self.places.get(view.indices)

    def predicted(self, view: View, corrections: Float64[Tensor, "n 6"]) -> Float64[Tensor, "6"] | None:
        """The correction of an image that was not trained on; None where its camera has no training image.

        Errors of poses may be smooth over time, or jump from image to image. The mean of its neighbors' corrections
        covers the first. The second show as steps of the recorded path, since cars drive smoothly: part of the image's
        distance from the line between its neighbors is added. Least squares over the training images, of which each
        is predicted from its neighbors, say how large that part is. The pixels of the image are not used.
        """
        around = self._around(view)
        if around is None:
            return None
        beside = self._beside(view.camera.camera_from_world, around)
        return _mean(corrections, around) + self._shares(corrections) * beside

    def to_smooth_paths(self) -> Float64[Tensor, "n 6"]:
        """The corrections that move each image to a smooth path of its camera (``geometry.trajectories``)."""
        found = torch.zeros(len(self.indices), 6, dtype=torch.float64)
        for places in self._by_camera.values():
            times = torch.tensor([[self.times[place] for place in places]])
            ends = inverse(self.poses[places].double())
            turned = quat.from_matrix(ends[:, :3, :3]).float()[None]
            path = Trajectories(
                times, turned, ends[None, :, :3, 3].float(), torch.ones_like(times, dtype=torch.bool), times[:, [0, -1]]
            )
            rotations, shifts = (each[0].double() for each in smoothed(path))
            undone = quat.to_matrix(quat.from_rotation_vector(-rotations))
            ahead = ends[:, :3, :3].mT @ shifts[:, :, None]
            found[places] = torch.cat((-(undone @ ahead)[:, :, 0], -rotations), 1)
        return found

    def _around(self, view: View) -> Neighbors | None:
        places = self._by_camera.get(-1 if view.camera_index is None else view.camera_index)
        if not places:
            return None
        low, high, part = neighbors_in_time([self.times[place] for place in places], view.time)
        return places[low], places[high], part

    def _beside(self, camera_from_world: Float[Tensor, "4 4"], around: Neighbors) -> Float64[Tensor, "6"]:
        """The motion from a recorded pose to that on the line between two others; 0 where there is no line."""
        low, high, fraction = around
        if low == high:
            return torch.zeros(6, dtype=torch.float64)
        ends = inverse(self.poses[[low, high]].double())
        first, second = quat.from_matrix(ends[:, :3, :3])
        turned = quat.slerp(first, second, torch.tensor(fraction, dtype=torch.float64))
        line = torch.eye(4, dtype=torch.float64)
        line[:3, :3] = quat.to_matrix(turned)
        line[:3, 3] = torch.lerp(ends[0, :3, 3], ends[1, :3, 3], fraction)
        motion = inverse(line) @ inverse(camera_from_world.detach().double().cpu())
        return torch.cat((motion[:3, 3], quat.to_rotation_vector(quat.from_matrix(motion[:3, :3]))))

    def _with_two_neighbors(self) -> list[tuple[int, Neighbors, Float64[Tensor, "6"]]]:
        """Training images between two of their camera: their places, these neighbors, and how far they lie beside."""
        found = []
        for places in self._by_camera.values():
            for low, place, high in zip(places, places[1:], places[2:], strict=False):
                step = self.times[high] - self.times[low]
                around = low, high, (self.times[place] - self.times[low]) / step if step > 0 else 0.5
                found.append((place, around, self._beside(self.poses[place], around)))
        return found

    def _shares(self, corrections: Float64[Tensor, "n 6"]) -> Float64[Tensor, "6"]:
        """What part of the distance from the line is error: in [0, 1], one for translations and one for rotations."""
        if not self._inner:
            return torch.zeros(6, dtype=torch.float64)
        places, neighbors, beside = zip(*self._inner, strict=True)
        missing = corrections[list(places)] - torch.stack([_mean(corrections, around) for around in neighbors])
        distance = torch.stack(beside)
        products, squares = (missing * distance).reshape(-1, 2, 3), distance.square().reshape(-1, 2, 3)
        share = products.sum((0, 2)) / squares.sum((0, 2)).clamp(min=1e-20)
        return share.clamp(0, 1).repeat_interleave(3)


def _mean(corrections: Float64[Tensor, "n 6"], around: Neighbors) -> Float64[Tensor, "6"]:
    low, high, fraction = around
    return torch.lerp(corrections[low], corrections[high], min(max(fraction, 0.0), 1.0))


_MOVES = 0.5
"""Meters that an object must get before its points do not count."""
_DEPTH = 10.0
"""Meters away, at which a shift of the camera moves what it sees as far as a turn does."""
_LEAST = 0.02
"""Pixels that a pose is taken to be off at least; poses of exact streets measure 0.02 to 0.06."""
_CONFIRMED = 0.7
"""Smooth paths are taken if poses on them measure less than this part of the recorded ones' errors."""
_LEFT = 0.3
"""Of errors that differ from image to image, on a smooth path: 0.1 to 0.4 of them are left (docs/effects.md)."""
_SHARED = 4.0
"""Of the threshold: what all images of a camera share is worth a word from here on. Streets without errors have up to
0.9 px of it, because little says where a whole camera is."""


@dataclass(frozen=True, kw_only=True)
class CameraPosesSettings(EffectSettings):
    """Threshold, regularizer and rates. Raises ValueError for a negative weight or threshold, or a unit not above 0."""

    threshold: float = 0.5
    """Pixels that poses move the median image by, from one image to the next (``evidence.poses``)."""
    weight: float = 5e-4
    """Of the squares of a step's correction, in units of the measured error; it also decides where the world is, which
    images alone do not."""
    learning_rates: Rates = field(
        default_factory=lambda: {"translations": LearningRate(0.15, 0.0015), "rotations": LearningRate(0.15, 0.0015)}
    )
    """In units of the measured error: where poses are right, hardly anything is learned."""
    unit: float | None = None
    """Radians, and as far at 10 m, that such a unit is instead, whatever is measured; corrections start at zero."""
    probed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.weight >= 0 and self.threshold >= 0):
            raise ValueError(f"weight and threshold must be >= 0, got {self.weight} and {self.threshold}")
        if self.unit is not None and not self.unit > 0:
            raise ValueError(f"unit must be above 0 radians, got {self.unit}: null for the measured error")

    def detect(self, data: TrainingData) -> Finding:
        """Measure images of a few stretches of the drive (``evidence.poses``)."""
        found = pose_noise(data.frames, _moving(data))
        if found is None:
            reason = f"no image of {data.log.name} shares enough points with others to tell whether its pose is off"
            return Finding(called_for=False, reason=reason, unit="px", threshold=self.threshold)
        reason = (
            f"rays of {found.points} points meet if poses of {found.images} images move them by {found.value:.2f} px"
        )
        if found.constant >= _SHARED * self.threshold:
            reason += f", besides {found.constant:.2f} px that all images of a camera share: check its calibration"
        return Finding(
            called_for=found.value >= self.threshold,
            reason=reason,
            value=found.value,
            unit="px",
            threshold=self.threshold,
            noise=None if math.isnan(found.error) else found.error,
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(numbers=6 * len(data.views), ms_per_frame=1.53, ns_per_row=1.2)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "CameraPoses":
        """Corrections start where poses lie on smooth paths, if rays of points meet better from there; else at zero."""
        views = data.views
        poses = torch.stack([view.camera.camera_from_world for view in views])
        recorded = RecordedPoses([view.indices for view in views], [view.time for view in views], poses)
        if self.unit is not None:
            return CameraPoses(self, recorded, torch.zeros(len(views), 6), torch.full((len(views),), self.unit))
        said = self.threshold, finding.value
        start, noise = data.log.kept.get("poses", said, lambda: self._start(data, finding, recorded))
        focal = torch.stack([view.camera.intrinsics[0, 0] for view in views])
        return CameraPoses(self, recorded, start.float(), max(noise, _LEAST) / focal)

    def _start(
        self, data: TrainingData, finding: Finding, recorded: RecordedPoses
    ) -> tuple[Float64[Tensor, "n 6"], float]:
        """The corrections to start from, and the error that poses are taken to have there, pixels."""
        views, noise = data.views, self.threshold if finding.value is None else finding.value
        start = recorded.to_smooth_paths()
        smooth = [replace(view, camera=_moved(view.camera, each)) for view, each in zip(views, start, strict=True)]
        found = None if finding.value is None else pose_noise(seen_from(data.frames, smooth), _moving(data))
        if found is None or found.value > _CONFIRMED * noise:
            return torch.zeros_like(start), noise
        return start, _LEFT * noise

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "CameraPoses":
        indices = [(frame, camera) for frame, camera in tensors["indices"].tolist()]
        recorded = RecordedPoses(indices, tensors["times"].tolist(), tensors["poses"])
        return CameraPoses(self, recorded, tensors["start"], tensors["expected"])


def _moving(data: TrainingData) -> Sequence[Track]:
    tracks = [track for track in data.log.tracks if displacement(track) > _MOVES]
    return without_frames(tracks, data.held_out)


class CameraPoses(Effect):
    """Corrections of the recorded poses in the frame of each camera: a start, and what is learned beside it.

    The camera of a training image gets its own, that of another recorded image what its neighbors say
    (``RecordedPoses.predicted``). A view that nobody recorded is seen from where it says: so are views beside the path,
    also those that a training step makes of a recorded one.
    """

    settings: CameraPosesSettings
    indices: Tensor
    times: Tensor
    poses: Tensor
    start: Tensor
    expected: Tensor

    def __init__(
        self,
        settings: CameraPosesSettings,
        recorded: RecordedPoses,
        start: Float[Tensor, "n 6"],
        expected: Float[Tensor, " n"],
    ) -> None:
        """``expected`` is the error that poses are taken to have, radians; ``start`` has meters and radians.

        What is learned is in units of it, and of what moves the image as far at 10 m.
        """
        super().__init__(settings)
        self.recorded = recorded
        count = len(recorded.indices)
        self.translations = nn.Parameter(torch.zeros(count, 3))
        self.rotations = nn.Parameter(torch.zeros(count, 3))
        self.register_buffer("indices", torch.tensor(recorded.indices, dtype=torch.int64).reshape(-1, 2))
        self.register_buffer("times", torch.tensor(recorded.times, dtype=torch.float64))
        self.register_buffer("poses", recorded.poses)
        self.register_buffer("start", start)
        self.register_buffer("expected", expected)
        self._newest: tuple[int, Tensor] | None = None
        """Place and pose of the training image that was corrected last: to ask again would wait for a GPU."""

    def view(self, view: View, state: SceneState) -> View:
        place = self.recorded.place(view)
        if place is not None:
            as_recorded = torch.equal(self.recorded.poses[place], view.camera.camera_from_world)
            if not as_recorded:
                return view
            camera = self._corrected(place, view.camera)
            self._newest = place, camera.camera_from_world
            return replace(view, camera=camera)
        if view.frame_index is None:
            return view
        predicted = self.recorded.predicted(view, self.corrections())
        return view if predicted is None else replace(view, camera=_moved(view.camera, predicted))

    def gaussians(self, gaussians: Gaussians, view: View) -> Gaussians:
        place = self.recorded.place(view)
        if place is None or not torch.is_grad_enabled():
            return gaussians
        recorded = self.recorded.poses[place]
        as_recorded = replace(view.camera, camera_from_world=recorded)
        if self._newest is None or self._newest[0] != place:
            self._newest = place, self._corrected(place, as_recorded).camera_from_world
        if not torch.equal(self._newest[1], view.camera.camera_from_world):
            return gaussians
        correction = self._correction()[place]
        motion = torch.cat((quat.to_matrix(quat.from_rotation_vector(correction[3:])), correction[:3, None]), 1)
        center = exact_position(as_recorded)
        means, quaternions = _SeenRigidly.apply(
            gaussians.means,
            gaussians.quaternions,
            motion,
            recorded[:, :3].to(motion, non_blocking=True),
            center.to(motion, non_blocking=True),
        )
        return replace(gaussians, means=means, quaternions=quaternions)

    def corrections(self) -> Float64[Tensor, "n 6"]:
        """Translations (m) and rotation vectors (rad) of all training images, on the host."""
        return self._correction().detach().cpu().double()

    def _correction(self) -> Float[Tensor, "n 6"]:
        return self.start + self.expected[:, None] * torch.cat((_DEPTH * self.translations, self.rotations), 1)

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        """Return ``correction``, of the view's own pose, where it has a weight and the view is a training image."""
        place = self.recorded.place(view)
        if place is None or not self.settings.weight > 0:
            return {}
        learned = self.translations[place].square().sum() + self.rotations[place].square().sum()
        return {"correction": self.settings.weight * learned}

    def _corrected(self, place: int, camera: Camera) -> Camera:
        return _moved(camera, self.corrections()[place])


def _moved(camera: Camera, correction: Float64[Tensor, "6"]) -> Camera:
    recorded = camera.camera_from_world
    pose = recorded.detach().double().clone()
    pose[:3] = quat.to_matrix(quat.from_rotation_vector(correction[3:])) @ pose[:3]
    pose[:3, 3] += correction[:3]
    return replace(camera, camera_from_world=pose.to(recorded.dtype))


class _SeenRigidly(torch.autograd.Function):
    """Means and quaternions as they are; ``motion`` [R | t] gets the gradient of a camera that is moved by it.

    A point x in the world is R y + t to the corrected camera, with y = R_0 (x - c) to the recorded one. With g the
    gradient at x and A = R R_0, A g is that at R y + t, and

        dL/dt = A sum g,    dL/dR = A (sum g (x - c)^T) R_0^T + [A tau]_x R / 2

    The last term turns the Gaussians themselves. A turn of the world by a small vector d changes a quaternion q by
    (0, d) q / 2, so tau = sum vec(h q*) / 2 with h the gradient at q. [a]_x R / 2 is the matrix whose product with
    every [d]_x R is a . d.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Float[Tensor, "n 3"],
        quaternions: Float[Tensor, "n 4"],
        motion: Float[Tensor, "3 4"],
        recorded: Float[Tensor, "4 3"],
        center: Float[Tensor, "3"],
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
        ctx.save_for_backward(means, quaternions, motion, recorded, center)
        return means.view_as(means), quaternions.view_as(quaternions)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:
        means, quaternions, motion, recorded, center = ctx.saved_tensors
        by_mean, by_quaternion = gradients
        rotation, first = motion[:, :3], recorded[:3]
        seen = rotation @ first
        offsets = torch.nn.functional.pad(means - center, (0, 1), value=1.0)
        sums = seen @ (by_mean.T @ offsets).to(seen)
        torque = seen @ _torque((by_quaternion.T @ quaternions).to(seen))
        turned = sums[:, :3] @ first.T + 0.5 * torch.linalg.cross(torque[:, None].expand(3, 3), rotation, dim=0)
        return by_mean, by_quaternion, torch.cat((turned, sums[:, 3:]), 1), None, None


def _torque(products: Float[Tensor, "4 4"]) -> Float[Tensor, "3"]:
    """sum vec(h q*) / 2 of the sums of h_i q_j."""
    odd = products - products.T
    return 0.5 * torch.stack((odd[1, 0] + odd[3, 2], odd[2, 0] + odd[1, 3], odd[3, 0] + odd[2, 1]))


@dataclass(frozen=True, kw_only=True)
class BoxPosesSettings(PartlessSettings):
    """Called for where boxes of moving objects tremble, or were found in lidar: paths of these are smooth, and drift.
    The rates of the corrections are those of the nodes.

    Raises ValueError for a negative threshold.
    """

    threshold: float = 2.0
    """Centimeters, standard deviation of a corner about its path (``evidence.poses``)."""

    smooth: bool = True
    """Corrections start where boxes would lie on smooth paths (``geometry.trajectories``); false: at zero."""
    probed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.threshold >= 0:
            raise ValueError(f"threshold must be >= 0 cm, got {self.threshold}")

    def detect(self, data: TrainingData) -> Finding:
        moving = [track for track in data.log.tracks if displacement(track) > _MOVES]
        if drifting := sum(track.found for track in moving):
            reason = f"{drifting} moving objects are found, not annotated: boxes on smooth paths, which may drift"
            return Finding(called_for=True, reason=reason, unit="cm", threshold=self.threshold)
        found = box_jitter(moving, data.held_out)
        if found is None:
            # Two boxes tell no error from motion, and what boxes do at 2 frames a second is not known either.
            wanted, reason = bool(moving), f"{len(moving)} objects of {data.log.name} move, in too few boxes to tell"
            return Finding(called_for=wanted, reason=reason, unit="cm", threshold=self.threshold)
        value, objects = 100 * found.value, len(found.by_track)
        return Finding(
            called_for=value >= self.threshold,
            reason=f"corners of the boxes of {objects} moving objects lie {value:.1f} cm beside their paths",
            value=value,
            unit="cm",
            threshold=self.threshold,
            noise=None if math.isnan(found.error) else 100 * found.error,
        )

    def prepare(self, nodes: Iterable[Node], on: bool) -> None:
        for node in nodes:
            if isinstance(node, Tracked) and not on:
                node.fix_boxes()
            elif isinstance(node, Tracked) and self.smooth:
                node.smooth_boxes()
