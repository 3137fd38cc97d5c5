"""What a run is called, and what made it: the part of ``run.json`` that is known before training starts."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evidence.light import measured_light
from sparsestreet.records.configuration import Setting, config_hash
from sparsestreet.records.run import EffectDecision, RunDescription, this_machine, this_source
from sparsestreet.training.recipe import Recipe


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
            config_hash=config_hash(self.config),
            data_hash=self.data_hash,
            command=self.command,
            device="",
            threads=0,
            steps=0,
            max_steps=max_steps,
            training_seconds=None,
            noise=None,
            caps={},
            effects=effects,
            light=measured_light(data.split.train).numbers(),
            machine=this_machine(),
            source=this_source(),
        )


def _cameras(log: DrivingLog) -> tuple[str, ...]:
    """Name and size of each camera, in their order."""
    sizes = {view.indices[1]: f"{view.camera.width}x{view.camera.height}" for view in log.views}
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    return tuple(f"{names[index]} {sizes[index]}" for index in sorted(sizes))
