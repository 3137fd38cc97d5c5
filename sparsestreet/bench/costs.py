"""``sparsestreet bench costs``: frames with and without each effect, beside what plans predict."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import DISTORTION, ROTATION, TRANSLATION, Size, frustum_camera, proxy_street
from sparsestreet.bench.timing import TimeSpread, TimingBudget, spread
from sparsestreet.evaluation.speed import frame_image
from sparsestreet.geometry.cameras import resized
from sparsestreet.scene.effects import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes import BackgroundSettings, Node
from sparsestreet.scene.nodes.background import Background
from sparsestreet.scene.state import DEFAULT_OPTIONS
from sparsestreet.types import Shutter, View

SCALES = (1.0, 2.0, 4.0)
"""Sizes of the images, as parts of those of a trained street: for effects that act on images."""
PROXIES = (Size(240, 144, 45_000), Size(240, 144, 135_000), Size(240, 144, 405_000))
"""Streets of even rows, for effects that act before the splats: a lens shows other rows of a trained street."""
FIRM = 2.0
"""Standard errors that a measured cost must be above 0 to be compared with its prediction."""


@dataclass(frozen=True)
class EffectCost:
    """One effect in frames of one size."""

    effect: str
    width: int
    height: int
    rows: int
    ms: TimeSpread
    """Frames with the effect less those without it, pair by pair."""
    error: float
    """Standard error of the median."""
    predicted_ms: float
    frame: TimeSpread
    """Without any effect."""
    bytes: int
    predicted_bytes: int

    @property
    def firm(self) -> bool:
        """Whether the cost is more than the clock's noise."""
        return self.ms.median > FIRM * self.error

    def __str__(self) -> str:
        off = f"{100 * (self.predicted_ms / self.ms.median - 1):+.0f} %" if self.firm else "within the noise"
        return (
            f"{self.effect:<14}{self.width:>5}x{self.height:<5}{self.rows:>9,} Gaussians: measured "
            f"{self.ms.median:.3f} ± {self.error:.3f} ms, predicted {self.predicted_ms:.3f} ({off}); "
            f"{self.bytes:,} bytes, predicted {self.predicted_bytes:,}"
        )


@dataclass(frozen=True)
class Street:
    """Nodes without effects, and a view of them."""

    nodes: Mapping[str, Node]
    view: View

    @staticmethod
    def proxy(size: Size, like: View) -> "Street":
        """The street that is made of numbers, at the time of another view."""
        made = proxy_street(size.rows)
        columns = {
            "means": made.means,
            "log_scales": made.scales.log(),
            "quaternions": made.quaternions,
            "opacity_logits": made.opacities.logit(),
            "sh_dc": made.dense_sh()[:, :1],
            "sh_rest": made.dense_sh()[:, 1:],
        }
        view = replace(like, camera=frustum_camera(size.width, size.height))
        return Street({"street": Background(BackgroundSettings(), Rows(columns))}, view)

    def scaled(self, scale: float) -> "Street":
        """The same view in another size."""
        camera = self.view.camera
        sized = resized(camera, height=round(scale * camera.height), width=round(scale * camera.width))
        return replace(self, view=replace(self.view, camera=sized))

    def through(self, name: str) -> View:
        """The view with what the camera itself must have for an effect."""
        camera = self.view.camera
        distortion = camera.intrinsics.new_tensor(DISTORTION) if name == "lens" else None
        translation, rotation = (camera.intrinsics.new_tensor(move) for move in (TRANSLATION, ROTATION))
        shutter = Shutter(translation, rotation) if name == "shutter" else None
        return replace(self.view, camera=replace(camera, distortion=distortion, shutter=shutter))


def run_costs(
    effects: Mapping[str, EffectSettings],
    data: TrainingData,
    street: Street,
    scales: Sequence[float],
    proxies: Sequence[Size],
    budget: TimingBudget,
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> list[EffectCost]:
    """Times frames of a street with one effect at a time, and without any.

    Args:
        effects: by name; those that a scene has no part of are left out.
        data: of a log that all of them can be built from.
        street: a trained one.
        scales: of its image, for effects that act on images.
        proxies: streets for the others.
        budget: pairs of frames, for each effect and size.
        file: takes a record for each effect and size.
        say: takes a line for each of them, and the constants that fit best at the end.
    """
    found = Finding(called_for=True, reason="it is timed")
    images, even = [street.scaled(scale) for scale in scales], [Street.proxy(size, street.view) for size in proxies]
    costs, predicted = [], {}
    for name, settings in effects.items():
        effect = settings.build(data, found, torch.Generator().manual_seed(0))
        if effect is None:
            continue
        predicted[name] = settings.cost(data)
        for one in images if effect.has_image else even:
            costs.append(_cost(name, effect, predicted[name], one, budget))
            file.write("costs", costs[-1])
            say(str(costs[-1]))
    for line in fitted(costs, predicted):
        say(line)
    return costs


@torch.no_grad()
def _cost(name: str, effect: Effect, predicted: Cost, street: Street, budget: TimingBudget) -> EffectCost:
    scene, view = SceneGraph(street.nodes, {name: effect}), street.through(name)
    whole, without = _pairs(scene, scene.without(name), view, budget)
    ms = spread([a - b for a, b in zip(whole, without, strict=True)])
    camera, rows = view.camera, sum(scene.counts().values())
    return EffectCost(
        effect=name,
        width=camera.width,
        height=camera.height,
        rows=rows,
        ms=ms,
        # Of a normal distribution the interquartile range is 1.349 standard deviations, and the error of the median
        # 1.2533 of the mean's.
        error=1.2533 * (ms.iqr or 0.0) / 1.349 / ms.repeats**0.5,
        predicted_ms=predicted.ms(camera.width * camera.height, rows),
        frame=spread(without),
        bytes=scene.bytes_by_part().get(name, 0),
        predicted_bytes=4 * predicted.numbers,
    )


def _pairs(whole: SceneGraph, without: SceneGraph, view: View, budget: TimingBudget) -> tuple[list[float], list[float]]:
    """Seconds of a frame of each, in turns; which is first changes from pair to pair."""
    seconds: tuple[list[float], list[float]] = ([], [])
    # What a single thread computes, whatever other programs take; threads that wait for each other spin.
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter

    def run() -> None:
        order = ((0, whole), (1, without))
        for place, scene in order if len(seconds[0]) % 2 else order[::-1]:
            start = clock()
            frame_image(scene, view, DEFAULT_OPTIONS)
            seconds[place].append(clock() - start)

    budget.warm_up(run)
    for own in seconds:
        own.clear()
    budget.runs(run)
    return seconds


def fitted(costs: Sequence[EffectCost], predicted: Mapping[str, Cost]) -> list[str]:
    """For each effect the line through its medians by least squares, beside the constants in use."""
    lines = []
    for name, cost in predicted.items():
        own = [one for one in costs if one.effect == name]
        for unit, in_use, works in (
            ("pixel", cost.ns_per_pixel, [one.width * one.height for one in own]),
            ("Gaussian", cost.ns_per_row, [one.rows for one in own]),
        ):
            if len(set(works)) > 1:
                slope, start = statistics.linear_regression(works, [one.ms.median for one in own])
                lines.append(
                    f"{name}: {start:.2f} ms a frame (in use {cost.ms_per_frame:g}) and {1e6 * slope:.2f} ns a {unit} "
                    f"(in use {in_use:g})"
                )
    return lines
