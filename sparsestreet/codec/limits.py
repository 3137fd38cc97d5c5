"""How much memory a file may ask for: in proportion to its size, so that a few bytes never claim a whole machine."""

FREE = 2**28
"""Bytes that any file may unpack to: 256 MiB."""
PER_BYTE = 256
"""Bytes more for each byte of the file. A street needs about 15; rows that are all the same need far more."""


class Budget:
    """Counts what a file unpacks to.

    >>> Budget(10).take(100)
    >>> Budget(10).take(10**15)
    Traceback (most recent call last):
    ...
    ValueError: the file has 10 bytes and claims 1000000000000000 unpacked, above its limit of 268438016: it is damaged
    """

    def __init__(self, file_size: int) -> None:
        self._file_size, self._taken = file_size, 0

    @property
    def limit(self) -> int:
        """Bytes, all in all."""
        return FREE + PER_BYTE * self._file_size

    def take(self, count: int) -> None:
        """Asks for so many bytes more, before they are allocated. Raises ValueError beyond the limit."""
        self._taken += count
        if count < 0 or self._taken > self.limit:
            raise ValueError(
                f"the file has {self._file_size} bytes and claims {self._taken} unpacked, above its limit of "
                f"{self.limit}: it is damaged"
            )
