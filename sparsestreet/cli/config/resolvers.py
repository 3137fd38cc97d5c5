"""What conf/ may ask for in ``${name:...}``."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from sparsestreet.records.summary import SUMMARY

PER_IMAGE = 56.0
"""Steps for each training image of a recorded drive (docs/length.md)."""
UNCOUNTED = "that run has no record"
"""What is said of a control whose run is not there yet."""
_LONGEST = 40
"""Letters of a value in a folder's name."""
IMAGES_PER_CAPACITY = 54.0
"""Training images of a recorded drive that the numbers of ``capacity=small`` are made for (docs/length.md)."""

PRESSED_STEPS = 2000
"""Steps that the weight of masks in ``schedule=short`` is made for (docs/length.md)."""


def concat(*lists: Iterable[Any]) -> ListConfig:
    """Of conf/options/assignment.yaml: all lists as one."""
    return ListConfig([entry for entries in lists for entry in entries])  # ``--resolve`` takes no list of Python's


def beside(folder: str, name: str) -> str:
    """Of conf/image_points: a folder next to another one, so that runs in one place share it."""
    return str(Path(folder).parent / name)


def mul(factor: float, rate: float) -> float:
    """Of conf/node: a rate of the schedule times a number."""
    return float(factor) * float(rate)


def steps_of_log(least: int, *, _root_: DictConfig) -> int:
    """Of conf/schedule: steps of a run, in whole hundreds, ``data.steps_per_image`` for each training image (without
    such a key ``PER_IMAGE``); before the log is read, the least."""
    images = _root_.training_views.images
    per_image = float(_root_.data.get("steps_per_image", PER_IMAGE))
    return least if images is None else max(least, 100 * round(per_image * images / 100))


def epoch_of_log(least: int, *, _root_: DictConfig) -> int:
    """Of conf/schedule: the steps of an epoch in whole hundreds, and so many at least; before the log is read, the
    least."""
    images = _root_.training_views.images
    return least if images is None else max(least, 100 * round(images / 100))


def _relative_images(root: DictConfig) -> float:
    """The training images, relative to ``data.images_per_capacity`` (without such a key ``IMAGES_PER_CAPACITY``), and 1
    at least; before the log is read, 1."""
    enough = float(root.data.get("images_per_capacity", IMAGES_PER_CAPACITY))
    return 1.0 if root.training_views.images is None else max(1.0, root.training_views.images / enough)


def relative_length(*, _root_: DictConfig) -> float:
    """Of conf/schedule: how many times as many training images the log has as ``data.images_per_capacity``, less in a
    run of fewer steps than ``steps_of_log`` gives it, and 1 at least. With a budget, where the clock decides the steps,
    1."""
    steps, own = _root_.schedule.max_steps, steps_of_log(1, _root_=_root_)
    if _root_.budget.minutes is not None or not isinstance(steps, int):  # others are refused (cli/config/validate.py)
        return 1.0
    return max(1.0, _relative_images(_root_) * min(1.0, steps / own))


def gaussians_of_log(least: int, *, _root_: DictConfig) -> int:
    """Return a number of Gaussians, in whole hundreds, that grows with the training images where these are more than
    ``data.images_per_capacity`` (without such a key ``IMAGES_PER_CAPACITY``). Before the log is read: the least.
    """
    return max(least, 100 * round(least * _relative_images(_root_) / 100))


def of_pressure(weight: float, *, _root_: DictConfig) -> float:
    """Of conf/schedule: a weight that presses in every step, such that a run of more than ``PRESSED_STEPS`` has as much
    of it in all as one of so many (docs/length.md)."""
    steps = _root_.schedule.max_steps
    whole = isinstance(steps, int) and steps > 0  # others are refused (cli/config/validate.py)
    return float(weight) * (min(1.0, PRESSED_STEPS / steps) if whole else 1.0)


def of_30000(step: int) -> float:
    """Of conf/preset: a step of DriveStudio's 30,000 as a fraction of the run."""
    return step / 30_000


def at_scale(label: str, *, _root_: DictConfig) -> str:
    """Of conf/preset: a label, which says so where a run is not as long and large as DriveStudio's."""
    whole = _root_.capacity.name == "paper" and _root_.schedule.max_steps == 30_000
    return label if whole else f"{label}_scaled"


def of_preset(setting: str, *, _root_: DictConfig) -> Any:
    """Of render.settings: what ``render.preset`` says. Raises ValueError naming the presets there are."""
    from sparsestreet.ops import SplatSettings  # torch, which a report needs not

    return getattr(SplatSettings.preset(_root_.render.preset), setting)


def own_preset(*, _root_: DictConfig) -> bool:
    """Return, for render.settings, whether ``render.preset`` is none of another renderer's."""
    from sparsestreet.ops.settings import OWN_PRESETS  # torch, which a report needs not

    return _root_.render.preset in OWN_PRESETS


def gaussians_of(run: str | None, otherwise: Any, node: str | None = None) -> Any:
    """Of the controls: how many Gaussians a run ended with, by node or of one; without a run, what else is given.

    Raises FileNotFoundError where the run has no record.
    """
    if run is None:
        return otherwise
    if not SUMMARY.exists(Path(run)):
        raise FileNotFoundError(f"count_of={run}: {UNCOUNTED}, and a control has its count from it; make it first")
    gaussians = SUMMARY.read(Path(run)).gaussians
    return DictConfig(gaussians) if node is None else gaussians[node]


