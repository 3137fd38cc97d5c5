"""Reads YAML that others wrote, in memory and time that the file's size bounds."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import yaml

from sparsestreet.atomic import check_regular

Value = TypeVar("Value")

LARGEST = 2_000_000
"""Bytes of a file: PyYAML takes ten seconds for as many."""


def read_yaml(path: Path, parse: Callable[[str], Value]) -> Value:
    """What a parser of PyYAML's makes of a file.

    An alias stands for a part of the file as often as it is named: ten lines of them make a value of 10^10 entries,
    once somebody copies or prints it. So none may be in the file.

    Raises FileNotFoundError, or ValueError, naming the file, for what is no YAML, holds aliases or is too large.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "edits.yaml")
    ...     _ = path.write_text("remove: [car_3]")
    ...     read_yaml(path, yaml.safe_load)
    {'remove': ['car_3']}
    """
    check_regular(path)
    if (size := path.stat().st_size) > LARGEST:
        raise ValueError(f"{path} has {size:,} bytes, more than the {LARGEST:,} that are read: shorten it")
    try:
        text = path.read_text(encoding="utf-8")
        aliases = "*" in text and any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text, yaml.SafeLoader))
        if not aliases:
            return parse(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no YAML: it is no text ({error})") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    except ValueError as error:  # a number of more digits than Python reads
        raise ValueError(f"{path} is no YAML that can be read: {error}") from error
    except RecursionError as error:
        raise ValueError(f"{path} is no YAML that can be read: brackets in brackets without end") from error
    raise ValueError(f"{path} holds aliases (*name), which are not read: write out what they stand for")
