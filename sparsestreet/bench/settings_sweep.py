"""Time, work and error of every setting of the splat op on every scene: ``sparsestreet bench settings``."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf

import torch

from sparsestreet.bench.accuracy import Answer, Errors, answer, errors, image_error
from sparsestreet.bench.records import RecordFile, settings_entries
from sparsestreet.bench.scenes import EFFECTS, BenchScene, EffectsName, Size, seen_through
from sparsestreet.bench.timing import OpTimes, TimingBudget, leaves, time_op
from sparsestreet.ops.backend import BACKENDS, resolve_backend
from sparsestreet.ops.cpu.library import tile_size
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.records.strict_json import Json

DEFAULT = SplatSettings()
PRESETS = ("default", "exact", "gsplat15", "gsplat16", "inria", "fast", "fine")
KNOBS: dict[str, tuple[float | int | bool | str, ...]] = {
    "alpha_min": (0.0, 1 / 1024, 1 / 512, 1 / 255, 1 / 128, 1 / 64),
    "max_sigma": (3.0, 3.33, 4.0, inf),
    "transmittance_min": (1e-5, 1e-4, 1e-3, 1e-2),
    "stop": ("inclusive", "exclusive"),
    "eps2d": (0.0, 0.1, 0.3),
    "half_colors": (False, True),
    "depth_bits": (12, 16, 24, 32),
}
"""Fields of SplatSettings and their values."""
BOXES_ALONE = (3.0, 3.33, 4.0)
"""Values of max_sigma without alpha_min. Either bounds a splat, so each would hide what the other costs."""
STOPS_EARLIER = (1e-3, 1e-2)
"""Values of transmittance_min for the exclusive stop; KNOBS has them for the inclusive stop.

The exclusive stop may lose transmittance_min / (1 - alpha_max) of a pixel's light, the inclusive one transmittance_min.
"""
OTHER_BACKENDS = (("cpu", torch.float64), ("reference", torch.float32), ("triton", torch.float32))
"""The backends besides C++ in float32, which times all other points."""


@dataclass(frozen=True)
class Point:
    """One configuration to time."""

    knob: str
    """The knob that is not at its default; ``default``, ``preset`` and ``backend`` for the rest."""
    value: str
    settings: SplatSettings
    preset: str | None = None
    """Name of the preset that has these settings."""
    backend: str = "cpu"
    dtype: torch.dtype = torch.float32
    effects: EffectsName | None = None
    """Lens and shutter that replace those of the scene's camera; None: its own."""

    @property
    def other_model(self) -> bool:
        """Whether the image differs on purpose: blur, clamp, compensation, lens and shutter change the model."""
        return _model(self.settings) != _model(DEFAULT) or self.effects not in (None, "off")

    @property
    def exact(self) -> SplatSettings:
        """Settings of this point's own model without cut-offs: R0."""
        blur, alpha_max, antialias = _model(self.settings)
        exact = SplatSettings.preset("exact")
        return replace(exact, eps2d=blur, alpha_max=alpha_max, antialias=antialias, near_plane=self.settings.near_plane)

    @property
    def same_cutoffs(self) -> SplatSettings:
        """Settings with this point's cut-offs, without its rounding of colors and depths: R1."""
        return replace(self.settings, half_colors=False, depth_bits=32)


def points() -> list[Point]:
    """All points: the default, every knob, presets that no knob reaches, effects and the other backends."""
    effects = [Point("effects", name, DEFAULT, effects=name) for name in EFFECTS]
    return [*_points_of_settings(), *effects, *backend_points()]


def backend_points() -> list[Point]:
    """The default's settings on the other backends and in other precision."""
    return [
        Point("backend", f"{name} {str(dtype).removeprefix('torch.')}", DEFAULT, backend=name, dtype=dtype)
        for name, dtype in OTHER_BACKENDS
    ]


def _points_of_settings() -> list[Point]:
    named = {name: SplatSettings.preset(name) for name in PRESETS}
    swept = [Point("default", "default", DEFAULT)]
    for knob, values in KNOBS.items():
        changed = [(value, replace(DEFAULT, **{knob: value})) for value in values]
        swept += [Point(knob, _text(knob, value), settings) for value, settings in changed if settings != DEFAULT]
    swept += [
        Point("box alone", _text("max_sigma", box), replace(DEFAULT, alpha_min=0.0, max_sigma=box))
        for box in BOXES_ALONE
    ]
    swept += [
        Point("exclusive stop", f"at {least:g}", replace(DEFAULT, stop="exclusive", transmittance_min=least))
        for least in STOPS_EARLIER
    ]
    met = [point.settings for point in swept]
    swept += [Point("preset", name, settings) for name, settings in named.items() if settings not in met]
    names = {settings: name for name, settings in reversed(named.items())}
    return [replace(point, preset=names.get(point.settings)) for point in swept]


