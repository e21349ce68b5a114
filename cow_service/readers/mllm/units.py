"""Says in a prompt how coordinates are to be written."""

from __future__ import annotations

from cow_service.readers.mllm.coordinates import View


def units_of(view: View) -> str:
    """What the numbers count."""
    width, height = view.seen
    return {
        "thousandths": "integers from 0 to 1000, thousandths of the image's width and height",
        "fractions": "fractions from 0 to 1 of the image's width and height, with three decimals",
        "pixels": f"pixels of the image, which is {width} wide and {height} high, from its top left corner",
    }[view.coordinates.units]


def box_order(view: View) -> str:
    """The order of a box's numbers."""
    return "[x0, y0, x1, y1]" if view.coordinates.axes == "xy" else "[ymin, xmin, ymax, xmax]"


def line_order(view: View) -> str:
    """The order of the numbers of a line from one point to another."""
    return "[x0, y0, x1, y1]" if view.coordinates.axes == "xy" else "[y0, x0, y1, x1]"
