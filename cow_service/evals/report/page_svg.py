"""A plot as a part of a page: without what a strict policy forbids, and in the page's own light and dark colours."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
# The four colours of plot_looks.py that are not an arm's own.
THEMED = {"#17211f": "var(--ink)", "#566360": "var(--dim)", "#d5dbd8": "var(--line)", "#fefefe": "var(--panel)"}
PIXELS_PER_POINT = 1.2


def inline_svg(path: Path, name: str) -> str:
    """The file's drawing for an HTML page. `name` is what a screen reader calls it."""
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == f"{SVG}style" or not child.tag.startswith(SVG) or child.tag == f"{SVG}metadata":
                parent.remove(child)
    kept = {each.attrib[LINK][1:] for each in root.iter() if LINK in each.attrib}
    kept |= {each.attrib["id"] for each in root.iter(f"{SVG}clipPath")}
    for each in root.iter():
        _plain(each, kept)
    for side in ("width", "height"):
        root.attrib[side] = f"{float(root.attrib[side].removesuffix('pt')) * PIXELS_PER_POINT:.0f}"
    # What matplotlib says in a style element, which the policy of the page does not let in.
    root.attrib |= {"stroke-linejoin": "round", "role": "img", "aria-label": name}
    return ElementTree.tostring(root, encoding="unicode")


def _plain(element: ElementTree.Element, kept: set[str]) -> None:
    """Declarations of the style attribute as attributes of their own; ids that nothing refers to go."""
    element.tag = element.tag.removeprefix(SVG)
    if element.attrib.get("id") not in kept:
        element.attrib.pop("id", None)
    if LINK in element.attrib:
        element.attrib["href"] = element.attrib.pop(LINK)
    for declaration in element.attrib.pop("style", "").split(";"):
        key, _, value = declaration.partition(":")
        if value:
            element.attrib[key.strip()] = THEMED.get(value.strip(), value.strip())
