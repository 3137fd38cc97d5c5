"""XML from strangers: read piece by piece, with nothing in it that could grow."""

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, fault

_CHUNK = 1 << 16
_DEEPEST = 64
"""Levels of elements inside of each other."""
_MOST = 500_000
"""Elements below one piece: about 60 MB."""


def elements(path: Path, depth: int, *, largest: int, remedy: str) -> Iterator[Element]:
    """The elements at a depth, the root's being 0, one after the other; what lies above them is passed over.

    A document may name its type, as boost's archives do. It may not declare anything: entities that expand to
    gigabytes, and files that are fetched, need a declaration.

    Args:
        path: of the document.
        depth: of the elements.
        largest: bytes of a file that is not refused.
        remedy: what to do about a document that cannot be read.

    Raises LogError for a file that is missing, too large, or no such document.
    """
    try:
        check_regular(path)
        size = path.stat().st_size
        if size > largest:
            raise fault(path, f"the file has {size} bytes, more than the {largest} that are read", remedy)
        pieces = _Pieces(path, depth, remedy)
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                yield from pieces.of(chunk)
        yield from pieces.of(b"", last=True)
    except OSError as error:
        raise fault(path, f"the file cannot be read ({error})", remedy) from error


class _Pieces:
    """What expat says, cut into elements."""

    def __init__(self, path: Path, depth: int, remedy: str) -> None:
        self._path, self._depth, self._remedy = path, depth, remedy
        self._level, self._count = -1, 0
        self._builder: TreeBuilder | None = None
        self._found: list[Element] = []
        parser = self._parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._document_type
        parser.EntityDeclHandler = self._declaration

    def of(self, chunk: bytes, *, last: bool = False) -> list[Element]:
        """The elements that end in this chunk of the file."""
        self._found = []
        try:
            self._parser.Parse(chunk, last)
        except (expat.ExpatError, LookupError, ValueError) as error:
            if isinstance(error, LogError):
                raise
            raise fault(self._path, f"the file is no XML ({error})", self._remedy) from error
        return self._found

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._level += 1
        if self._level > _DEEPEST:
            raise self._refused(f"elements lie more than {_DEEPEST} deep")
        if self._level == self._depth:
            self._builder, self._count = TreeBuilder(), 0
        if self._builder is not None:
            self._count += 1
            if self._count > _MOST:
                raise self._refused(f"an element holds more than {_MOST} others")
            self._builder.start(name, attributes)

    def _end(self, name: str) -> None:
        if self._builder is not None:
            self._builder.end(name)
            if self._level == self._depth:
                self._found.append(self._builder.close())
                self._builder = None
        self._level -= 1

    def _text(self, text: str) -> None:
        if self._builder is not None:
            self._builder.data(text)

    def _document_type(self, name: str, system: str | None, public: str | None, declares: int) -> None:
        if system or public or declares:
            raise self._refused("the document type refers to another file or declares entities")

    def _declaration(self, *_: object) -> None:
        raise self._refused("the document declares entities")

    def _refused(self, what: str) -> LogError:
        return fault(self._path, f"{what} (line {self._parser.CurrentLineNumber})", self._remedy)
