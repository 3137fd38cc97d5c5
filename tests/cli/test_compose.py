"""What the command line makes of overrides before Hydra sees them."""

import pytest

from sparsestreet.cli.compose import override_problem


@pytest.mark.parametrize("flags", [["--cfg", "job"], ["-c", "hydra"], ["--info", "defaults"], ["-m"]])
def test_flags_of_hydra_and_their_words_pass(flags):
    assert override_problem([*flags, "seed=1"]) is None


def test_a_word_that_is_no_override_is_named():
    assert override_problem(["foo"]) == "'foo' is no override: write key=value"


def test_an_unknown_key_names_the_nearest_one():
    assert "did you mean 'trainer.fast_dev_run'" in override_problem(["trainer.fast_dev_runx=true"])
