"""What is measured of a finished scene where somebody asks: beside the path, rendered in other ways, times alone."""

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.frame_cache import to_device
from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import Truth
from sparsestreet.evaluation.evaluate import frame_quality, quantized, restored, screen_image
from sparsestreet.evaluation.speed import Timing, device_name, frame_image, measure_latency, measure_scene_costs
from sparsestreet.geometry.cameras import moved
from sparsestreet.metrics.definitions import metric_id
from sparsestreet.metrics.distances import Extractor, LastLayer, distance_names
from sparsestreet.metrics.fid import open_inception
from sparsestreet.metrics.image import psnr
from sparsestreet.metrics.lpips import Lpips, open_lpips
from sparsestreet.metrics.reported import PerceptualDistance, Psnr, SetDistances, reported_metrics
from sparsestreet.noise import calibrate, noise_between
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.settings import OWN_PRESETS
from sparsestreet.phases import clock_of, stage
from sparsestreet.records.costs import COSTS, update_costs
from sparsestreet.records.file import check_links
from sparsestreet.records.run import this_machine, this_source
from sparsestreet.records.summary import (
    LATENCY,
    NOVEL,
    PRESETS,
    SUMMARY,
    Evaluation,
    FrameQuality,
    NovelRecord,
    NovelShift,
    PresetRecord,
    RenderedAs,
    RunSummary,
    clock_rows,
    summarize,
)
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.standing import StandingScene
from sparsestreet.types import Frame, View


@torch.no_grad()
def evaluate_novel(
    scene: SceneGraph,
    frames: Frames,
    offsets: Sequence[float],
    options: RenderOptions,
    *,
    command: str,
    truth: Truth | None,
    extractors: Sequence[Extractor],
    lpips: Lpips | None = None,
    missing: Mapping[str, str] | None = None,
    ramp: bool = False,
) -> NovelRecord:
    """Shift recorded views by each offset to both sides, and compare.

    Args:
        scene: on the device where it renders.
        frames: recorded views, best those that training did not see; one image at a time is in memory.
        offsets: meters, above 0.
        options: how the scene is rendered.
        command: that asked for it.
        truth: what a view would have recorded; None: nobody knows.
        extractors: of the features that distances compare; empty: no distances.
        lpips: compares renders with true images; None: PSNR alone does.
        missing: distance -> why there is no extractor for it, and what to do about it.
        ramp: as in ``NovelRecord``.

    Raises ValueError without views, for offsets that are not above 0, or for renders that are not finite.
    """
    if not frames or not offsets or not min(offsets) > 0:
        raise ValueError(f"novel views need recorded ones and offsets above 0 m, got {len(frames)} and {list(offsets)}")
    missing = dict(missing or {})
    if len(frames) < 2:
        known = [*missing, *(name for one in extractors for name in distance_names(one.name))]
        extractors, missing = (), dict.fromkeys(known, "distances need at least two images: hold out more views")
    scene, device = StandingScene.of(scene), scene.device
    # One process measures: the others wait for nobody.
    distances = [SetDistances(extractor, sync_on_compute=False) for extractor in extractors]
    quality = Psnr(("full", "human", "vehicle"), sync_on_compute=False)
    perceptual = None if lpips is None else PerceptualDistance(lpips, sync_on_compute=False)
    metrics = [quality, *([] if perceptual is None else [perceptual]), *distances]
    for frame in frames if distances else ():
        for distance in distances:
            distance.update(frame.image.to(device).float() / 255, real=True)

    def shift(offset: float) -> NovelShift:
        views = shifted_views(frames.views, offset, ramp)
        true_views, numbers = 0, {}
        for view in views:
            image = screen_image(scene, view, options)
            for distance in distances:
                distance.update(image, real=False)
            true = truth and truth(view)
            if true is not None:
                true_views += 1
                _compare(image, to_device(true, device), quality, perceptual)
        if true_views:
            numbers = {metric_id("psnr", region): value for region, value in quality.compute().items()}
            numbers |= {} if perceptual is None else {"lpips_alex": perceptual.compute()["full"]}
        found = NovelShift(
            offset=offset,
            views=len(views),
            distances={name: value for distance in distances for name, value in distance.compute().items()},
            truth=numbers,
            true_views=true_views,
        )
        for metric in metrics:
            metric.reset()
        return found

    shifts = tuple(shift(sign * offset) for offset in offsets for sign in (1, -1))
    return NovelRecord(
        command=command,
        ramp=ramp,
        real_views=len(frames),
        absent=None if extractors else "; ".join(dict.fromkeys(missing.values())),
        missing=missing,
        shifts=shifts,
    )


def _compare(image: Float[Tensor, "h w 3"], true: Frame, quality: Psnr, perceptual: PerceptualDistance | None) -> None:
    """Add a render and what would have been recorded to the means."""
    target = true.image.float() / 255
    quality.update(
        image, target, {name: mask for name in ("human", "vehicle") if (mask := getattr(true, name)) is not None}
    )
    if perceptual is not None:
        perceptual.update(image, target)


