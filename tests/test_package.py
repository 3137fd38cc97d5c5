"""What ``import sparsestreet`` gives, and what it does not cost."""

import subprocess
import sys

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


@pytest.mark.parametrize("command", ["render", "export", "presets"])
def test_the_help_of_a_command_is_light(command):
    code = f"import sys; from sparsestreet.cli.{command} import {command} as run; run(['--help']); "
    code += "sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
