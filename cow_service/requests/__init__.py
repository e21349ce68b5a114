"""What a caller may ask: the bodies of `POST /simulate` and `POST /answer`. Checked once, here, then trusted."""

from cow_service.requests.simulation import *  # noqa: F403
from cow_service.requests.values import *  # noqa: F403
