"""Trained scenes by the names that simulators ask for; as many as fit stay open, the others are read when asked for."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sparsestreet.records.run import RUN
from sparsestreet.scene.beside import rig_record, views_of
from sparsestreet.scene.effects.lens import Pinhole
from sparsestreet.scene.effects.shutter import GlobalShutter
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.storage import FILE_NAME as SCENE_FILE
from sparsestreet.scene.storage import SMALL_FILE_NAME, StoredScene, scene_path
from sparsestreet.scene.views import FILE_NAME as VIEWS_FILE
from sparsestreet.serving.rig import Rig, rig_of

Open = Callable[[Path], StoredScene]


class UnknownSceneError(ValueError):
    """A name that no scene has."""


@dataclass(frozen=True)
class ServedScene:
    """A scene that is open, and the vehicle that recorded its log."""

    name: str
    stored: StoredScene
    rig: Rig


@dataclass(frozen=True)
class RigOptions:
    """What a user says of the vehicle (``rig.rig_of``)."""

    mount: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None
    frame_rate: float | None = None


def open_run(run: Path, name: str, open_scene: Open, options: RigOptions) -> ServedScene:
    """The scene of a run's folder. Raises FileNotFoundError or ValueError for one that cannot be served.

    Its own lens or shutter that was left out in training is no longer left out: requests say which camera they mean.
    """
    stored = open_scene(run)
    effects = {key: one for key, one in stored.scene.effects.items() if not isinstance(one, Pinhole | GlobalShutter)}
    scene = SceneGraph(dict(stored.scene.nodes.items()), effects).eval()
    return ServedScene(name, replace(stored, scene=scene), run_rig(run, options))


def run_rig(run: Path, options: RigOptions) -> Rig:
    """The vehicle of a run, from what training left in its folder."""
    return rig_of(
        views_of(run),
        rig_record(run),
        mount=options.mount,
        names=options.names,
        frame_rate=options.frame_rate,
    )


def named_runs(runs: Sequence[Path]) -> dict[str, Path]:
    """Names for runs: that of the log, or of the folder where several runs are of one log.

    Raises FileNotFoundError for a folder without a scene, ValueError for two runs of one name.
    """
    logs = []
    for run in runs:
        if not run.is_file() and not ((run / SCENE_FILE).is_file() and (run / VIEWS_FILE).is_file()):
            _check_small(run)
        description = RUN.find(run)
        logs.append(_called(run) if description is None else description.scene)
    names = [log if logs.count(log) == 1 else _called(run) for log, run in zip(logs, runs, strict=True)]
    if len(set(names)) < len(names):
        raise ValueError(f"each scene needs a name of its own, got {', '.join(names)}: rename a folder")
    return dict(zip(names, runs, strict=True))


def _check_small(run: Path) -> None:
    if (run / SCENE_FILE).is_file() or not (run / SMALL_FILE_NAME).is_file():
        missing = run / (VIEWS_FILE if (run / SCENE_FILE).is_file() else SCENE_FILE)
        raise FileNotFoundError(f"there is no {missing}: give the folder of a finished run, or a .street")


def _called(run: Path) -> str:
    return run.stem if run.is_file() else run.resolve().name


class Scenes:
    """Opens scenes when they are asked for; those asked for longest ago are closed where memory ends."""

    def __init__(
        self, runs: dict[str, Path], open_scene: Open, *, memory: int, options: RigOptions | None = None
    ) -> None:
        """
        Args:
            runs: the folder of each scene.
            open_scene: reads a scene of a folder onto its device.
            memory: bytes of scene files that are open at the same time; one scene is open in any case.
            options: what is said of the vehicles.
        """
        self.runs, self.memory = runs, memory
        self._open_scene, self._options = open_scene, options or RigOptions()
        self._sizes = {name: scene_path(run).stat().st_size for name, run in runs.items()}
        self._opened: OrderedDict[str, ServedScene] = OrderedDict()
        self._rigs: dict[str, Rig] = {}
        self._reading, self._changing = threading.Lock(), threading.Lock()

    @property
    def names(self) -> list[str]:
        return list(self.runs)

    @property
    def opened(self) -> list[str]:
        """Names of the scenes in memory, the one asked for longest ago first."""
        with self._changing:
            return list(self._opened)

    def rig(self, name: str) -> Rig:
        """The vehicle of a scene, which need not be open. Raises UnknownSceneError."""
        name = self.known(name)
        if name not in self._rigs:
            self._rigs[name] = run_rig(self.runs[name], self._options)
        return self._rigs[name]

    def get(self, name: str) -> ServedScene:
        """The scene, opened if need be; safe from many threads. Raises UnknownSceneError, ValueError, OSError."""
        name = self.known(name)
        found = self._recent(name)
        if found is not None:
            return found
        with self._reading:
            found = self._recent(name)
            if found is None:
                self._make_room(self._sizes[name])
                found = open_run(self.runs[name], name, self._open_scene, self._options)
                with self._changing:
                    self._opened[name] = found
        return found

    def known(self, name: str) -> str:
        """The name itself; of "*" that of the only scene. Raises UnknownSceneError, ValueError for no name at all."""
        if not name:
            raise ValueError(f"scene_id is empty: name one of {self._said}")
        if name == "*" and len(self.runs) == 1:
            return next(iter(self.runs))
        if name not in self.runs:
            raise UnknownSceneError(f"there is no scene {name[:100]!r}: this server has {self._said}")
        return name

    @property
    def _said(self) -> str:
        return ", ".join(list(self.runs)[:10]) + (" and others" if len(self.runs) > 10 else "")

    def _recent(self, name: str) -> ServedScene | None:
        with self._changing:
            if name in self._opened:
                self._opened.move_to_end(name)
            return self._opened.get(name)

    def _make_room(self, size: int) -> None:
        with self._changing:
            while self._opened and size + sum(self._sizes[name] for name in self._opened) > self.memory:
                self._opened.popitem(last=False)
