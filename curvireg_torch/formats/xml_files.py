"""XML of unknown origin: no document types, and so no entities; a bounded number of elements."""

import re
from typing import Any
from xml.etree import ElementTree

from ..errors import MAX_XML_ELEMENTS

_DOCTYPE = re.compile(rb"<!\s*(?:DOCTYPE|ENTITY)", re.IGNORECASE)


def read_xml(data: bytes) -> ElementTree.Element:
    """The root of a document of a bounded number of elements; ValueError for one that is damaged,
    too."""
    check_xml(data)
    if data.count(b"<") > 2 * MAX_XML_ELEMENTS:  # of most elements the start and the end
        raise ValueError(f"more than {MAX_XML_ELEMENTS:,} elements of XML; export parts of it")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:  # the second of an unknown encoding
        raise ValueError(f"damaged XML ({error})") from error


def check_xml(data: bytes) -> None:
    """Refuse a document type, which may define entities; in UTF-16 too."""
    if _DOCTYPE.search(data) or (b"\0" in data[:100] and _DOCTYPE.search(data.replace(b"\0", b""))):
        raise ValueError("an XML document type, which is not read; remove it")


def local_name(element: Any) -> str:
    """The name of an element without its namespace; "" of comments."""
    tag = element.tag
    return tag.rpartition("}")[2] if isinstance(tag, str) else ""
