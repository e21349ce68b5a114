"""Images that a request names by URL: fetched where the operator allows it, and refused where not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cow_service.errors import ImageUrlNotAllowed, ImageUrlUnreachable
from cow_service.settings import Settings, SettingsError

if TYPE_CHECKING:
    from cow_service.net.egress import Egress

_REMEDY = "Or send the image itself, as a data URL or as a file part."


class ImageUrls:
    """Fetches images by URL, from the hosts of `COW_ALLOW_IMAGE_URLS`. Safe to use from several threads.

    Raises `SettingsError` for an entry of the setting that is no host. `egress` stands in for the way out in tests.
    """

    def __init__(self, settings: Settings, egress: Egress | None = None) -> None:
        self._most_bytes = int(settings.max_body_mb * 1e6)
        self._egress = egress
        if egress is None and settings.allow_image_urls:
            # Only here: a server that fetches nothing starts without an HTTP client (0.15 s).
            from cow_service.net.egress import Egress  # noqa: PLC0415

            try:
                self._egress = Egress(settings.allow_image_urls)
            except ValueError as error:
                raise SettingsError(f"Bad settings: COW_ALLOW_IMAGE_URLS: {error}.") from error

    def fetch(self, url: str) -> bytes:
        """The bytes at a URL; nothing says yet that they are an image.

        Raises `ImageUrlNotAllowed`, or `ImageUrlUnreachable` where the host does not deliver. Takes at most 10 s.
        """
        if self._egress is None:
            raise ImageUrlNotAllowed("This server fetches no images. Send the image as a data URL or as a file part.")
        from cow_service.net.egress import NotAllowed, Unreachable  # noqa: PLC0415

        try:
            return self._egress.fetch(url, self._most_bytes)
        except NotAllowed as error:
            raise ImageUrlNotAllowed(f"{error} {_REMEDY}") from error
        except Unreachable as error:
            raise ImageUrlUnreachable(f"{error} {_REMEDY}") from error
