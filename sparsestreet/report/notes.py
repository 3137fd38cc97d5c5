"""The notes below a table: how its numbers are defined, and where runs differ."""

from collections import Counter
from collections.abc import Sequence

from sparsestreet.metrics.definitions import LIDAR_REACH, Protocol
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.summary import TRAINING, RunSummary
from sparsestreet.report.tables import CAPPED, busy_note
from sparsestreet.report.variants import Repeats


def notes(variants: Sequence[Repeats], over_scenes: bool, protocol: Protocol) -> list[str]:
    """Returns the notes of one table: first the general ones, then those about its runs."""
    runs = [run for variant in variants for run in variant.runs]
    return [
        *_general(runs, over_scenes, protocol),
        *_absent(runs, protocol),
        *_timing(runs),
        *_training(runs),
        *busy_note((variant.name, run) for variant in variants for run in variant.runs),
        *(_scenes(variants) if over_scenes else ()),
        *_lacking_seeds(variants),
        *_long_names(variants),
        *_repeated_seeds(variants),
        *_unfinished(variants),
        *_caps(variants),
        _guards(variants),
    ]


def camera_notes(variants: Sequence[Repeats]) -> list[str]:
    """Returns the notes of a table by camera. All other notes stand below the table that precedes it."""
    runs = [run for variant in variants for run in variant.runs]
    return [f"PSNR in dB of {_views(runs)}, the mean over the images of each camera; the rest as above"]


def _general(runs: Sequence[RunSummary], over_scenes: bool, protocol: Protocol) -> list[str]:
    alone = "n=1 has no spread and proves nothing below the noise of runs"
    mean = (
        "each scene counts once, with the mean of its runs; ± is the sample sd over scenes"
        if over_scenes
        else f"mean ± sample sd over runs; {alone}"
    )
    return [
        mean,
        f"of {_views(runs)}, protocol {protocol.name}: PSNR {protocol.psnr}, in dB; SSIM {protocol.ssim}; masked: "
        f"{', '.join((*protocol.vehicle, *protocol.human))} (images without the mask skipped); definitions in each "
        "summary.json",
        *_lidar(runs),
        f"MB: 10^6 bytes of parameters; ms/frame: median, {runs[0].latency.protocol}",
    ]


def _absent(runs: Sequence[RunSummary], protocol: Protocol) -> list[str]:
    """Says why a metric of the protocol is absent, once for each reason."""
    reasons = {
        (quantity, reason)
        for run in runs
        for quantity, reason in run.absent.items()
        if any(metric.startswith(quantity) for metric in protocol.metrics)
    }
    return [f"{quantity} n/a in some runs: {reason}" for quantity, reason in sorted(reasons)]


def _views(runs: Sequence[RunSummary]) -> str:
    return "training views (none is held out)" if all(run.main_split == TRAINING for run in runs) else "held-out views"


def _lidar(runs: Sequence[RunSummary]) -> list[str]:
    """Says what near and beyond are if a run has either."""
    names = ("psnr_near_lidar", "psnr_beyond_lidar")
    if all(run.mean(name) is None for run in runs for name in names):
        return []
    return [
        f"near: psnr_near_lidar, of pixels with a lidar return within {100 * LIDAR_REACH:g} % of the longer image "
        "side; beyond: psnr_beyond_lidar, of the others; sky left out"
    ]


def _timing(runs: Sequence[RunSummary]) -> list[str]:
    """Say where and with what ms/frame was measured."""
    places = [(run.latency.device, run.latency.threads, run.evaluated.machine) for run in runs]
    said = _places("ms/frame", "measured", places)
    if len({run.latency.protocol for run in runs}) > 1:
        said.append("ms/frame were taken with different numbers of renders; see each summary.json")
    return said + _commits("measured", [run.evaluated.source for run in runs])


def _training(runs: Sequence[RunSummary]) -> list[str]:
    """Say where train s was measured."""
    places = [(run.run.device, run.run.threads, run.run.machine) for run in runs]
    return _places("train s", "trained", places) + _commits("trained", [run.run.source for run in runs])


