"""A place in bytes that moves on as they are read."""

import struct


class Cursor:
    """Reads bytes in order.

    >>> cursor = Cursor(b"abc")
    >>> cursor.take(2), cursor.left
    (b'ab', 1)
    >>> cursor.take(2)
    Traceback (most recent call last):
    ...
    ValueError: 2 bytes should follow, 1 are left: it is damaged
    """

    def __init__(self, content: bytes) -> None:
        self._content, self._place = content, 0

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def take(self, count: int) -> bytes:
        """Returns the next bytes. Raises ValueError where there are fewer."""
        if count > self.left:
            raise ValueError(f"{count} bytes should follow, {self.left} are left: it is damaged")
        self._place += count
        return self._content[self._place - count : self._place]

    def numbers(self, form: str) -> tuple:
        """Returns the next numbers, in a form of the module ``struct``."""
        return struct.unpack(form, self.take(struct.calcsize(form)))

    def finish(self) -> None:
        """Raises ValueError where bytes are left over."""
        if self.left:
            raise ValueError(f"{self.left} bytes are left over: it is damaged")
