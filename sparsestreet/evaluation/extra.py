"""What is measured of a finished scene where somebody asks: beside the recorded path, and rendered in other ways."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import Truth
from sparsestreet.evaluation.novel import evaluate_novel
from sparsestreet.evaluation.presets import evaluate_presets
from sparsestreet.evaluation.speed import Timing
from sparsestreet.metrics.extractors import LastLayer
from sparsestreet.metrics.lpips_weights import open_lpips
from sparsestreet.ops import SplatSettings
from sparsestreet.phases import stage
from sparsestreet.records.renders import NOVEL, PRESETS, NovelRecord, PresetRecord
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions


@dataclass(frozen=True)
class ExtraMetrics:
    """Raises ValueError for offsets that are not above 0, a ramp without offsets, or unknown presets."""

    novel: Sequence[float | int] = ()
    """Meters by which the held-out cameras are shifted to both sides."""
    ramp: bool = False
    """Whether the shift grows over the drive, as in a change of lane."""
    presets: Sequence[str] = ()
    """Ways to render, names of ``render.preset``."""
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
            ways = {name: RenderOptions(SplatSettings.preset(name)) for name in self.presets}
            with stage("presets"):
                rendered = evaluate_presets(scene, views, ways, options, command=command)
                PRESETS.write(out, rendered)
            for line in _of_presets(rendered):
                say(line)

    def _beside(
        self, scene: SceneGraph, views: Frames, options: RenderOptions, truth: Truth | None, command: str
    ) -> NovelRecord:
        lpips, missing = open_lpips(scene.device)
        network = lpips.get("lpips_alex")
        return evaluate_novel(
            scene,
            views,
            self.novel,
            options,
            command=command,
            truth=truth,
            extractor=None if network is None else LastLayer("alexnet", network),
            lpips=network,
            absent=missing.get("lpips_alex", ""),
            ramp=self.ramp,
        )


def _of_shifts(record: NovelRecord) -> Iterator[str]:
    for shift in record.shifts:
        said = [f"{name} {value:.4g}" for name, value in shift.distances.items()]
        said += [f"{shift.truth['psnr_full']:.2f} dB to the truth"] if shift.truth else []
        side = "right" if shift.offset > 0 else "left"
        what = ", ".join(said) or "nothing to compare with"
        yield f"{abs(shift.offset):g} m to the {side} (n={shift.views}): {what}"
    if record.absent:
        yield f"no distances: {record.absent}"


def _of_presets(record: PresetRecord) -> Iterator[str]:
    for one in record.rendered:
        yield (
            f"{one.preset}{' (as trained)' if one.trained else ''}: {one.quality['psnr_full']:.2f} dB, "
            f"{one.psnr_to_exact:.1f} dB to the exact image, {one.frame_ms:.1f} ms/frame"
        )
