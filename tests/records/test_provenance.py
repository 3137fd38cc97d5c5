"""What a record says of code and machine."""

import subprocess

from sparsestreet.records.provenance import this_machine, this_source


def git(folder, *arguments):
    identity = ("-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false")
    answer = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return answer.stdout.strip()


def test_source_is_the_checkout_that_tracks_the_package(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "somebody else's repository")
    assert (this_source(package).commit, this_source(package).dirty) == (None, None)  # not tracked
    git(tmp_path, "add", "package")
    git(tmp_path, "commit", "-q", "-m", "first")
    commit = git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "notes").write_text("untracked files change nothing")
    assert (this_source(package).commit, this_source(package).dirty) == (commit, False)
    (package / "__init__.py").write_text("x = 1\n")
    assert (this_source(package).commit, this_source(package).dirty) == (commit, True)


def test_machine_is_described():
    machine = this_machine()
    assert machine.processor
    assert machine.cores >= 1
    assert machine.torch.startswith("2.")
