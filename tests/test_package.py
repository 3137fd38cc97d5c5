"""What ``import sparsestreet`` gives, and what it does not cost."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sparsestreet
from sparsestreet.scene.storage import load_scene


def test_a_scene_is_loaded_from_the_top():
    assert sparsestreet.load_scene is load_scene
    with pytest.raises(AttributeError, match="no attribute 'load_scenes'"):
        _ = sparsestreet.load_scenes


def test_the_import_is_light():
    """torch takes a second and more; ``--help`` and the version need none of it."""
    code = "import sys, sparsestreet, sparsestreet.cli; sparsestreet.__version__; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("command", ["render", "export", "serve", "presets"])
def test_the_help_of_a_command_is_light(command):
    code = f"import sys; from sparsestreet.cli.commands.{command} import {command} as run; run(['--help']); "
    code += "sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0


MUTABLE = {"BodyWriter", "LeaveOneOutSums", "StreetWriter", "TrainSchema", "Sizes", "_OpenFile"}


def test_values_are_frozen_and_options_are_named():
    """All dataclasses but a few are frozen; settings that inherit, and what they inherit from, take keywords only."""
    classes: dict[str, tuple[str, list[str]]] = {}
    for path in Path(sparsestreet.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            said = " ".join(map(ast.unparse, node.decorator_list)) if isinstance(node, ast.ClassDef) else ""
            if isinstance(node, ast.ClassDef) and "dataclass" in said:
                classes[node.name] = said, [ast.unparse(base) for base in node.bases]
    assert {name for name, (said, _) in classes.items() if "frozen=True" not in said} == MUTABLE
    named = {name for name, (said, _) in classes.items() if "kw_only=True" in said}
    settings = ("Settings", "Source", "Guesses")
    families = [(name, base) for name, (_, bases) in classes.items() for base in bases if base.endswith(settings)]
    assert len(families) > 10
    assert [pair for pair in families if len(named.intersection(pair)) == 1] == []


def test_modules_are_not_imported_from_the_folder_above_a_checkout():
    """Where another project's folder may be called as a package that is looked for, such as triton."""
    assert str(Path(__file__).parents[2]) not in sys.path
