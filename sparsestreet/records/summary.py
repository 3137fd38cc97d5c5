"""``records/summary.json``: the identity of a run and its measurements, for other programs and for our report.

Training writes ``RUN/run.json`` once. Each evaluation writes ``RUN/records/summary.json``, which holds the content of
the former unchanged. Both are written whole or not at all.
"""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.latency import Latency
from sparsestreet.records.quality import HELD_OUT, TRAINING, MetricSummary
from sparsestreet.records.run import CodeVersion, Machine, RunDescription
from sparsestreet.records.strict_json import version

FORMAT = 4
"""Version of ``summary.json``; raised when a key changes its meaning."""


@dataclass(frozen=True)
class Evaluation:
    """The command, machine and code that measured a run."""

    command: str
    machine: Machine
    source: CodeVersion
    device: str
    threads: int


@dataclass(frozen=True)
class GuardCounts:
    """Number of Gaussians that the guards of the splat op acted on (``sparsestreet.ops.Guards``), summed over views."""

    rows: dict[str, int]
    """Name of a guard -> Gaussians, 0 included."""
    alarms: dict[str, int]
    """The guards that acted although a clean scene never needs them; empty if all is well."""

    def __post_init__(self) -> None:
        for name, count in self.alarms.items():
            if count < 1 or self.rows.get(name) != count:
                raise ValueError(f"alarms holds {name}: {count}, rows has {self.rows.get(name)}: evaluate again")


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The content of ``summary.json``."""

    format: int = version(FORMAT, "evaluate again")
    run: RunDescription
    evaluated: Evaluation
    images: dict[str, int]
    """Split ("held_out", "training") -> number of its evaluated images; a split without views is absent."""
    resolutions: tuple[str, ...]
    """The different sizes of the evaluated images, as "WIDTHxHEIGHT"."""
    quality: dict[str, dict[str, MetricSummary]]
    """Split -> id of a metric -> its summary over the split's images."""
    by_camera: dict[str, dict[str, dict[str, float | None]]]
    """Split -> number of a camera -> id of a metric -> its mean over the split's images of that camera."""
    definitions: dict[str, str]
    """Id of a metric -> its definition in words."""
    absent: dict[str, str]
    """Quantity that could not be measured, such as "lpips_alex" -> why, and what to do about it."""
    gaussians: dict[str, int]
    """Node -> number of Gaussians of all its instances, visible or not."""
    gaussians_total: int
    bytes_by_part: dict[str, int]
    bytes_total: int
    latency: Latency
    """Times over the views of ``main_split``, on the device that it names."""
    latency_protocol: str
    guards: GuardCounts
    """Counts over the views of ``main_split``."""

    def __post_init__(self) -> None:
        splits = [sorted(part) for part in (self.quality, self.by_camera, self.images)]
        if splits[0] not in ([HELD_OUT], [TRAINING], [HELD_OUT, TRAINING]) or splits != 3 * splits[:1]:
            raise ValueError(
                f"quality speaks of the splits {splits[0]}, by_camera of {splits[1]} and images of {splits[2]}, "
                f"expected {HELD_OUT}, {TRAINING} or both in all: evaluate again"
            )
        for name, parts, total in (
            ("gaussians", self.gaussians, self.gaussians_total),
            ("bytes", self.bytes_by_part, self.bytes_total),
        ):
            if sum(parts.values()) != total:
                raise ValueError(f"{name}_total is {total}, its parts sum to {sum(parts.values())}: {parts}")

    @property
    def main_split(self) -> str:
        """The held-out split, or the training split of a run that holds out no views."""
        return HELD_OUT if HELD_OUT in self.quality else TRAINING

    def mean(self, metric: str, split: str | None = None) -> float | None:
        """Returns the mean of a metric over the images of a split (default ``main_split``); None if not measured."""
        found = self.quality.get(split or self.main_split, {}).get(metric)
        return None if found is None else found.mean

    def camera_mean(self, metric: str, camera: str) -> float | None:
        """Returns the mean of a metric over one camera's images of ``main_split``; None if not measured."""
        return self.by_camera[self.main_split].get(camera, {}).get(metric)


SUMMARY = JsonFile("records/summary.json", RunSummary)
