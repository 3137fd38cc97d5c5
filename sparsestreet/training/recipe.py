"""The parts of a training before any data is read, and the system that comes of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lightning import Callback

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evidence.light import measured_light
from sparsestreet.records.configuration import Setting, config_hash
from sparsestreet.records.run import EffectDecision, RunDescription, this_machine, this_source
from sparsestreet.scene.build import build_scene, find_points
from sparsestreet.scene.effects import EffectPlan, EffectSettings, plan_effects
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes import NodeSettings
from sparsestreet.scene.rendering import DEFAULT_OPTIONS, RenderOptions
from sparsestreet.training.callbacks import DensityControl, MaskTraining, Pruning
from sparsestreet.training.far_depth import FarDepthTerm
from sparsestreet.training.losses import Loss, MaskSparsity, Photometric
from sparsestreet.training.moved_views import MovedViews, moved_view_term
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.probe import Probe
from sparsestreet.training.schedule import ResolutionSchedule
from sparsestreet.training.system import StreetSystem
from sparsestreet.triangulation import ImagePointSettings, StreetPoints
from sparsestreet.types import View


@dataclass(frozen=True)
class Recipe:
    """The parts of a training by name: a method, and what makes it small. Only nodes must be given."""

    nodes: Mapping[str, NodeSettings]
    effects: Mapping[str, EffectSettings] = field(default_factory=dict)
    losses: Mapping[str, Loss] = field(default_factory=lambda: {"photometric": Photometric()})
    callbacks: Mapping[str, Callback] = field(default_factory=dict)
    """What changes Gaussians, and what watches; every run has those of ``training/run.py`` beside them."""
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    options: RenderOptions = DEFAULT_OPTIONS
    sh_interval: float = 0.0333
    """Fraction of the run after which one more degree of spherical harmonics is used."""
    sh_every: int = 2
    """Steps from one that moves the coefficients after the first to the next, from ``sh_every_from`` on."""
    sh_every_from: float = 0.36
    """Fraction of the run: where growth ends."""
    resolution: ResolutionSchedule = field(default_factory=ResolutionSchedule)
    """Size of the images that steps train on; by default they are whole."""
    seed: int = 0
    image_points: ImagePointSettings | None = None
    """How points are triangulated from the training images; None: not at all."""
    moved_views: MovedViews | None = None
    """How views beside the recorded path are trained on; None: not at all."""

    def problems(self) -> list[str]:
        """Parts that lack their counterpart, one sentence each; an empty list where all fits together."""
        masked = [name for name, settings in self.nodes.items() if settings.mask_settings is not None]
        found = []
        for part, group, kind in (("losses", self.losses, MaskSparsity), ("callbacks", self.callbacks, MaskTraining)):
            present = any(isinstance(value, kind) for value in group.values())
            if masked and not present:
                found.append(
                    f"the masks of {', '.join(masked)} have no {kind.__name__} among the {part}: derive one of your "
                    f"own from sparsestreet.training.{part}.{kind.__name__}, choose a sparsification that trains masks "
                    "(sparsify=...), or train none, sparsify.masks=false"
                )
            if present and not masked:
                found.append(f"{kind.__name__} is among the {part} but no node trains a mask: set sparsify.masks=true")
        for pruning in (callback for callback in self.callbacks.values() if isinstance(callback, Pruning)):
            if not any(pruning.rule.touches(name, settings) for name, settings in self.nodes.items()):
                found.append(
                    "Pruning is among the callbacks but its rule may touch no node: set node.X.prunable=true, or the "
                    "rule's nodes to null"
                )
        controlled = any(isinstance(callback, DensityControl) for callback in self.callbacks.values())
        if controlled and all(settings.density is None for settings in self.nodes.values()):
            found.append("DensityControl is among the callbacks but every node's density is null: leave it out")
        if shared := self.nodes.keys() & self.effects.keys():
            found.append(f"a node and an effect are both named {', '.join(sorted(shared))}: rename one of them")
        return found

    def left_whole(self, counts: Mapping[str, int]) -> list[str]:
        """Return a line on the nodes from which masks and pruning can take nothing, because they have no more Gaussians
        than their K_min; an empty list where there is none.

        Args:
            counts: Gaussians of each node (``SceneGraph.counts``).
        """
        rules = [callback.rule for callback in self.callbacks.values() if isinstance(callback, Pruning)]
        said = [
            f"{name} ({counts[name]:,} Gaussians, K_min {settings.min_gaussians:,})"
            for name, settings in self.nodes.items()
            if 0 < counts.get(name, 0) <= settings.min_gaussians
            and (settings.mask_settings is not None or any(rule.touches(name, settings) for rule in rules))
        ]
        remedy = "node.NAME.min_gaussians sets it"
        return [f"at or below K_min, where masks and pruning take nothing: {', '.join(said)}; {remedy}"] if said else []

    def check(self) -> None:
        """Raise ValueError where there are ``problems``."""
        if found := self.problems():
            raise ValueError("; ".join(found))

    def plan(self, data: StreetData) -> EffectPlan:
        """Say which effects the training part of the data calls for; where a measure alone does not, a probe does.

        Raises ValueError for an effect that is forced on and that the log cannot support.
        """
        plan, log, split = plan_effects(self.effects, _training_data(data)), data.driving_log, data.split
        for name in (planned.name for planned in plan.effects if planned.asks_for_probe):
            probe = Probe(
                log,
                split.train,
                split.held_out_indices,
                self.nodes,
                self.losses,
                self.optimizer,
                self.options,
                self.seed,
            )
            gain = probe.kept_gain(plan, name)
            if gain is not None:
                plan = plan.switched(name, gain.is_certain, gain)
        return plan

    def decisions(self, plan: EffectPlan, data: StreetData) -> tuple[EffectDecision, ...]:
        """The plan as records have it, with costs in a scene of as many Gaussians as the nodes' limits allow."""
        rows = sum(settings.max_gaussians or 0 for settings in self.nodes.values())
        return plan.decisions(_training_data(data), rows)

    def build(self, data: StreetData, plan: EffectPlan) -> StreetSystem:
        """Start the scene from the training part of the data, and wrap it for training."""
        log, split = data.driving_log, data.split
        points = find_points(log, split.train, split.held_out_indices, self.nodes, self.image_points)
        scene = build_scene(log, split.train, split.held_out_indices, self.nodes, plan, self.seed, points)
        return StreetSystem(
            scene,
            self.losses,
            self.optimizer,
            radius=log.radius,
            options=self.options,
            sh_interval=self.sh_interval,
            sh_every=self.sh_every,
            sh_every_from=self.sh_every_from,
            resolution=self.resolution,
            far_depth=self._far_depth(points, split.train.views),
            moved_views=None
            if self.moved_views is None
            else moved_view_term(self.moved_views, data, scene, self.nodes, self.seed),
        )

    def _far_depth(self, points: StreetPoints | None, views: Sequence[View]) -> FarDepthTerm | None:
        sweep = None if self.image_points is None else self.image_points.sweep
        if sweep is None or points is None or points.far is None:
            return None
        return FarDepthTerm(points.far, views, sweep)


