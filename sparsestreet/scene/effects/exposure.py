"""The exposure of each image: gains of a camera, or an affine change of colors (as DriveStudio has it)."""

import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.evidence.exposure import (
    EV,
    MIN_INSTANTS,
    GainErrors,
    ImageGains,
    gain_errors,
    image_gains,
    without_drift,
)
from sparsestreet.geometry.boxes import without_frames
from sparsestreet.pictures.images import Dots
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding, neighbors_in_time
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import LearningRate, Rates
from sparsestreet.scene.state import RenderOptions, SceneState
from sparsestreet.types import Rendering, View


def _check_not_negative(**values: float) -> None:
    for name, value in values.items():
        if not value >= 0:
            raise ValueError(f"{name} must be >= 0, got {value}: 0 leaves it out")


@dataclass(frozen=True, kw_only=True)
class ExposureSettings(EffectSettings):
    """Called for where gains for images would remove an error of ``threshold`` or more from held-out images.

    The error is measured at static lidar points (``evidence/exposure.py``). A gain that jumps at random from image
    to image is not called for: neighbors do not foretell it. Raises ValueError for a threshold or a weight below 0.
    """

    threshold: float = 0.05
    """EV: of the root mean square error over images and channels that gains would remove."""
    without_psnr: float = 28.0
    """dB: what held-out images reach but for the error, for the predicted gain alone."""
    smooth: float = 1.0
    """Weight of the squared distance of a log gain from the line between its neighbors in time."""
    level: float = 1.0
    """Weight of the squared mean log gain over all images, by channel: twice the gains with half the light are the same
    images."""
    learning_rates: Rates = field(default_factory=lambda: {"log_gains": LearningRate(1e-3, 1e-4)})
    probed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_not_negative(threshold=self.threshold, smooth=self.smooth, level=self.level)

    def detect(self, data: TrainingData) -> Finding:
        gains = _measured(data)
        errors = None if gains is None else gain_errors(gains)
        if gains is None or errors is None:
            few = f"images of fewer than {MIN_INSTANTS} instants share enough lidar points with their neighbors"
            reason = f"{few}, so gains are not measured"
            return Finding(called_for=False, reason=reason, unit="EV", threshold=self.threshold)
        return Finding(
            called_for=errors.removed >= self.threshold,
            reason=_reason(errors, self.threshold),
            value=errors.removed,
            unit="EV",
            threshold=self.threshold,
            noise=errors.noise,
            gain=_gain(errors, gains.mean_square, self.without_psnr),
            evidence=partial(_shown, gains, errors),
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(numbers=3 * len(data.views), ns_per_pixel=3.3)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Exposure":
        """Start from the gains that are measured on all images, without drift; from none where nothing is measured."""
        made, views = Exposure(self, _times(data.views)), {view.indices: view for view in data.views}
        gains = data.log.kept.get("gains", (), lambda: _of_all(data))
        if gains is not None:
            made.start_from([views[indices] for indices in gains[0]], gains[1])
        return made

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Exposure":
        return Exposure(self, {int(camera): times for camera, times in header["times"].items()})


class Exposure(Effect):
    """Multiplies red, green and blue of each image by factors of its own: x -> x exp(g).

    Another view of a camera with training images, such as a held-out one, has g on the line in time between the two
    training images around it, or that of the first or last. A view of no camera, or of one without training images,
    has g = 0, the mean of all images.
    """

    settings: ExposureSettings

    def __init__(self, settings: ExposureSettings, times: Mapping[int, Sequence[float]]) -> None:
        """``times``: camera index -> normalized times of its training images, increasing."""
        super().__init__(settings)
        self.times = {camera: tuple(own) for camera, own in times.items()}
        self._first: dict[int, int] = {}
        count = 0
        for camera, own in self.times.items():
            self._first[camera] = count
            count += len(own)
        self.log_gains = nn.Parameter(torch.zeros(count, 3))

    @torch.no_grad()
    def start_from(self, views: Sequence[View], log_gains: Float[Tensor, "n 3"]) -> None:
        """Set the gains of training views."""
        for view, gain in zip(views, log_gains, strict=True):
            _, camera = view.indices
            self.log_gains[self._first[camera] + bisect_left(self.times[camera], view.time)] = gain.to(self.log_gains)

    def log_gain(self, view: View) -> Float[Tensor, "3"]:
        """g of a view."""
        if view.camera_index not in self.times:
            return self.log_gains.new_zeros(3)
        return self._on_line(view.camera_index, *neighbors_in_time(self.times[view.camera_index], view.time))

    def _on_line(self, camera: int, before: int, behind: int, part: float) -> Float[Tensor, "3"]:
        first = self._first[camera]
        return torch.lerp(self.log_gains[first + before], self.log_gains[first + behind], part)

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        return rgb * self.gain(view)

    def gain(self, view: View) -> Float[Tensor, "3"]:
        return self.log_gain(view).exp()

    def slope(self, view: View) -> Float[Tensor, "h w"]:
        """Root mean square of the three factors: exact where channels are alike, or a change is the same in all."""
        factor = self.gain(view).square().mean().sqrt()
        return factor.expand(view.camera.height, view.camera.width)

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        """Return ``smooth``, for a training image between two others of its camera, and ``level``."""
        terms = {}
        if self.settings.level > 0:
            terms["level"] = self.settings.level * self.log_gains.mean(0).square().sum()
        camera = view.camera_index
        if self.settings.smooth > 0 and camera in self.times:
            own = self.times[camera]
            place = bisect_left(own, view.time)
            if 0 < place < len(own) - 1 and own[place] == view.time:
                part = (view.time - own[place - 1]) / (own[place + 1] - own[place - 1])
                line = self._on_line(camera, place - 1, place + 1, part)
                off = self.log_gains[self._first[camera] + place] - line
                terms["smooth"] = self.settings.smooth * off.square().sum()
        return terms

    def header(self) -> dict[str, Any]:
        return {"times": {str(camera): list(own) for camera, own in self.times.items()}}


def _measured(data: TrainingData, **most: None) -> ImageGains | None:
    return image_gains(data.frames, data.sweeps, without_frames(data.log.tracks, data.held_out), **most)


def _of_all(data: TrainingData) -> tuple[list[tuple[int, int]], Float[Tensor, "n 3"]] | None:
    """Frame and camera of the images that can be measured, and their gains without drift."""
    gains = _measured(data, most=None)
    return None if gains is None else ([view.indices for view in gains.views], without_drift(gains))


def _times(views: Sequence[View]) -> dict[int, list[float]]:
    """Camera index -> times of its views, increasing."""
    times: dict[int, list[float]] = defaultdict(list)
    for view in sorted(views, key=lambda view: view.time):
        times[view.indices[1]].append(view.time)
    return dict(sorted(times.items()))


def _reason(errors: GainErrors, threshold: float) -> str:
    size = (
        f"gains of images that show the same lidar points differ by {errors.without:.3f} EV "
        f"({errors.color:.3f} between channels)"
    )
    if errors.removed >= threshold:
        return f"{size}, {errors.foretold:.3f} beside the neighbors in time"
    if errors.without >= threshold:
        return f"{size}, but neighbors in time foretell too little: {errors.foretold:.3f} EV would remain"
    return f"{size}, less than the threshold"


def _shown(gains: ImageGains, errors: GainErrors) -> list[Dots]:
    """Gains over the drive, and how far road and rest agree on what one street for all images misses."""
    cameras: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for view, gain in sorted(zip(gains.views, gains.log_gains, strict=True), key=lambda pair: pair[0].time):
        times, levels = cameras[f"camera {view.camera_index}"]
        times.append(view.time if view.seconds is None else view.seconds)
        levels.append(float(gain.mean()) / EV)
    clock = "time, 0 to 1" if any(view.seconds is None for view in gains.views) else "s"
    both = {f"{errors.images} images": (errors.low.tolist(), errors.high.tolist())}
    title = f"gains less those of images with the same points: both agree on {errors.without:.3f} EV"
    return [
        Dots("gray levels of the same lidar points: gain of each image", clock, "EV", dict(cameras), joined=True),
        Dots(title, "by points of the road, EV", "by the other points, EV", both, diagonal=True),
    ]


def _gain(errors: GainErrors, mean_square: float, without_psnr: float) -> float:
    """dB: an error e of the log gain adds e^2 times the images' mean square to their mean squared error."""
    rest = 10 ** (-without_psnr / 10)
    before, behind = (rest + (EV * error) ** 2 * mean_square for error in (errors.without, errors.foretold))
    return 10 * math.log10(before / behind)


@dataclass(frozen=True, kw_only=True)
class AffineSettings(EffectSettings):
    """Weights of the map's regularizers and its rate, off unless asked for.

    No log calls for it: a map that all images share changes nothing that the colors of the Gaussians could not be. It
    is the affine module of DriveStudio (e59bda4) as it acts. That means a map for each image by a network, which starts
    with all weights and inputs at zero. So the gradient of every weight and input stays zero, and only the last bias
    learns. Raises ValueError for a negative weight.
    """

    when: Literal["auto", "on", "off"] = "off"
    weight: float = 1e-5
    """Of mean |A - I| + mean |b|."""
    decay: float = 1e-6
    """Of half the squared numbers of A - I and b: Adam's weight decay of this rate, which is a term of the loss."""
    learning_rates: Rates = field(default_factory=lambda: {"deltas": LearningRate(1e-5)})
    found_when_off: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_not_negative(weight=self.weight, decay=self.decay)

    def detect(self, data: TrainingData) -> Finding:
        return Finding(called_for=False, reason="one map of colors for all images is nothing that a log calls for")

    def cost(self, data: TrainingData) -> Cost:
        return Cost(numbers=12, ns_per_pixel=4.8, ms_per_frame=0.12)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Affine":
        return Affine(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Affine":
        return Affine(self)


class Affine(Effect):
    """The map, whose ``deltas`` [3, 4] are A - I and b; it starts as the identity."""

    settings: AffineSettings

    def __init__(self, settings: AffineSettings = AffineSettings()) -> None:
        super().__init__(settings)
        self.deltas = nn.Parameter(torch.zeros(3, 4))

    def matrix(self) -> Float[Tensor, "3 3"]:
        """Return A."""
        return self.deltas[:, :3] + torch.eye(3, dtype=self.deltas.dtype, device=self.deltas.device)

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        return rgb @ self.matrix().T + self.deltas[:, 3]

    def slope(self, view: View) -> Float[Tensor, "h w"]:
        """Root of the mean squared singular value of A, which maps a change of color to one of that length on average.

        For every single change if A turns colors and scales them alike; else it is off by A's largest (or smallest)
        singular value over this.
        """
        return (self.matrix().norm() / 3**0.5).expand(view.camera.height, view.camera.width)

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        """Return ``identity`` and ``decay``, those that have a weight."""
        settings, terms = self.settings, {}
        if settings.weight > 0:
            terms["identity"] = settings.weight * (self.deltas[:, :3].abs().mean() + self.deltas[:, 3].abs().mean())
        if settings.decay > 0:
            terms["decay"] = settings.decay / 2 * self.deltas.square().sum()
        return terms
