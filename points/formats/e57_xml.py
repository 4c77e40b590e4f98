"""XML of which some numbers are changed, and every other byte stays as it is."""

from __future__ import annotations

import re
from xml.etree import ElementTree
from xml.parsers import expat

from straightpcf.points.errors import UnsupportedCloud

__all__ = ["XmlEdits"]

_TAG = re.compile(rb"""<([^\s/>]+)(?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*(/?)>""")


class XmlEdits:
    """Collect what is to change in a document, and make it."""

    def __init__(self, xml: bytes, root: ElementTree.Element) -> None:
        """xml: what `root` was parsed from, in UTF-8 or another encoding that has ASCII as it is."""
        self._xml = xml
        begins: list[int] = []
        parser = expat.ParserCreate()
        parser.StartElementHandler = lambda _name, _attributes: begins.append(parser.CurrentByteIndex)
        parser.Parse(xml, True)
        self._begins = dict(zip(root.iter(), begins, strict=True))  # both in the document's order
        self._attributes: dict[ElementTree.Element, dict[str, str]] = {}
        self._texts: dict[ElementTree.Element, str] = {}

    def set_attribute(self, element: ElementTree.Element, name: str, value: str) -> None:
        """Change an attribute that the element has."""
        self._attributes.setdefault(element, {})[name] = value

    def set_text(self, element: ElementTree.Element, value: str) -> None:
        """Change the text of an element that has no others in it."""
        self._texts[element] = value

    def applied(self) -> bytes:
        """Return the changed document; raises UnsupportedCloud where it is not written as every program's is."""
        parts, at = [], 0
        for element in sorted({*self._attributes, *self._texts}, key=self._begins.__getitem__):
            begin = self._begins[element]
            found = _TAG.match(self._xml, begin)
            if found is None:
                raise UnsupportedCloud("the XML of the E57 file is in no encoding like UTF-8: take another format")
            tag, end = found.group(), found.end()
            for name, value in self._attributes.get(element, {}).items():
                tag = re.sub(rb"(\s%b\s*=\s*)(\"[^\"]*\"|'[^']*')" % name.encode(), rb'\1"%b"' % value.encode(), tag)
            if (text := self._texts.get(element)) is not None:
                called, is_empty = found.groups()
                opened = tag[: -len(b"/>")].rstrip() + b">" if is_empty else tag
                tag = opened + text.encode() + b"</%b>" % called
                end = end if is_empty else self._xml.index(b">", self._xml.index(b"</", end)) + 1
            parts += [self._xml[at:begin], tag]
            at = end
        return b"".join([*parts, self._xml[at:]])
