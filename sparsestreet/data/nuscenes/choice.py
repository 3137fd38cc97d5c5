"""Which folder of tables, and which scene in it."""

from pathlib import Path

from sparsestreet.data.nuscenes.tables import REMEDY, Row, all_rows
from sparsestreet.data.problems import fault
from sparsestreet.data.window import listed

_DIGITS = 4
"""Of the number in a scene's name."""


def find_tables(root: Path, version: str | None) -> Path:
    """The folder of tables below ``root``. Raises LogError without one, and ValueError where one must be named."""
    found = sorted(path.parent for path in root.glob("*/sample_data.json"))
    names = listed([path.name for path in found])
    if version is not None:
        if not (root / version / "sample_data.json").is_file():
            there = f"there are tables of {names}"
            raise ValueError(f"data.log.version={version}: {root / version} holds no sample_data.json; {there}")
        return root / version
    if not found:
        if (root / "sample_data.json").is_file():
            raise fault(
                root, "this is the folder of the tables", f"name the one above, that holds samples/: {root.parent}"
            )
        here = "the folder holds no */sample_data.json" if root.is_dir() else "no such folder"
        raise fault(root, here, "name the folder that holds v1.0-mini, v1.0-trainval or v1.0-test beside samples/")
    if len(found) > 1:
        raise ValueError(f"{root} holds the tables of {names}: say which, as data.log.version={found[0].name}")
    return found[0]


def find_scene(tables: Path, scene: str | int | None) -> tuple[Row, str]:
    """A scene by its name or by its place in scene.json, from 0, or the only one; its row, and which it is in words.

    Raises LogError for a broken table, ValueError for a scene that is not there.
    """
    rows = all_rows(tables / "scene.json")
    if not rows:
        raise fault(tables / "scene.json", "the table has no scenes", REMEDY)
    names = [row.text("name") for row in rows]
    place = _place(tables, names, scene)
    said = f"{names[place]} is read, at place {place} of {tables.name}/scene.json"
    if isinstance(scene, int):
        said += f", as data.log.scene={scene} asks (DriveStudio counts so){_other(scene, names)}"
    return rows[place], said


def _place(tables: Path, names: list[str], scene: str | int | None) -> int:
    if scene is None:
        if len(names) == 1:
            return 0
        raise ValueError(
            f"{tables} holds {len(names)} scenes: name one, as data.log.scene={names[0]}; there are {listed(names)}"
        )
    if isinstance(scene, int):
        if 0 <= scene < len(names):
            return scene
        reach = f"a number is a place within 0 to {len(names) - 1} of scene.json"
        raise ValueError(f"data.log.scene={scene}: {reach}{_other(scene, names)}; there are {listed(names)}")
    if scene in names:
        return names.index(scene)
    other = _other(int(scene), names) if scene.isascii() and scene.isdigit() and len(scene) <= _DIGITS else ""
    raise ValueError(f"data.log.scene={scene}: no scene of {tables} has this name{other}; there are {listed(names)}")


def _other(number: int, names: list[str]) -> str:
    """What the number would be in a name."""
    name = f"scene-{number:0{_DIGITS}d}"
    return f"; for the scene whose name has this number say data.log.scene={name}" if name in names else ""
