"""Options that the commands `simulate` and `answer` share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

HINTS = {  # how the command line says what an error's remedy asks for
    "cannot-ground": "Here: --point X,Y or --box X0,Y0,X1,Y1 (and --object NAME).",
    "object-not-found": "Here: --point X,Y or --box X0,Y0,X1,Y1 (and --object NAME).",
    "cannot-read-direction": "Here: --direction DX,DY.",
}


class Policy(StrEnum):
    """Which frames to keep as pictures."""

    initial = "initial"
    uniform = "uniform"
    events = "events"


class Kind(StrEnum):
    """Kinds of motion."""

    linear = "linear"
    projectile = "projectile"
    fall = "fall"
    static = "static"


Image = Annotated[
    Path, typer.Argument(metavar="IMAGE", help="PNG, JPEG or WebP.", exists=True, dir_okay=False, readable=True)
]
Question = Annotated[
    str,
    typer.Argument(metavar="QUESTION", help='For example "If the red ball moves to the left, will it hit the vase?"'),
]
Place = Annotated[str | None, typer.Option(help="X,Y of a point on the object that moves, px.")]
Box = Annotated[str | None, typer.Option(help="X0,Y0,X1,Y1 of the object that moves, px.")]
Name = Annotated[str | None, typer.Option("--object", help="What the object is called, with --point or --box.")]
Direction = Annotated[str | None, typer.Option(help="DX,DY of the motion, px, x right, y down.")]
KindOfMotion = Annotated[Kind, typer.Option(help="Kind of motion, with --direction (or alone for fall and static).")]
Speed = Annotated[float | None, typer.Option(help="px/s, with --direction.", show_default="0.26 widths/s")]
Path_ = Annotated[
    Path | None,
    typer.Option(
        help="JSON with the `trajectory` of a request, as `cow tracks import` makes it.", exists=True, dir_okay=False
    ),
]
Reader = Annotated[str | None, typer.Option(help="Who looks at the image.", show_default="COW_READER")]
Generator = Annotated[str | None, typer.Option(help="Who makes the frames.", show_default="COW_GENERATOR")]
GeneratorOption = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="An option of the generator, such as steps=20; may be repeated."),
]
NumFrames = Annotated[int, typer.Option(help="Frames of the clip.")]
Fps = Annotated[float, typer.Option(help="Frames per second.")]
Seed = Annotated[int, typer.Option(help="For what draws random numbers.")]
Frames = Annotated[Policy, typer.Option(help="Which frames to keep as pictures.")]
Count = Annotated[int, typer.Option(help="How many of them.")]
MaxSide = Annotated[int, typer.Option(help="Their longest side, px; 0 for the clip's own size.")]