def shifted_views(views: Sequence[View], offset: float, ramp: bool = False) -> list[View]:
    """Views moved sideways, all cameras of an instant as one, meters to the right of the camera of the lowest index.

    They keep time and camera, but lose their frame index: nobody recorded them.
    """
    instants = sorted({view.indices[0] for view in views})
    steps = np.linspace(0, 1, len(instants)) if ramp and len(instants) > 1 else np.ones(len(instants))
    shares = dict(zip(instants, steps.tolist(), strict=True))
    fronts: dict[int, View] = {}
    for view in sorted(views, key=lambda view: view.indices[1]):
        fronts.setdefault(view.indices[0], view)
    found = []
    for view in views:
        instant, _ = view.indices
        right = fronts[instant].camera.camera_from_world[0, :3].double()
        camera = moved(view.camera, shares[instant] * offset * right)
        found.append(replace(view, camera=camera, frame_index=None))
    return found


ROUNDS = 4
"""Over all views, in which every preset is timed once a view."""
SLOW_MS = 200.0
"""A preset whose frames take longer is timed in the first round alone."""


@torch.no_grad()
def evaluate_presets(
    scene: SceneGraph, frames: Frames, presets: Mapping[str, RenderOptions], trained: RenderOptions, *, command: str
) -> PresetRecord:
    """Quality, distance to the exact image and milliseconds of each way to render, over the same views.

    Args:
        scene: on the device where it renders; stays as it is.
        frames: recorded views, best those that training did not see; one image at a time is in memory.
        presets: name -> how to render.
        trained: how the scene was rendered in training; its backend renders all presets.
        command: that asked for it.

    Raises ValueError without views or presets, or for renders that are not finite.
    """
    if not frames or not presets:
        raise ValueError(f"give views and at least one preset, got {len(frames)} and {list(presets)}")
    scene, before = StandingScene.of(scene), calibrate(scene.device)
    ways = {name: replace(options, backend=trained.backend) for name, options in presets.items()}
    quality, distances = _looks(scene, frames, ways, replace(trained, settings=_exact(trained.settings)))
    times = _frame_times(scene, frames.views, ways)
    rendered = tuple(
        RenderedAs(
            preset=name,
            trained=options == trained,
            quality={metric: one.mean for metric, one in summarize(quality[name]).items() if one.mean is not None},
            psnr_to_exact=statistics.fmean(distances[name]),
            frame_ms=statistics.median(times[name]),
            repeats=len(times[name]),
        )
        for name, options in ways.items()
    )
    return PresetRecord(
        command=command,
        device=device_name(scene.device),
        threads=torch.get_num_threads(),
        views=len(frames),
        noise=noise_between(before, calibrate(scene.device)),
        rendered=rendered,
    )


def _looks(
    scene: SceneGraph, frames: Frames, ways: Mapping[str, RenderOptions], exact: RenderOptions
) -> tuple[dict[str, list[FrameQuality]], dict[str, list[float]]]:
    """Of each way its quality, rounded as predictions are, and its distance to the exact image, frame by frame."""
    quality: dict[str, list[FrameQuality]] = {name: [] for name in ways}
    distances: dict[str, list[float]] = {name: [] for name in ways}
    metrics = reported_metrics({})
    for recorded in frames:
        frame = to_device(recorded, scene.device)
        limit = screen_image(scene, frame, exact)
        for name, options in ways.items():
            image = limit if options == exact else screen_image(scene, frame, options)
            shown = torch.from_numpy(restored(quantized(image.cpu().numpy()))).to(scene.device)
            quality[name].append(frame_quality(shown, frame, metrics))
            distances[name].append(psnr(image, limit))
    return quality, distances


def _frame_times(scene: SceneGraph, views: Sequence[View], ways: Mapping[str, RenderOptions]) -> dict[str, list[float]]:
    """Milliseconds of single frames, the ways in turn at each view: what drifts meets all of them alike."""
    clock = clock_of(scene.device)
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(ROUNDS):
        timed = {
            name: options for name, options in ways.items() if not turn or statistics.median(times[name]) < SLOW_MS
        }
        for view in views:
            for name, options in timed.items():
                start = clock.mark()
                frame_image(scene, view, options)
                times[name].append(1000 * clock.seconds(start, clock.mark()))
    return times


def _exact(settings: SplatSettings) -> SplatSettings:
    """No splat ends, no pixel stops and nothing is rounded; what a splat is (its clamp, its low-pass) stays."""
    return replace(settings, alpha_min=0.0, transmittance_min=0.0, max_sigma=math.inf, half_colors=False, depth_bits=32)


