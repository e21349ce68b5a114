"""What rank 0 and the processes of the other ranks tell each other, over a pipe to each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cow_service.generators.wan.profiles import Profile
from cow_service.generators.wan.sampling import Sampling
from cow_service.settings import Settings

Array = NDArray[np.float32]

# To a rank.


@dataclass(frozen=True)
class Load:
    """The first message: which model, in which way. The profile's attention backend is chosen already."""

    rank: int
    device: str
    name: str  # of the manifest
    profile: Profile
    settings: Settings


@dataclass(frozen=True)
class Join:
    """All have loaded: meet the others at this port."""

    port: int


@dataclass(frozen=True)
class Share:
    """Take part in a clip: the arguments of `denoise`, in float32."""

    noise: Array
    prompt: Array
    negative_prompt: Array | None
    image: Array
    condition: Array
    unconditional: Array
    sampling: Sampling


# From a rank.


@dataclass(frozen=True)
class Loaded:
    """It has its weights."""


@dataclass(frozen=True)
class Failed:
    """It ends, for the `CowError` of this code."""

    code: str
    detail: str


ToRank = Load | Join | Share
FromRank = Loaded | Failed