def _model(settings: SplatSettings) -> tuple[float, float, bool]:
    return settings.eps2d, settings.alpha_max, settings.antialias


def _text(knob: str, value: float | int | bool | str) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"1/{round(1 / value)}" if knob == "alpha_min" and value else f"{value:g}"


FULL, QUICK, SMALL = Size(336, 224, 8_000), Size(48, 32, 200), Size(64, 48, 400)
"""Sizes of a sweep, of a trial, and of small copies for the dense reference.

On the copies it is timed, and it is the oracle of the truths."""
BUDGET = TimingBudget(repeats=20, seconds=2.0, least=3)
QUICK_BUDGET = TimingBudget(repeats=2, seconds=0.1, least=1)
DENSE_SAMPLES = 1 << 28
"""Most (row, pixel) samples for which the dense reference is timed; it takes about a second per 10^8."""
UNBOUNDED_PAIRS = 1 << 26
"""Most (splat, tile) pairs of a view without any bound that are computed: about 7 GB in float64."""
_EXACT_BACKEND = "cpu"


@dataclass(frozen=True)
class KnobRecord:
    """One point of one scene. Times are milliseconds."""

    scene: str
    source: str
    rows: int
    width: int
    height: int
    knob: str
    value: str
    preset: str | None
    backend: str
    dtype: str
    settings: dict[str, Json]
    """Fields of SplatSettings, as ``settings_entries`` writes them."""
    distortion: list[float] | None
    """Distortion of the timed camera; its shutter is translation, then rotation."""
    shutter: list[float] | None
    skipped: str | None
    """Why there is no measurement; times and errors are then None."""
    other_model: bool
    """Whether the image differs on purpose; ``model_psnr`` is then not an error."""
    model_psnr: float | None = None
    """dB between this model and the default one, both without cut-offs; None if they draw the same."""
    times: OpTimes | None = None
    exact: Errors | None = None
    """Errors against this model in float64 without cut-offs (R0); None if that covers too many tiles to be held."""
    same_cutoffs: Errors | None = None
    """Errors against this model in float64 with the same cut-offs (R1), which are due to rounding alone."""


@dataclass(frozen=True)
class OracleRecord:
    """The exact model of the C++ backend in float64 against the dense reference, on a small copy of a scene."""

    scene: str
    rows: int
    width: int
    height: int
    errors: Errors


class Truths:
    """Float64 answers of one scene, each computed once."""

    def __init__(self, scene: BenchScene) -> None:
        self._scene = scene
        self._answers: dict[tuple[SplatSettings, EffectsName | None], Answer] = {}

    def of(self, settings: SplatSettings, effects: EffectsName | None = None) -> Answer:
        if not self._depths_between(settings.near_plane, DEFAULT.near_plane):
            settings = replace(settings, near_plane=DEFAULT.near_plane)  # the same rows give the same answer
        if (settings, effects) not in self._answers:
            seen = seen_through(self._scene, effects)
            truth = answer(seen.gaussians, seen.camera, settings, _EXACT_BACKEND, torch.float64)
            self._answers[settings, effects] = truth
        return self._answers[settings, effects]

    def _depths_between(self, near: float, other: float) -> bool:
        pose = self._scene.camera.camera_from_world
        depths = self._scene.gaussians.means.double() @ pose[2, :3].double() + pose[2, 3].double()
        return bool(((depths > min(near, other)) & (depths <= max(near, other))).any())


