"""Plain XML, read without what can make a short file long beyond memory."""

import re
from pathlib import Path
from xml.etree import ElementTree

from camera_models.errors import InputError

_NAMED_ELSEWHERE = re.compile(r'<!DOCTYPE\s+[\w-]+(\s+SYSTEM\s+"[^"<>]*")?\s*>')
"""A document type without a definition in the file itself; what it names elsewhere is not read."""


def read_xml(content: str, path: Path) -> ElementTree.Element:
    """The root of an XML text; raises InputError where it is none, or defines entities."""
    content = _NAMED_ELSEWHERE.sub("", content, count=1)
    if "<!" in content.replace("<!--", ""):
        # Entities can make a short file long beyond memory.
        raise InputError(f"{path} was expected to be plain XML, found a document type or a section of raw data; remove it.")
    try:
        # The declaration names the encoding of bytes, which a text has none of.
        return ElementTree.fromstring(content.encode())
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} is not valid XML ({error}); correct it or restore the file.") from None
