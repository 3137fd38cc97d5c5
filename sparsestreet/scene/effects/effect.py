"""What every effect has in common: what is said about it, and where it acts.

An effect is what cameras and light do to the image of a scene: a lens, an exposure, the sky. A scene has those that its
log calls for, by name; one that it does not have is not built and costs nothing.
"""

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from sparsestreet.pictures.images import Panel
from sparsestreet.records.run import EffectDecision
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import Rates, rates_of
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.state import RenderOptions, SceneState
from sparsestreet.types import Camera, Gaussians, Rendering, View


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Whether a log calls for an effect, and why."""

    called_for: bool
    reason: str
    """One sentence, without a full stop."""
    value: float | None = None
    """What was measured or counted; None: nothing."""
    unit: str = ""
    """Of the value and its threshold."""
    threshold: float | None = None
    """Value from which the effect is called for."""
    noise: float | None = None
    """Standard error of the value; None: it is counted, or declared without one."""
    declared: bool = False
    """Whether the log's files say the value; False: it is measured from images, points and boxes."""
    missing: str | None = None
    """What the log lacks for the effect to be simulated, one sentence with the remedy; None: nothing."""
    gain: float | None = None
    """Predicted gain in PSNR over the images, dB; None: there is no prediction."""
    evidence: Callable[[], Sequence[Panel]] = tuple
    """Makes the pictures by which a person judges the value; asked only if they are drawn."""

    def is_near(self) -> bool:
        """Whether the value alone does not decide: it may be the threshold, or is less than twice as large."""
        if self.value is None or self.threshold is None or self.noise is None or self.missing is not None:
            return False
        return self.threshold - 2 * self.noise <= self.value < 2 * self.threshold


@dataclass(frozen=True)
class ProbedGain:
    """What a short training with an effect is better by than one without it, in views that neither saw."""

    mean: float
    """dB."""
    error: float
    """Standard error of the mean, from the differences between images."""
    images: int

    @property
    def is_certain(self) -> bool:
        """Whether it is above 0 by more than its error."""
        return self.mean > self.error


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What an effect is predicted to cost: numbers that are stored, and time of a frame by pixels and rows.

    Times are those of one thread of the machine that docs/effects.md names; another machine scales all alike.
    """

    numbers: int = 0
    """Learned or stored, float32."""
    ns_per_pixel: float = 0.0
    ns_per_row: float = 0.0
    ms_per_frame: float = 0.0
    """Whatever its size."""

    def ms(self, pixels: int, rows: int) -> float:
        """Milliseconds of a rendered frame of so many pixels, of a scene of so many Gaussians."""
        return self.ms_per_frame + 1e-6 * (self.ns_per_pixel * pixels + self.ns_per_row * rows)


@dataclass(frozen=True)
class Moment:
    """One of the instants over which light is gathered."""

    camera: Camera
    """Where the camera of the view is then."""
    share: float
    """Of the whole exposure, from its middle: -1/2 is its start."""
    weight: float
    """Part of the light; those of all moments sum to 1."""


@dataclass(frozen=True)
class Exposed:
    """What a view gathers its light over, instead of at one instant."""

    span: float
    """The exposure in the log's normalized time, for whatever moves meanwhile."""
    moments: tuple[Moment, ...]


