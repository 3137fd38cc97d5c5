"""XML from outside: read piece by piece, without entities."""

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import fault

_MAX_DEPTH = 64


def elements(path: Path, depth: int, *, max_bytes: int, remedy: str) -> Iterator[Element]:
    """Yield the elements at a depth, the root's being 0; each is emptied once the next is asked for.

    A document may name its type, as boost's archives do. It may not declare entities or refer to other files.

    Args:
        path: of the document.
        depth: of the elements.
        max_bytes: size of a file above which it is refused.
        remedy: what to do about a document that cannot be read.

    Raises LogError for a file that is missing, too large, or no such document.
    """
    try:
        check_regular(path)
        if (size := path.stat().st_size) > max_bytes:
            raise fault(path, f"the file has {size} bytes, more than the {max_bytes} that are read", remedy)
        level = -1
        for event, element in iterparse(str(path), ("start", "end"), forbid_dtd=False):
            level += 1 if event == "start" else 0
            if level > _MAX_DEPTH:
                raise fault(path, f"elements lie more than {_MAX_DEPTH} deep", remedy)
            if event == "end":
                if level == depth:
                    yield element
                if level <= depth:
                    element.clear()
                level -= 1
    except OSError as error:
        raise fault(path, f"the file cannot be read ({error})", remedy) from error
    except (DefusedXmlException, ParseError, LookupError) as error:
        raise fault(path, f"the file is no XML that can be read ({error})", remedy) from error