def run_sweep(
    scenes: Sequence[BenchScene],
    small: Sequence[BenchScene],
    points: Sequence[Point],
    budget: TimingBudget,
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> None:
    """Measure all points of all scenes into ``file``.

    On the ``small`` copies the truth itself is checked, and the dense reference is timed next to the C++ backend
    (``small`` records). Raises RuntimeError with the remedy if the C++ backend, which computes the truths, is not
    built.
    """
    resolve_backend(_EXACT_BACKEND, torch.device("cpu"))
    for scene in small:
        file.write("oracle", check_oracle(scene))
        say(f"\nsmall copy of {title(scene)}")
        _measure_points(scene, [Point("default", "default", DEFAULT), *backend_points()], budget, "small", file, say)
    for scene in scenes:
        say(f"\n{title(scene)}")
        _measure_points(scene, points, budget, "knob", file, say)


def title(scene: BenchScene) -> str:
    """A scene's title for the terminal."""
    return f"{scene.name}: {scene.source}; {len(scene.gaussians)} splats, {scene.camera.width}x{scene.camera.height}"


def _measure_points(
    scene: BenchScene,
    points: Sequence[Point],
    budget: TimingBudget,
    kind: str,
    file: RecordFile,
    say: Callable[[str], None],
) -> None:
    truths = Truths(scene)
    for point in points:
        record = measure_point(scene, point, truths, budget)
        file.write(kind, record)
        say(describe(record))


def measure_point(scene: BenchScene, point: Point, truths: Truths, budget: TimingBudget) -> KnobRecord:
    """Measure time and error of one point, or say why that is impossible here."""
    record = _unmeasured(scene, point)
    if record.skipped is not None:
        return record
    times, value = time_and_answer(seen_through(scene, point.effects), point, budget)
    record = replace(record, times=times, same_cutoffs=errors(value, truths.of(point.same_cutoffs, point.effects)))
    if not affordable(scene, point.exact):
        return record
    exact = truths.of(point.exact, point.effects)
    record = replace(record, exact=errors(value, exact))
    if not point.other_model:
        return record
    default = truths.of(Point("default", "default", DEFAULT).exact)
    return replace(record, model_psnr=image_error(exact.image, default.image).psnr)


def time_and_answer(scene: BenchScene, point: Point, budget: TimingBudget) -> tuple[OpTimes, Answer]:
    """Times of a point, and what it draws."""
    device = "cuda" if point.backend == "triton" else "cpu"
    rows = leaves(scene.gaussians, point.dtype, device)
    times = time_op(rows, scene.camera, point.settings, point.backend, budget)
    return times, answer(scene.gaussians, scene.camera, point.settings, point.backend, point.dtype, device)


def _unmeasured(scene: BenchScene, point: Point) -> KnobRecord:
    lens, shutter = (getattr(seen_through(scene, point.effects).camera, name) for name in ("distortion", "shutter"))
    return KnobRecord(
        scene=scene.name,
        source=scene.source,
        rows=len(scene.gaussians),
        width=scene.camera.width,
        height=scene.camera.height,
        knob=point.knob,
        value=point.value,
        preset=point.preset,
        backend=point.backend,
        dtype=str(point.dtype).removeprefix("torch."),
        settings=settings_entries(point.settings),
        distortion=None if lens is None else lens.tolist(),
        shutter=None if shutter is None else [*shutter.translation.tolist(), *shutter.rotation.tolist()],
        skipped=unavailable(scene, point),
        other_model=point.other_model,
    )


def affordable(scene: BenchScene, settings: SplatSettings) -> bool:
    """Whether the pairs can be held if nothing bounds a splat, so that each covers every tile."""
    side = tile_size()
    tiles = -(-scene.camera.width // side) * -(-scene.camera.height // side)
    bounded = settings.alpha_min > 0 or settings.max_sigma < float("inf")
    return bounded or int((scene.gaussians.opacities > 0).sum()) * tiles <= UNBOUNDED_PAIRS


def unavailable(scene: BenchScene, point: Point) -> str | None:
    """Why a point cannot be timed here; None if it can."""
    samples = len(scene.gaussians) * scene.camera.width * scene.camera.height
    if point.backend == "reference" and samples > DENSE_SAMPLES:
        return f"dense: {samples:.2g} samples, more than the {DENSE_SAMPLES:.2g} that are timed; see the small copies"
    if not affordable(scene, point.settings):
        return f"nothing bounds a splat: more than {UNBOUNDED_PAIRS:.2g} (splat, tile) pairs"
    if point.backend == "triton":
        if "triton" not in BACKENDS:
            return "this version has no triton backend"
        if os.environ.get("TRITON_INTERPRET") == "1":
            return "the interpreter is on: its times say nothing about a device"
        if not torch.cuda.is_available():
            return "no CUDA device"
    return None


def check_oracle(scene: BenchScene) -> OracleRecord:
    """Compare two truths: two implementations of the exact model in float64."""
    exact = SplatSettings.preset("exact")
    fast, dense = (
        answer(scene.gaussians, scene.camera, exact, backend, torch.float64)
        for backend in (_EXACT_BACKEND, "reference")
    )
    camera = scene.camera
    return OracleRecord(scene.name, len(scene.gaussians), camera.width, camera.height, errors(fast, dense))


def describe(record: KnobRecord) -> str:
    """One line for the terminal."""
    name = f"  {record.knob} {record.value}" if record.knob != "default" else "  default"
    if record.times is None:
        return f"{name:<34} -- {record.skipped}"
    stages = record.times.stages
    times = f"{name:<34}{stages['forward'].median:9.2f} + {stages['backward'].median:9.2f} ms"
    if record.exact is None:
        return f"{times}   no exact image: too many pairs"
    psnr = record.exact.image.psnr
    image = "equal" if psnr is None else f"{psnr:6.1f} dB"
    note = f"  other model ({record.model_psnr:.1f} dB)" if record.model_psnr is not None else ""
    return f"{times}   {image}   gradient {worst_gradient(record.exact):.1e}{note}"


def worst_gradient(error: Errors) -> float:
    """Relative L2 of the parameter group with the largest error; infinite if a group's truth is zero."""
    values = (group.relative_l2 for group in error.gradients.values())
    return max(float("inf") if value is None else value for value in values)