def _places(times: str, done: str, clocks: Sequence[tuple[str, int, Machine]]) -> list[str]:
    """Say what times depend on besides the code: each device, number of threads and machine once."""
    places = {
        f"{device}, {threads} thread{'s' if threads != 1 else ''}, {host.cores} cores, torch {host.torch}"
        for device, threads, host in clocks
    }
    apart = f"{times} are not comparable, " if len(places) > 1 else ""
    return [f"{apart}{done} on: {'; '.join(sorted(places))}" if apart else f"{done} on {'; '.join(places)}"]


def _commits(done: str, sources: Sequence[CodeVersion]) -> list[str]:
    said = []
    commits = sorted({(source.commit or "no commit")[:9] for source in sources})
    if len(commits) > 1:
        said.append(f"runs were {done} by different commits: {', '.join(commits)}")
    if any(source.dirty for source in sources):
        said.append(f"some runs were {done} by code with uncommitted changes")
    return said


def _long_names(variants: Sequence[Repeats]) -> list[str]:
    return [
        f"{variant.name}: {', '.join(variant.options)}"
        for variant in variants
        if not all(option in variant.name for option in variant.options)
    ]


def _repeated_seeds(variants: Sequence[Repeats]) -> list[str]:
    """Names seeds that occur twice: such a run counts twice, but it is no independent repeat."""
    said = []
    for variant in variants:
        times = Counter(_scenes_and_seeds(variant))
        twice = [f"seed {seed} {count} times" for (_, seed), count in sorted(times.items()) if count > 1]
        if twice:
            said.append(f"{variant.name}: {', '.join(twice)}; equal runs of one seed are no independent repeats")
    return said


def _lacking_seeds(variants: Sequence[Repeats]) -> list[str]:
    """Name variants that lack seeds which others have of a scene: seeds can differ by more than methods do."""
    every = sorted({unit for variant in variants for unit in _scenes_and_seeds(variant)})
    said = []
    for variant in variants:
        own = set(_scenes_and_seeds(variant))
        lacking: dict[str, list[str]] = {}
        for scene, seed in every:
            if (scene, seed) not in own and scene in {scene for scene, _ in own}:
                lacking.setdefault(scene, []).append(str(seed))
        words = ", ".join(f"{scene} with seed {', '.join(seeds)}" for scene, seeds in lacking.items())
        said += [f"{variant.name} has no run of {words}: compare differences, not means"] if words else []
    return said


def _scenes_and_seeds(variant: Repeats) -> list[tuple[str, int]]:
    return [(run.run.scene, run.run.seed) for run in variant.runs]


def _unfinished(variants: Sequence[Repeats]) -> list[str]:
    return [
        f"{_run(variant, run)} stopped at step {run.run.steps:,} of {run.run.max_steps:,}"
        for variant in variants
        for run in variant.runs
        if run.run.steps < run.run.max_steps
    ]


def _scenes(variants: Sequence[Repeats]) -> list[str]:
    """Names the scenes of a mean, and the variants whose mean is over fewer."""
    every = sorted({run.run.scene for variant in variants for run in variant.runs})
    said = [f"scenes: {', '.join(every)}"]
    for variant in variants:
        lacking = [scene for scene in every if scene not in {run.run.scene for run in variant.runs}]
        if lacking:
            said.append(f"{variant.name} has no run of {', '.join(lacking)}: compare differences, not means")
    return said


def _caps(variants: Sequence[Repeats]) -> list[str]:
    """Name counts that a cap limited: they say little about what a scene needs, and their shares even less."""
    found = {
        variant.name: sorted({item for run in variant.runs for item in run.run.caps.items()}) for variant in variants
    }
    return [
        f"{CAPPED} {name}: " + ", ".join(f"{node} reached its cap of {cap:,} Gaussians" for node, cap in caps)
        for name, caps in found.items()
        if caps
    ]


def _guards(variants: Sequence[Repeats]) -> str:
    """Returns the alarms of every run that has any."""
    fired = [
        f"{_run(variant, run)} " + ", ".join(f"{name} {count:,}" for name, count in run.guards.alarms.items())
        for variant in variants
        for run in variant.runs
        if run.guards.alarms
    ]
    return "guards: " + ("; ".join(fired) or "none fired")


def _run(variant: Repeats, run: RunSummary) -> str:
    return f"{variant.name} (seed {run.run.seed})"
