"""The bodies of `POST /simulate` and `POST /answer`. They are checked once, here, and trusted afterwards."""

from cow_service.records.reading import *  # noqa: F403
from cow_service.records.values import *  # noqa: F403
from cow_service.requests.simulation import *  # noqa: F403
