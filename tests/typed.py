"""Values of the type that a test knows them to have."""

from typing import TypeVar

T = TypeVar("T")


def there(value: T | None) -> T:
    """What must not be None, such as a gradient behind a backward pass."""
    assert value is not None
    return value


def as_a(kind: type[T], value: object) -> T:
    """What must be of a class, such as a node of a scene."""
    assert isinstance(value, kind)
    return value