def _training_data(data: StreetData) -> TrainingData:
    return TrainingData(data.driving_log, data.split.train, data.split.held_out_indices)


@dataclass(frozen=True, kw_only=True)
class RunIdentity:
    """How the records of a run name it. Runs of one label and one ``config`` are repeats to ``sparsestreet report``."""

    label: str
    """The run's column in a table, such as "streetgs+paper"."""
    method: str = "python"
    """Which scene is trained, such as "streetgs"."""
    sparsify: str = "none"
    """What makes it small, such as "paper"; "none" for a plain run."""
    config: Mapping[str, Setting] = field(default_factory=dict)
    """The resolved configuration, flat: dotted key -> value; empty where there is none."""
    follows: Mapping[str, Setting] = field(default_factory=dict)
    """As in ``RunDescription``."""
    data_hash: str = ""
    """``LogReader.data_hash``; empty where nobody asked for it."""
    command: str = "python"
    """What was typed to train."""

    def describe(
        self, recipe: Recipe, data: StreetData, max_steps: int, effects: tuple[EffectDecision, ...] = ()
    ) -> RunDescription:
        """The run before its first step, for ``RunFiles``, which says at the end how training went."""
        return RunDescription(
            method=self.method,
            sparsify=self.sparsify,
            label=self.label,
            scene=data.driving_log.name,
            seed=recipe.seed,
            split=data.split_in_words,
            cameras=_cameras(data.driving_log),
            config=dict(self.config),
            follows=dict(self.follows),
            config_hash=config_hash(self.config),
            data_hash=self.data_hash,
            masks=_masks(data.driving_log),
            command=self.command,
            device="",
            threads=0,
            steps=0,
            max_steps=max_steps,
            training_seconds=None,
            noise=None,
            caps={},
            effects=effects,
            light=measured_light(data.split.train, data.driving_log.kept).numbers(),
            machine=this_machine(),
            source=this_source(),
        )


def _cameras(log: DrivingLog) -> tuple[str, ...]:
    """Name and size of each camera, in their order."""
    sizes = {view.indices[1]: f"{view.camera.width}x{view.camera.height}" for view in log.views}
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    return tuple(f"{names[index]} {sizes[index]}" for index in sorted(sizes))


def _masks(log: DrivingLog) -> dict[str, str]:
    """Kind -> whose masks; empty where the log does not tell."""
    return {} if log.masks is None else {kind: log.masks.get(kind, "none") for kind in ("sky", "human", "vehicle")}