@dataclass(frozen=True, kw_only=True)
class EffectSettings(ABC):
    """Everything that is said about one effect. Raises ValueError where ``when`` is none of its words."""

    when: Literal["auto", "on", "off"] = "auto"
    """auto: the scene has the effect if its log calls for it; on: in any case; off: never, whatever the log says."""
    found_when_off: ClassVar[bool] = False
    """Whether the plan says what the log shows also where the effect is off: for those that are off by default."""
    probed: ClassVar[bool] = False
    """Whether two short trainings decide where the value is near the threshold (``training.probe``)."""
    learning_rates: Rates = field(default_factory=dict)
    """Parameter or module of the effect -> its rate, or the fields of one; the longest name that matches wins."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "learning_rates", rates_of(self.learning_rates))
        if self.when not in ("auto", "on", "off"):
            raise ValueError(f"when must be auto, on or off, got {self.when!r}: in a YAML file write 'on' in quotes")

    @abstractmethod
    def detect(self, data: TrainingData) -> Finding:
        """Whether the log calls for the effect: from its files, its training views and their sweeps, in seconds.

        Not asked where ``when`` is off, unless ``found_when_off``.
        """

    def cost(self, data: TrainingData) -> Cost:
        """What the effect would cost if the scene had it; by default nothing."""
        return Cost()

    def prepare(self, nodes: Iterable[Node], on: bool) -> None:
        """Tell nodes that are built what the plan says, where the effect is a matter of theirs; by default nothing."""
        return None

    @abstractmethod
    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Effect | None":
        """Make the effect; None where it is a matter of the log alone and the scene needs no part of it.

        Not asked where the finding says that something is ``missing``: the plan raises before.
        """

    @abstractmethod
    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Effect":
        """The effect of a scene file: all its tensors by name, and what ``Effect.header`` said.

        What the tensors hold need not be copied: they are loaded into the scene afterwards.
        """

    def left_out(self) -> "Effect | None":
        """What stands in the place of the effect where it is off or left out; None: nothing.

        What a camera declares is taken away from it there. The settings of a stand-in say ``off``.
        """
        return None


@dataclass(frozen=True, kw_only=True)
class PartlessSettings(EffectSettings):
    """The plan says what is called for, and the scene gets no effect of it: it is a matter of the log or of nodes."""

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Effect | None":
        return None

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Effect":
        raise ValueError(f"no scene lists {type(self).__name__} among its effects: write the file again")


class Effect(nn.Module, ABC):
    """One effect. It acts on the view before the nodes, on the image behind the splats, or on both.

    A view without frame and camera index is a novel one: it is answered from its camera and time alone.
    """

    def __init__(self, settings: EffectSettings) -> None:
        super().__init__()
        self.settings = settings

    def view(self, view: View, state: SceneState) -> View:
        """The view as nodes and splats see it."""
        return view

    def exposed(self, view: View) -> Exposed | None:
        """Instants whose images are averaged, in linear light and behind all effects; None: the view's own alone.

        ``view`` is the one that is splatted. At most one effect of a scene answers.
        """
        return None

    def gaussians(self, gaussians: Gaussians, view: View) -> Gaussians:
        """The Gaussians as the op gets them: the same values, of which gradients reach what the effect learns."""
        return gaussians

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        """The image behind the effect; ``rgb`` is that before it, ``view`` the one that was splatted."""
        return rgb

    def gain(self, view: View) -> Float[Tensor, "3"] | None:
        """Return factors by which ``image`` multiplies red, green and blue in this view more than in others; None: 1.

        For whoever compares colors of different images.
        """
        return None

    def slope(self, view: View) -> Float[Tensor, "h w"] | None:
        """Derivative of ``image`` with respect to ``rgb``, the same for all channels and above 0; None: 1.

        For whoever asks how far the image moves with the splats, without rendering it again.
        """
        return None

    def background(self, view: View) -> Float[Tensor, "h w 3"] | None:
        """Light that ``image`` lets through where the splats leave some: minus its derivative by alpha; None: none."""
        return None

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        """Terms of the loss that concern the effect alone, by name, each with its weight."""
        return {}

    def header(self) -> dict[str, Any]:
        """What a scene file has to know beside settings and tensors; JSON values only."""
        return {}

    @property
    def has_image(self) -> bool:
        """Whether it acts on images: then it is a phase of a frame."""
        return type(self).image is not Effect.image

    @property
    def is_on(self) -> bool:
        """False for what stands in the place of an effect that is left out."""
        return self.settings.when != "off"


@dataclass(frozen=True)
class LinearizedEffects:
    """A small change of the image: ``slope`` (d rgb - ``background`` d alpha), with rgb and alpha of the splats."""

    slope: Float[Tensor, "h w"] | None
    """None: 1."""
    background: Float[Tensor, "h w 3"] | None
    """None: black."""

    def weights(self, of_image: Float[Tensor, "*w h w"]) -> Float[Tensor, "*w h w"]:
        """What the squared change of a pixel of the splats weighs where that of the image has these weights."""
        return of_image if self.slope is None else of_image * self.slope.square()

    def most(self, of_splats: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        """An upper bound of changes of the image: those of the splats times the largest slope of any pixel."""
        return of_splats if self.slope is None else self.slope.max() * of_splats


def neighbors_in_time(times: Sequence[float], time: float) -> tuple[int, int, float]:
    """Return the places of increasing times around one, and its part of the way between them; beyond the ends one
    place, twice.

    >>> [neighbors_in_time([0.0, 0.5], time) for time in (-1.0, 0.125, 0.5, 2.0)]
    [(0, 0, 0.0), (0, 1, 0.25), (0, 1, 1.0), (1, 1, 0.0)]
    """
    behind = bisect_left(times, time)
    before, behind = max(behind - 1, 0), min(behind, len(times) - 1)
    step = times[behind] - times[before]
    return before, behind, (time - times[before]) / step if step > 0 else 0.0


def linearized(effects: Iterable[Effect], view: View) -> LinearizedEffects:
    """All effects of a scene in their order, for a view as its splats see it.

    With slopes s_k and backgrounds b_k, x_k = s_k x_(k-1) + (1 - alpha) b_k: together the product of all s_k, and the
    sum of b_k / (s_1 ... s_k).
    """
    slope = background = None
    for effect in effects:
        own, behind = effect.slope(view), effect.background(view)
        if own is not None:
            slope = own if slope is None else slope * own
        if behind is not None:
            light = behind if slope is None else behind / slope[..., None]
            background = light if background is None else background + light
    return LinearizedEffects(slope, background)


@dataclass(frozen=True)
class PlannedEffect:
    """One effect, what was found out about it, and what follows."""

    name: str
    settings: EffectSettings
    finding: Finding
    on: bool
    probe: ProbedGain | None = None
    """What decided, where the finding alone did not."""

    @property
    def asks_for_probe(self) -> bool:
        """Whether two short trainings should decide."""
        return self.settings.probed and self.settings.when == "auto" and self.finding.is_near()

    @property
    def only_found(self) -> bool:
        """Whether the log calls for it, and something is missing for a scene to have it."""
        return self.finding.called_for and not self.on and self.probe is None

    def _reason(self) -> str:
        if self.probe is not None:
            gain = f"{self.probe.mean:+.2f} ± {self.probe.error:.2f} dB in {self.probe.images} images"
            return f"{self.finding.reason}; near the threshold two short trainings decide: {gain} with the effect"
        if not self.only_found:
            return self.finding.reason
        switched = f" (effects.{self.name}=auto simulates it)" if self.settings.when == "off" else ""
        return f"found, not simulated{switched}: {self.finding.reason}"

    def _source(self) -> str:
        if self.settings.when != "auto":
            return "forced"
        return "probed" if self.probe is not None else "declared" if self.finding.declared else "measured"

    def decision(self, data: TrainingData, rows: int) -> EffectDecision:
        """The effect as records have it, for a scene of ``rows`` Gaussians."""
        finding, cost = self.finding, self.settings.cost(data)
        return EffectDecision(
            name=self.name,
            on=self.on,
            source=self._source(),
            reason=self._reason(),
            value=finding.value,
            unit=finding.unit,
            threshold=finding.threshold,
            noise=finding.noise,
            numbers=cost.numbers,
            ms=cost.ms(_pixels(data), rows),
            gain=finding.gain,
        )


@dataclass(frozen=True)
class EffectPlan:
    """All effects that a configuration knows, in the order in which they act on an image."""

    effects: tuple[PlannedEffect, ...]

    def switched(self, name: str, on: bool, probe: ProbedGain | None = None) -> "EffectPlan":
        """Return the plan with one effect on or off, and what decided it."""
        changed = (replace(one, on=on, probe=probe) if one.name == name else one for one in self.effects)
        return EffectPlan(tuple(changed))

    def decisions(self, data: TrainingData, rows: int) -> tuple[EffectDecision, ...]:
        """What ``run.json`` holds, for a scene of ``rows`` Gaussians."""
        return tuple(effect.decision(data, rows) for effect in self.effects)


def plan_effects(effects: Mapping[str, EffectSettings], data: TrainingData) -> EffectPlan:
    """Ask every effect whether the log calls for it. Trains nothing, builds nothing, and takes seconds.

    Raises ValueError, saying what is missing, for an effect that is forced on and that the log cannot support.
    """
    return EffectPlan(tuple(_planned(name, settings, data) for name, settings in effects.items()))


_OFF = Finding(called_for=False, reason="the configuration says so")
"""What is off is not looked for, unless it is off by default."""


def _planned(name: str, settings: EffectSettings, data: TrainingData) -> PlannedEffect:
    when = settings.when
    finding = _OFF if when == "off" and not settings.found_when_off else _found(name, settings, data)
    if when == "on" and finding.missing is not None:
        raise ValueError(f"effects.{name} is on, but {finding.reason}: {finding.missing}, or say auto")
    on = when == "on" or (when == "auto" and finding.called_for and not finding.missing)
    return PlannedEffect(name, settings, finding, on)


def _found(name: str, settings: EffectSettings, data: TrainingData) -> Finding:
    """What is detected; a finding that is kept from an earlier run detects anew where its pictures are asked for."""
    detected: list[Finding] = []
    said = replace(settings, when="auto", learning_rates={})  # which are no matter of the log

    def detect() -> Finding:
        detected.append(settings.detect(data))
        return replace(detected[0], evidence=tuple)

    kept = data.log.kept.get(f"effect-{name}", said, detect, Finding)
    return detected[0] if detected else replace(kept, evidence=lambda: settings.detect(data).evidence())


def _pixels(data: TrainingData) -> int:
    """Of the largest image that is trained on."""
    return max(view.camera.width * view.camera.height for view in data.views)
