"""What a preset says of a training beside its values: methods that it lacks, and where the run is not upstream's."""

from collections.abc import Iterator

from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.option_files import options_of


def preset_problem(cfg: DictConfig) -> str | None:
    """One line where the preset has no configuration of the method; None where it has, or needs none."""
    if not OmegaConf.is_missing(cfg.preset, "method"):
        return None
    found = options_of(f"preset/method/{cfg.preset.name}")
    return (
        f"preset={cfg.preset.name} has no configuration of method={cfg.method.name}: choose method="
        f"{' or '.join(found)}, or another preset"
    )


def preset_notes(cfg: DictConfig) -> Iterator[str]:
    """Lines that a training logs before its first step; none for a preset of our own."""
    preset = cfg.preset
    if preset.label.endswith("_scaled"):
        yield (
            f"preset {preset.name} is scaled: DriveStudio's has schedule=paper capacity=paper; here its milestones "
            f"are fractions of {cfg.schedule.max_steps:,} steps, and capacity={cfg.capacity.name} sets sizes"
        )
    if absent := preset.get("absent"):
        yield f"preset {preset.name} lacks of DriveStudio: {'; '.join(absent.values())}"
