"""The README's Python is what a new user copies: it runs as it stands."""

import re
import subprocess
import sys
from pathlib import Path

from sparsestreet.cli import COMMANDS
from sparsestreet.cli.compose import override_problem

README = (Path(__file__).parents[2] / "README.md").read_text()


def test_the_lines_of_python_render_a_run(run_train, tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    run = run_train(tmp_path / "run", "schedule.max_steps=3")
    code = code.replace('"RUN"', repr(str(run)))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "[192, 320, 3]" in done.stdout
    assert "'background'" in done.stdout


def test_every_command_line_is_one_that_is_understood():
    lines = re.findall(r"^\.venv/bin/sparsestreet (.*?)(?:\s+#.*)?$", README, flags=re.M)
    assert len(lines) > 10
    for line in lines:
        command, *words = line.split()
        assert command in COMMANDS
        if command == "train" and "resume=RUN" not in words:
            assert override_problem(words) is None, line