@dataclass(frozen=True)
class ExtraMetrics:
    """Raises ValueError for offsets that are not above 0, a ramp without offsets, or unknown presets."""

    novel: Sequence[float | int] = ()
    """Meters by which the held-out cameras are shifted to both sides."""
    ramp: bool = False
    """Whether the shift grows over the drive, as in a change of lane."""
    presets: Sequence[str] = ()
    """Ways to render, names of ``render.preset``."""
    training_lpips: bool = False
    """Whether training views get LPIPS too where views are held out, which takes seconds an image on a CPU."""
    timing: Timing = field(default_factory=Timing)
    """How often the frames of the record are timed."""

    def __post_init__(self) -> None:
        for preset in self.presets:
            SplatSettings.preset(preset)
        if any(offset <= 0 for offset in self.novel):
            raise ValueError(f"novel must be meters above 0, got {list(self.novel)}: each is taken to both sides")
        if self.ramp and not self.novel:
            raise ValueError("ramp=true says how the views of novel are shifted: say novel=1,2,3 too")

    def measure(
        self,
        scene: SceneGraph,
        data: StreetData,
        options: RenderOptions,
        *,
        out: Path,
        command: str,
        say: Callable[[str], None],
    ) -> None:
        """Measure over the held-out views (the training views where there are none), record in ``out/records`` and say
        it; nothing where nothing is asked."""
        views = data.split.held_out or data.split.train
        if self.novel:
            with stage("novel"):
                record = self._beside(scene, views, options, data.driving_log.truth, command)
                NOVEL.write(out, record)
            for line in _of_shifts(record):
                say(line)
        if self.presets:
            ways = {name: RenderOptions(_drawing(name, options.settings)) for name in self.presets}
            with stage("presets"):
                rendered = evaluate_presets(scene, views, ways, options, command=command)
                PRESETS.write(out, rendered)
            for line in _of_presets(rendered):
                say(line)

    def _beside(
        self, scene: SceneGraph, views: Frames, options: RenderOptions, truth: Truth | None, command: str
    ) -> NovelRecord:
        lpips, without = open_lpips(scene.device)
        inception, missing = open_inception(scene.device)
        network = lpips.get("lpips_alex")
        if network is None:
            missing |= dict.fromkeys(distance_names("alexnet"), without["lpips_alex"])
        return evaluate_novel(
            scene,
            views,
            self.novel,
            options,
            command=command,
            truth=truth,
            extractors=[
                *([] if inception is None else [inception]),
                *([] if network is None else [LastLayer("alexnet", network)]),
            ],
            lpips=network,
            missing=missing,
            ramp=self.ramp,
        )


def _of_shifts(record: NovelRecord) -> Iterator[str]:
    for shift in record.shifts:
        said = [f"{name} {value:.4g}" for name, value in shift.distances.items()]
        said += [f"{shift.truth['psnr_full']:.2f} dB to the truth"] if shift.truth else []
        side = "right" if shift.offset > 0 else "left"
        what = ", ".join(said) or "nothing to compare with"
        yield f"{abs(shift.offset):g} m to the {side} (n={shift.views}): {what}"
    for reason in dict.fromkeys(record.missing.values()):
        yield f"no {', '.join(name for name, why in record.missing.items() if why == reason)}: {reason}"


def _drawing(preset: str, trained: SplatSettings) -> SplatSettings:
    """Return the preset; antialias is a part of what was trained, and of no cut-offs."""
    return replace(SplatSettings.preset(preset), antialias=trained.antialias and preset in OWN_PRESETS)


def _of_presets(record: PresetRecord) -> Iterator[str]:
    for one in record.rendered:
        yield (
            f"{one.preset}{' (as trained)' if one.trained else ''}: {one.quality['psnr_full']:.2f} dB, "
            f"{one.psnr_to_exact:.1f} dB to the exact image, {one.frame_ms:.1f} ms/frame"
        )


def time_again(
    run: Path, scene: SceneGraph, views: Sequence[View], options: RenderOptions, timing: Timing, *, command: str
) -> RunSummary:
    """Time the frames of a run that was measured, and renew what its records say of times; all else stays.

    Args:
        run: its folder.
        scene: on the device where it is timed.
        views: those of its main split.
        options: how it is rendered.
        timing: how often.
        command: that asked for it.

    Raises RecordError for a run without a summary, OSError for a link that leads out of its folder.
    """
    summary, scene = SUMMARY.read(run), StandingScene.of(scene.eval())
    check_links(run)
    latency = measure_latency(scene, views, options, warmup=timing.warmup, repeats=timing.repeats)
    costs = measure_scene_costs(scene, views, options, repeats=timing.rounds)
    LATENCY.write(run, clock_rows(latency))
    if COSTS.exists(run):
        update_costs(run, **vars(costs))
    timed = Evaluation(command, this_machine(), this_source(), latency.device, latency.threads)
    renewed = replace(summary, latency=latency, latency_protocol=latency.protocol, timed=timed)
    SUMMARY.write(run, renewed)  # the last: it says that the others are renewed
    return renewed
