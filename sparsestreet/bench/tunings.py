"""Choices of the Triton kernels in words, so that one run compares several of them."""

from dataclasses import fields
from typing import get_type_hints

from sparsestreet.ops.triton.tuning import Tuning

WORDS = {"true": 1, "false": 0}


def tuning_of(words: str) -> Tuning:
    """From name=value, several with commas between them; what is not named is as by default.

    Raises ValueError for an unknown name, or a value that is none of its kind.

    >>> tuning_of("most_parts=1,two_launches=false").most_parts
    1
    """
    kinds, chosen = get_type_hints(Tuning), {}
    for word in words.split(","):
        name, _, value = word.partition("=")
        if name not in kinds:
            known = ", ".join(field.name for field in fields(Tuning))
            raise ValueError(f"no choice {name!r} of the kernels: name one of {known}")
        try:
            chosen[name] = kinds[name](WORDS[value] if kinds[name] is bool else int(value))
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"{name} is {'true or false' if kinds[name] is bool else 'a number'}, got {value!r}"
            ) from error
    return Tuning(**chosen)
