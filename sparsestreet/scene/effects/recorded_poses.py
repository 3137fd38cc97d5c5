"""The recorded poses of the training images, and what their neighbors in time say of one.

Corrections are rigid motions in the camera's own frame: six numbers, a translation in meters and a rotation vector in
radians, with corrected_camera_from_world = [R(rotation) | translation] camera_from_world.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.trajectories import Trajectories, smoothed
from sparsestreet.types import View

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
        """The corrections that move each image to a smooth path of its camera (``geometry.smooth_paths``)."""
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
        behind = bisect_left([self.times[place] for place in places], view.time)
        low, high = places[max(behind - 1, 0)], places[min(behind, len(places) - 1)]
        step = self.times[high] - self.times[low]
        return low, high, (view.time - self.times[low]) / step if step > 0 else 0.0

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
