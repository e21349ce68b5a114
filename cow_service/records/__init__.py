"""Frozen records that the server, the SDK and the HTTP API share; each can be imported from here.

Coordinates are pixels of the upright input image, x right, y down, (0, 0) the image's top left corner.
Times are seconds from the first frame. Records hold no pixels and do no I/O: bytes are named by their SHA-256.
"""

from cow_service.records.grounding import *  # noqa: F403
from cow_service.records.reading import *  # noqa: F403
from cow_service.records.results import *  # noqa: F403
from cow_service.records.stages import *  # noqa: F403
from cow_service.records.values import *  # noqa: F403
from cow_service.records.world import *  # noqa: F403