_NO_OTHER = object()
_SAY_FRAMES = "say data.log.first_frame=N data.log.last_frame=N (0 and -1: all frames)"


def by_drive(part: int, *, _root_: DictConfig) -> Any:
    """Return, for conf/sweep, a part of the entry of ``data.drives`` whose drive is read: 1 first frame, 2 last one.

    A drive is known by what the log says it is. Raises ValueError for one without an entry: it would be read whole,
    unsaid.
    """
    drives, found = _root_.data.drives, _said_drive(_root_.data)
    for number, (name, *_) in drives.items():
        if found.replace("_", "") in (number, name.replace("_", "")):
            return drives[number][part]
    raise ValueError(
        f"this table has windows of frames for drives {', '.join(drives)}, and none is {found!r}: {_SAY_FRAMES}"
    )


def _said_drive(data: DictConfig) -> str:
    """DriveStudio's folder says its number, a segment of Waymo its name, others the scene that is named."""
    log, said = data.log, _scene(data.log)
    reader = log._target_.rpartition(".")[2]
    if reader == "WaymoReader":
        from sparsestreet.data.waymo import segment_name  # torch, which a report needs not

        return segment_name(Path(data.root), said, log.scenes)
    if reader == "DriveStudioReader":
        name = Path(data.root).name
        return str(int(name)) if name.isdigit() else name
    return f"{Path(data.root).name}/{'' if said is None else said}"  # neither a number nor a segment's name


def by_scene(values: Mapping[Any, Any], otherwise: Any = _NO_OTHER, *, _root_: DictConfig) -> Any:
    """Of conf/protocol: the entry of the scene, drive or sequence that is read. Names are compared without underscores,
    because Hydra reads digits with underscores as a number.

    Raises ValueError for a scene without an entry, and where none is named, if there is nothing else.
    """
    log = _root_.data.log
    said = _scene(log)
    named = {str(name).replace("_", ""): value for name, value in values.items()}
    found = otherwise if said is None else named.get(str(said).replace("_", ""), otherwise)
    if found is _NO_OTHER:
        what = "none is named (data.log.scene or data.log.drive)" if said is None else f"{said} is none of them"
        raise ValueError(
            f"this protocol has windows of frames for {len(values)} scenes, and {what}: name one of conf/protocol, or "
            f"{_SAY_FRAMES}"
        )
    return found


def _scene(log: DictConfig) -> Any:
    """The scene, drive or sequence that is named; None: none is."""
    return next((log[key] for key in ("scene", "drive", "sequence") if log.get(key) is not None), None)


def of_reader(values: Mapping[str, Any], otherwise: Any, *, _root_: DictConfig) -> Any:
    """Return, for conf/sweep and conf/preset, the value of the log's reader, by the name of its class."""
    found = values.get(_root_.data.log._target_.rpartition(".")[2], otherwise)
    return ListConfig(found) if isinstance(found, list) else found  # ``--resolve`` takes no list of Python's


def dashed(values: Iterable[Any]) -> str:
    """Of conf/experiment: a list in a name."""
    return "-".join(map(str, values))


def drive(*, _root_: DictConfig) -> str:
    """Return, for conf/sweep, the drive in the name of a run's folder: its log's folder, and a named scene."""
    said = _scene(_root_.data.log)
    return Path(_root_.data.root).name + ("" if said is None else f"_{said}")


def last_part(path: str) -> str:
    """Return the name of a folder, for configurations of runs that were written before ``drive``."""
    return Path(path).name


_TOLD = ("seed", "method", "sparsify", "assignment", "preset", "name", "out", "folder", "data", "sweep")
"""Keys that are in a job's folder already, or tell its drive."""


def swept(overrides: Iterable[str], fixed: Iterable[str]) -> str:
    """Of conf/train.yaml: the options of a job that a sweep varies, for the name of its folder.

    >>> swept(["seed=1", "pruning@callback.pruning.rule=opacity", "a.keep=[0.5]", "a.b=3"], ["a.b"])
    '_pruning=opacity_keep=0.5'
    """
    words = ""
    for text in overrides:
        key, _, value = text.lstrip("+~").partition("=")
        group = key.partition("@")[0]
        if key in fixed or group in _TOLD or key.startswith(("data.", "hydra")):
            continue
        name = group.rpartition("/")[2].rpartition(".")[2]
        plain = re.sub(r"[^\w.+-]+", "-", value).strip("-")
        words += f"_{name}={plain[:_LONGEST]}"
    return words


_RESOLVERS = {
    "swept": swept,
    "concat": concat,
    "beside": beside,
    "mul": mul,
    "steps_of_log": steps_of_log,
    "epoch_of_log": epoch_of_log,
    "relative_length": relative_length,
    "gaussians_of_log": gaussians_of_log,
    "min": min,
    "of_30000": of_30000,
    "of_pressure": of_pressure,
    "at_scale": at_scale,
    "of_preset": of_preset,
    "own_preset": own_preset,
    "gaussians_of": gaussians_of,
    "by_drive": by_drive,
    "by_scene": by_scene,
    "dashed": dashed,
    "drive": drive,
    "last_part": last_part,
    "of_reader": of_reader,
}


def register_resolvers() -> None:
    """Tell OmegaConf of them."""
    for name, resolver in _RESOLVERS.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
