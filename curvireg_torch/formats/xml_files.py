"""XML of unknown origin: no document types, and so no entities."""

import re
from typing import Any

_DOCTYPE = re.compile(rb"<!\s*(?:DOCTYPE|ENTITY)", re.IGNORECASE)


def check_xml(data: bytes) -> None:
    """Refuse a document type, which may define entities; in UTF-16 too."""
    if _DOCTYPE.search(data) or (b"\0" in data[:100] and _DOCTYPE.search(data.replace(b"\0", b""))):
        raise ValueError("an XML document type, which is not read; remove it")


def local_name(element: Any) -> str:
    """The name of an element without its namespace; "" of comments."""
    tag = element.tag
    return tag.rpartition("}")[2] if isinstance(tag, str) else ""
