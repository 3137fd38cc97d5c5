"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from sparsestreet.cli.assemble import data_of, this_command
from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.options import run_command
from sparsestreet.cli.scene import open_scene
from sparsestreet.data.datamodule import StreetData
from sparsestreet.evaluation.history import draw_history
from sparsestreet.evaluation.novel import evaluate_novel, novel_path, write_novel
from sparsestreet.evaluation.preset_record import preset_path, write_presets
from sparsestreet.evaluation.presets import evaluate_presets
from sparsestreet.evaluation.provenance import this_machine
from sparsestreet.evaluation.records import RunDescription, read_run, run_path, summary_path
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.metrics.extractors import LastLayer
from sparsestreet.metrics.lpips_weights import open_lpips
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene

USAGE = """\
sparsestreet evaluate run=RUN [device=cpu|cuda] [novel=1,2,3] [ramp=true] [presets=fast,default,exact]

RUN is a folder that train wrote, also of a run that was interrupted. Its scene is measured against the views of its
log, on the kind of device that it was trained on unless another is named, with as many threads as trained it; records
and pictures are made anew, what is said about the training stays.

With novel, the held-out cameras are also shifted by so many meters to both sides, and compared with the real images
and, on a street that was made with data.log.settings.novel_offsets, with the truth; with ramp the shift grows over the
drive, as in a change of lane. records/novel.json holds what was found.

With presets (of conf/render), the same views are also rendered in these ways, whatever training did: what it costs and
saves is in records/presets.json, and in the report of the run's sweep.
"""


@dataclass(frozen=True)
class Options:
    """The words of the command."""

    run: Path
    device: Literal["cpu", "cuda"] | None = None
    novel: tuple[float, ...] = ()
    ramp: bool = False
    presets: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for preset in self.presets:
            SplatSettings.preset(preset)
        if any(offset <= 0 for offset in self.novel):
            raise ValueError(f"novel must be meters above 0, got {list(self.novel)}: each is taken to both sides")
        if self.ramp and not self.novel:
            raise ValueError("ramp=true says how the views of novel are shifted: say novel=1,2,3 too")


def evaluate(arguments: list[str]) -> int:
    """Open the run's scene and its log, write records and pictures; statuses as in ``run_command``."""
    return run_command("evaluate", USAGE, arguments, Options, _evaluate)


def _evaluate(options: Options) -> None:
    run = options.run
    cfg, description = load_run_config(run), read_run(run_path(run))
    # The milliseconds of a run are those of one number of threads, and never of more than there are cores.
    torch.set_num_threads(min(description.threads, this_machine().cores))
    stored = open_scene(run, "cpu")
    data = data_of(cfg)
    summary = evaluate_scene(
        stored.scene,
        data.split.held_out,
        data.split.train,
        run=description,
        options=stored.options,
        out=run,
        command=this_command(["evaluate", f"run={run}"]),
        device=_device(description, options.device),
    )
    draw_history(run)
    for split, quality in summary.quality.items():
        print(f"{split.replace('_', '-')} views: {quality['psnr_full'].mean:.2f} dB")
    latency = summary.latency
    steady = "" if latency.noise.quiet else " on a machine that was not quiet"
    print(f"{summary.gaussians_total:,} Gaussians, {latency.p50:.1f} ms/frame{steady}; records in {summary_path(run)}")
    if options.novel:
        _novel(options, cfg, stored, data)
    if options.presets:
        _presets(options, stored, data)


def _novel(options: Options, cfg: DictConfig, stored: StoredScene, data: StreetData) -> None:
    """Measure beside the recorded path, record it and say it."""
    lpips, missing = open_lpips(stored.scene.device)
    network = lpips.get("lpips_alex")
    words = [f"run={options.run}", f"novel={','.join(f'{offset:g}' for offset in options.novel)}"]
    record = evaluate_novel(
        stored.scene,
        data.split.held_out or data.split.train,
        options.novel,
        stored.options,
        command=this_command(["evaluate", *words, *(["ramp=true"] if options.ramp else [])]),
        truth=instantiate(cfg.data.log, _convert_="all").shifted(data.driving_log),
        extractor=None if network is None else LastLayer("alexnet", network),
        absent=missing.get("lpips_alex", ""),
        ramp=options.ramp,
    )
    write_novel(novel_path(options.run), record)
    for shift in record.shifts:
        said = [f"{name} {value:.4g}" for name, value in shift.distances.items()]
        said += [] if shift.psnr is None else [f"{shift.psnr:.2f} dB to the truth (n={shift.true_views})"]
        side = "right" if shift.offset > 0 else "left"
        print(
            f"{abs(shift.offset):g} m to the {side} (n={shift.views}): {', '.join(said) or 'nothing to compare with'}"
        )
    if record.absent:
        print(f"no distances: {record.absent}")


def _presets(options: Options, stored: StoredScene, data: StreetData) -> None:
    """Render in other ways, record it and say it."""
    record = evaluate_presets(
        stored.scene,
        data.split.held_out or data.split.train,
        {name: RenderOptions(SplatSettings.preset(name)) for name in options.presets},
        stored.options,
        command=this_command(["evaluate", f"run={options.run}", f"presets={','.join(options.presets)}"]),
    )
    write_presets(preset_path(options.run), record)
    for one in record.rendered:
        print(
            f"{one.preset}{' (as trained)' if one.trained else ''}: {one.quality['psnr_full']:.2f} dB, "
            f"{one.psnr_to_exact:.1f} dB to the exact image, {one.frame_ms:.1f} ms/frame"
        )


def _device(description: RunDescription, device: str | None) -> torch.device:
    """The one that is asked for, else of the kind that trained. Raises ValueError where that is not there."""
    wanted = torch.device(device or description.device.partition(":")[0])
    if wanted.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"the run was trained on {description.device} and torch sees no CUDA device here: its milliseconds would "
            "be another machine's; say device=cpu to measure on the CPU all the same"
        )
    return wanted
