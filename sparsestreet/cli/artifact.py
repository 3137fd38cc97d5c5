"""``sparsestreet export RUN street.usdz``: what AlpaSim loads of a scene beside its pictures."""

from pathlib import Path

from sparsestreet.cli.scene import open_scene
from sparsestreet.records.run import RUN
from sparsestreet.scene.beside import views_of


def export_artifact(
    run: Path,
    out: Path,
    car: tuple[float, ...] | None,
    mount: tuple[float, ...] | None,
    names: tuple[str, ...] | None,
    parts: tuple[str, ...] = (),
) -> None:
    """Write the file and say what is in it. Raises what ``open_scene`` and ``write_artifact`` do."""
    try:
        from sparsestreet.serving.artifact import DEFAULT_CAR, Provenance, write_artifact
        from sparsestreet.serving.scenes import RigOptions, named_runs, open_run
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"a .usdz needs {error.name}: pip install 'sparsestreet[serve]'") from error
    (name,) = named_runs([run])
    served = open_run(run, name, lambda path: open_scene(path, "cpu", parts), RigOptions(mount, names))
    described = RUN.find(run)
    provenance = Provenance(
        "" if described is None else described.source.commit or "",
        "" if described is None else described.data_hash,
        0 if described is None else described.seed,
    )
    counts = write_artifact(out, served, views_of(run), provenance, car or DEFAULT_CAR)
    said = ", ".join(f"{count} {what[:-1] if count == 1 else what}" for what, count in counts.items())
    print(f"{out}: scene {name!r} with {said}; sparsestreet serve {run} gives its pictures")
