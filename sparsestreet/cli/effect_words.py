"""``effects=off`` and ``effects.exposure=on``: short for the key ``when`` of all effects, or of one."""

from collections.abc import Sequence

from omegaconf import OmegaConf

from sparsestreet.cli.compose import CONF

_WORDS = ("auto", "on", "off")


def with_effect_keys(arguments: Sequence[str]) -> list[str]:
    """The arguments with ``effects.X=on`` as ``effects.X.when=on``, and ``effects=auto|off`` for all default effects.

    Lists of a sweep stay lists (``effects.exposure=on,off``). What is no such word stays as it is.
    """
    return [written for text in arguments for written in _written(text)]


def _written(text: str) -> list[str]:
    key, equals, value = text.partition("=")
    if not equals or not set(value.split(",")) <= set(_WORDS):
        return [text]
    if key == "effects" and value in ("auto", "off"):
        return [f"effects.{name}.when={value}" for name in _default_effects()]
    if key.startswith("effects.") and key.count(".") == 1:
        return [f"{key}.when={value}"]
    return [text]


def _default_effects() -> list[str]:
    """Names in the list of conf/train.yaml."""
    defaults = OmegaConf.load(CONF / "train.yaml").defaults
    return next(list(entry.effects) for entry in defaults if "effects" in entry)
