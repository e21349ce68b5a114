"""Outgoing HTTP: to URLs of callers, safe against requests into the private network (SSRF) and against slow servers,
and to the multimodal LLM's server, whose replies are limited (`limit_replies`).

Of a caller's URL every hop is checked in full before anything is sent: scheme, host, and every address that the name
has now. The connection goes to the addresses that were checked, never to the name, so that a name server that answers
otherwise the second time changes nothing. Proxies of the environment are not asked, redirects of a POST are not
followed, no body is decompressed, and one deadline covers name, connection, TLS, headers and body together.

httpcore, the lower half of httpx, takes its connections from a backend of ours: the deadline has to stop a server that
sends its headers byte by byte, and httpx's time limits begin anew with every read.
"""

import re
import socket
import ssl
import zlib
from collections.abc import AsyncGenerator, Callable, Generator, Iterable, Mapping
from concurrent.futures import Future
from contextlib import aclosing, contextmanager
from dataclasses import KW_ONLY, InitVar, dataclass
from functools import cached_property
from ipaddress import IPv4Address, IPv4Network, IPv6Network, ip_address
from threading import Thread
from time import monotonic
from typing import Any, TypeVar

import httpcore
import httpx

from cow_service import __version__
from cow_service.errors import ImageUrlNotAllowed, ImageUrlUnreachable
from cow_service.settings import Settings, SettingsError

MAX_REDIRECTS = 3
MAX_URL = 4096  # characters
REDIRECTS = frozenset((301, 302, 303, 307, 308))
MAX_REPLY_BYTES = 16_000_000  # of a multimodal LLM: as 10 000 tokens with 20 alternatives each, of 80 bytes, would take
Client = TypeVar("Client", bound=Any)
_DEFAULT_PORTS = {"http": 80, "https": 443}


class EgressError(Exception):
    """The exchange failed. The message is whole sentences and names no address that a host name resolved to."""


class NotAllowed(EgressError):
    """The URL may not be requested."""


class Unreachable(EgressError):
    """The host cannot be reached, or did not answer as it must."""


# What others raise, and what becomes of it. The first row that fits is taken.
_FAILED = (OSError, httpcore.NetworkError, httpcore.ProxyError, httpcore.ConnectionNotAvailable)
TRANSLATED: tuple[tuple[tuple[type[Exception], ...], type[EgressError], str], ...] = (
    ((ssl.SSLCertVerificationError,), Unreachable, "The TLS certificate of '{host}' is not trusted for that name."),
    ((ssl.SSLError,), Unreachable, "The TLS connection to '{host}' failed."),
    ((socket.gaierror, socket.herror), Unreachable, "The host name '{host}' is unknown. Check its spelling."),
    ((TimeoutError, httpcore.TimeoutException), Unreachable, "'{host}' took too long."),
    ((ConnectionRefusedError,), Unreachable, "'{host}' refuses connections at that port."),
    (_FAILED, Unreachable, "The connection to '{host}' failed."),
    ((httpcore.LocalProtocolError,), NotAllowed, "The request to '{host}' cannot be written as HTTP."),
    ((httpcore.ProtocolError,), Unreachable, "'{host}' does not speak HTTP, or closed the connection early."),
    ((httpcore.UnsupportedProtocol,), NotAllowed, "The URL of '{host}' is not HTTP. Give an http or https URL."),
    ((UnicodeError,), NotAllowed, "{host} contains characters that must be percent-encoded."),
    ((httpx.InvalidURL, ValueError), NotAllowed, "{host} cannot be read. Give one like https://example.org/1.png."),
)


@contextmanager
def _translated(host: str) -> Generator[None]:
    try:
        yield
    except tuple(kind for foreign, _, _ in TRANSLATED for kind in foreign) as error:
        ours, text = next((ours, text) for foreign, ours, text in TRANSLATED if isinstance(error, foreign))
        raise ours(text.format(host=host)) from error


def look_up(host: str, port: int) -> list[str]:
    """Every address that a host name has, from the system's resolver. Raises `OSError`."""
    return [str(found[4][0]) for found in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]


WEB_PORTS = frozenset((80, 443))
_LABEL = re.compile(r"(?!-)[a-z0-9_-]{1,63}(?<!-)", re.ASCII)
_NUMBER = re.compile(r"[0-9]+|0x[0-9a-f]*", re.ASCII)

# Refused besides what `ipaddress` holds to be private or reserved, which differs between versions of Python.
_NOT_PUBLIC_4 = (
    IPv4Network("192.0.0.0/24"),  # protocol assignments; 192.0.0.192 is Oracle's metadata service
    IPv4Network("192.88.99.0/24"),  # relays of 6to4
    IPv4Network("168.63.129.16/32"),  # Azure's agent and name server, inside every machine of it
)
_NOT_PUBLIC_6 = (
    IPv6Network("2001::/23"),  # protocol assignments, Teredo among them
    IPv6Network("2001:db8::/32"),  # documentation
    IPv6Network("3fff::/20"),  # documentation, too
)
_UNICAST_6 = IPv6Network("2000::/3")
_NAT64 = IPv6Network("64:ff9b::/96")


def is_public(ip: str) -> bool:
    """Whether an address is one machine's (unicast) that the whole internet reaches."""
    if not is_address(ip):
        return False
    address = ip_address(ip)
    if isinstance(address, IPv4Address):
        named = address.is_global and not address.is_multicast and not address.is_reserved
        return named and not any(address in network for network in _NOT_PUBLIC_4)
    inner = IPv4Address(int(address) & 0xFFFFFFFF) if address in _NAT64 else address.ipv4_mapped or address.sixtofour
    if inner is not None:  # what is sent to it goes on to this one
        return is_public(str(inner))
    return address in _UNICAST_6 and address.is_global and not any(address in network for network in _NOT_PUBLIC_6)


def is_address(host: str) -> bool:
    """Whether it is an IP address in the usual notation, without brackets; one with a zone (%eth0) is not."""
    try:
        ip_address(host)
    except ValueError:  # a name, or one of the notations that only resolvers read
        return False
    return "%" not in host


def host_name(raw: str) -> str | None:
    """The host of a URL, lower case and IDNA, as name servers and certificates know it. None if it is no host.

    Whatever ends in a number is an address to the system's resolver (2130706433, 0x7f.1, 0177.0.0.1): here it must be
    one in the usual notation.
    """
    host = raw.lower().removesuffix(".")
    if is_address(host):
        return str(ip_address(host))
    labels = host.split(".")
    if len(host) > 253 or not all(_LABEL.fullmatch(label) for label in labels) or _NUMBER.fullmatch(labels[-1]):
        return None
    return host


class HostList:
    """Hosts that may be asked.

    An entry is a name or an address, `name:port` for another port than 80 and 443, `*.example.org` for all names below
    that one, or `*` for every host. Raises `ValueError` for any other entry.
    """

    def __init__(self, entries: Iterable[str]) -> None:
        self._entries: list[tuple[str, frozenset[int]]] = []  # a name, *.name or *; and its ports
        for text in entries:
            wrong = ValueError(f"{text!r} is none of: a host name, name:port, *.name, *")
            try:
                url = httpx.URL(f"any://{text}")  # a scheme without a port of its own: every port written is seen
            except httpx.InvalidURL as error:
                raise wrong from error
            raw, ports = url.raw_host.decode("ascii"), WEB_PORTS if url.port is None else frozenset((url.port,))
            name = raw.removeprefix("*.")
            known = raw if raw == "*" else host_name(name)
            if known is None or set(text) & set("/?#@") or not all(0 < port < 65536 for port in ports):
                raise wrong
            self._entries.append((raw.removesuffix(name) + known, ports))

    def has(self, host: str, port: int) -> bool:
        """Whether a host, as `host_name` gives it, may be asked at this port."""
        above = ["*." + host[place + 1 :] for place, letter in enumerate(host) if letter == "."]
        return any(name in ("*", host, *above) and port in ports for name, ports in self._entries)


@dataclass(frozen=True)
class _Target:
    """A URL that passed every check that needs no look-up of its host."""

    url: httpx.URL
    host: str  # normalised: lower case, IDNA, no trailing dot, no brackets
    port: int
    what: str  # how messages call it


@dataclass
class Egress:
    """Sends requests to URLs of callers. Safe to use from several threads.

    `allow` lists the hosts that may be asked, as `HostList` reads them; None allows every public host at every port.
    `seconds` is for a whole exchange with all redirects, `connect_seconds` for taking up one connection.
    `resolve` and `permitted` say which addresses a name has and which may be connected to.
    Raises `ValueError` for an entry of `allow` that cannot be read.
    """

    allow: InitVar[Iterable[str] | None]
    _: KW_ONLY
    seconds: float = 10.0
    connect_seconds: float = 5.0
    resolve: Callable[[str, int], list[str]] = look_up
    permitted: Callable[[str], bool] = is_public
    tls: ssl.SSLContext | None = None

    def __post_init__(self, allow: Iterable[str] | None) -> None:
        self._allow = None if allow is None else HostList(allow)

    def fetch(self, url: str, most_bytes: int) -> bytes:
        """The body at a URL, up to a maximum length. Raises `NotAllowed` or `Unreachable`."""
        target, end = self._target(url, "The URL"), monotonic() + self.seconds
        for _ in range(MAX_REDIRECTS + 1):
            with _translated(target.host), self._exchange("GET", target, end) as response:
                location = _headers(response, b"location")
                if response.status not in REDIRECTS or not location:
                    return _body(response, target.host, most_bytes)
                where = location[0].decode()
            with _translated("A redirect"):
                where = str(target.url.join(where))
            target = self._target(where, "A redirect")
        raise Unreachable(f"There were more than {MAX_REDIRECTS} redirects. Give the final URL.")

    def post(self, url: str, body: bytes, headers: Mapping[str, str]) -> int:
        """Sends a body, and returns the HTTP status of the answer, which may be that of a redirect.

        `headers` says its type and whatever else; host, length and encoding are put in here. Raises `NotAllowed` or
        `Unreachable`.
        """
        target, end = self._target(url, "The URL"), monotonic() + self.seconds
        with _translated(target.host), self._exchange("POST", target, end, body, headers) as response:
            return response.status

    def check(self, url: str, *, look_up: bool = False) -> None:
        """Raises `NotAllowed` for a URL that is never asked.

        What a name leads to now is only checked with `look_up`; that may raise `Unreachable`.
        """
        target = self._target(url, "The URL")
        with _translated(target.host):
            if look_up or is_address(target.host):
                self._addresses(target, monotonic() + self.seconds)

    def _target(self, text: str, what: str) -> _Target:
        """A URL taken apart, once; what is checked is what is used. Raises `NotAllowed`."""
        if not text[:8].lower().startswith(("http://", "https://")):
            raise NotAllowed(f"{what} does not begin with http:// or https://.")
        if len(text) > MAX_URL:
            raise NotAllowed(f"{what} is longer than {MAX_URL} characters.")
        with _translated(what):
            url = httpx.URL(text)
        if url.userinfo:
            raise NotAllowed(f"{what} holds a user name or a password. Leave them out.")
        raw = url.raw_host.decode("ascii")
        host = host_name(raw)
        if host is None:
            raise NotAllowed(f"{what} has no usable host name: '{raw[:100]}'. Give a name or a plain address.")
        port = _DEFAULT_PORTS[url.scheme] if url.port is None else url.port
        if not 0 < port < 65536:
            raise NotAllowed(f"{what} names a port that does not exist: {str(port)[:20]}.")
        if self._allow is not None and not self._allow.has(host, port):
            raise NotAllowed(f"{what} names the host '{host}' at port {port}, which is not on this server's list.")
        return _Target(url, host, port, what)

    @contextmanager
    def _exchange(
        self,
        method: str,
        target: _Target,
        end: float,
        body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> Generator[httpcore.Response]:
        """One request, and the beginning of its answer; all of it until `end`, by the monotonic clock."""
        host = f"[{target.host}]" if ":" in target.host else target.host
        ours = {
            "host": host if target.port == _DEFAULT_PORTS[target.url.scheme] else f"{host}:{target.port}",
            "user-agent": f"cow-service/{__version__}",
            "accept-encoding": "identity",
            "connection": "close",
        } | ({} if body is None else {"content-length": str(len(body))})
        sent = {name.lower(): value for name, value in (headers or {}).items()} | ours
        coded = [(name.encode("ascii"), value.encode("ascii")) for name, value in sent.items()]
        url = httpcore.URL(
            scheme=target.url.raw_scheme, host=target.host.encode(), port=target.port, target=target.url.raw_path
        )
        tls = self._tls if target.url.scheme == "https" else None
        backend = _PinnedBackend(self._addresses(target, end), end, self.connect_seconds)
        with (
            httpcore.ConnectionPool(ssl_context=tls, network_backend=backend) as pool,
            pool.stream(method, url, headers=coded, content=body) as response,
        ):
            yield response

    def _addresses(self, target: _Target, end: float) -> list[str]:
        """Where a host is now. Raises `NotAllowed` if any of it may not be connected to."""
        answer: Future[list[str]] = Future()

        def ask() -> None:
            try:
                answer.set_result(self.resolve(target.host, target.port))
            except Exception as error:  # noqa: BLE001 - raised where the answer is waited for
                answer.set_exception(error)

        if is_address(target.host):
            answer.set_result([target.host])
        else:  # the system's resolver takes no time limit: where it is too slow, its thread is left to end by itself
            Thread(target=ask, name="cow-look-up", daemon=True).start()
        addresses = answer.result(_seconds_until(end))
        if not addresses:
            raise Unreachable(f"The host name '{target.host}' has no address.")
        if not all(self.permitted(address) for address in addresses):
            raise NotAllowed(f"{target.what} leads to the host '{target.host}', which does not have a public address.")
        return addresses

    @cached_property
    def _tls(self) -> ssl.SSLContext:
        """Whose certificates are trusted: those of certifi, or of SSL_CERT_FILE. Slow to make, so made when needed."""
        return self.tls or httpx.create_ssl_context()


def _seconds_until(end: float) -> float:
    """Seconds left of an exchange, more than none. Raises `TimeoutError` after its end."""
    left = end - monotonic()
    if left <= 0:
        raise TimeoutError("the time limit of this exchange has passed")
    return left


@dataclass(frozen=True)
class _PinnedBackend(httpcore.NetworkBackend):
    """Connects to addresses that were checked, whatever the host name."""

    addresses: list[str]
    end: float  # of the exchange, by the monotonic clock, s
    seconds: float  # for one connection

    def connect_tcp(self, host: str, port: int, *_: Any, **__: Any) -> httpcore.NetworkStream:
        """A connection to the first address that takes one. Raises `OSError`."""
        failed: OSError = OSError("no address")
        for address in self.addresses:
            try:
                connection = socket.create_connection((address, port), min(self.seconds, _seconds_until(self.end)))
            except OSError as error:  # the last one is raised
                failed = error
            else:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return _Stream(connection, self.end)
        raise failed


@dataclass(frozen=True)
class _Stream(httpcore.NetworkStream):
    """A connection whose every operation ends with the deadline. Raises `OSError`."""

    connection: socket.socket
    end: float  # of the exchange, by the monotonic clock, s

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        self.connection.settimeout(_seconds_until(self.end))
        return self.connection.recv(max_bytes)

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        rest = memoryview(buffer)
        while rest:  # not sendall, which with TLS begins its time limit anew for every piece
            self.connection.settimeout(_seconds_until(self.end))
            rest = rest[self.connection.send(rest) :]

    def close(self) -> None:
        self.connection.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        """The same connection with TLS, for the name in the URL. Raises `OSError`."""
        try:
            self.connection.settimeout(_seconds_until(self.end))
            return _Stream(ssl_context.wrap_socket(self.connection, server_hostname=server_hostname), self.end)
        except BaseException:
            self.connection.close()
            raise


def _headers(response: httpcore.Response, name: bytes) -> list[bytes]:
    return [value.strip() for key, value in response.headers if key.lower() == name]


def _body(response: httpcore.Response, host: str, most_bytes: int) -> bytes:
    """The body of a good answer. Raises `Unreachable`."""
    if response.status != 200:
        raise Unreachable(f"'{host}' answered with HTTP {response.status} instead of 200.")
    encodings = [value.lower() for value in _headers(response, b"content-encoding")]
    if any(value not in (b"", b"identity") for value in encodings):
        raise Unreachable(f"'{host}' answered with a compressed body, which was not requested.")
    too_long = Unreachable(f"The response of '{host}' is larger than {most_bytes} bytes.")
    if any(int(length) > most_bytes for length in _headers(response, b"content-length")):
        raise too_long
    body = bytearray()
    for part in response.iter_stream():
        body += part
        if len(body) > most_bytes:
            raise too_long
    return bytes(body)


def limit_replies(client: Client, *, each_event: bool = False) -> Client:
    """An `AsyncClient` of httpx or httpx2 that asks for replies without compression, and gives up those of more than
    `MAX_REPLY_BYTES`, unpacked, with `Unreachable`.

    `each_event`: the limit holds for every event of a stream. The client's own decoders would unpack a compressed reply
    before its bytes could be counted.
    """

    async def limit(response: Any) -> None:
        encoding, received = response.headers.pop("content-encoding", "identity").lower(), response.aiter_raw
        if encoding not in ("", "identity", "gzip"):
            raise Unreachable("It answered with a compressed body, which was not requested.")
        gzip = zlib.decompressobj(zlib.MAX_WBITS | 16) if encoding == "gzip" else None

        async def counted(_: int | None = None) -> AsyncGenerator[bytes]:
            left = MAX_REPLY_BYTES
            async with aclosing(received()) as parts:
                async for part in parts:
                    try:
                        data = gzip.decompress(part, left + 1) if gzip else part
                    except zlib.error as error:
                        raise Unreachable("Its compressed body cannot be unpacked.") from error
                    left -= len(data)
                    if left < 0:
                        raise Unreachable(f"It answered with more than {MAX_REPLY_BYTES} bytes.")
                    if each_event and (b"\n\n" in data or b"\r\n\r\n" in data):  # an event has ended
                        left = MAX_REPLY_BYTES
                    yield data

        response.aiter_raw = counted

    client.headers["Accept-Encoding"] = "identity"
    client.event_hooks["response"].append(limit)
    return client


class ImageUrls:
    """Fetches images by URL, from the hosts of `COW_ALLOW_IMAGE_URLS`. Safe to use from several threads.

    Raises `SettingsError` for an entry of the setting that is no host. `egress` stands in for the way out in tests.
    """

    def __init__(self, settings: Settings, egress: Egress | None = None) -> None:
        self._most_bytes = int(settings.max_body_mb * 1e6)
        self._egress = egress
        if egress is None and settings.allow_image_urls:
            try:
                self._egress = Egress(settings.allow_image_urls)
            except ValueError as error:
                raise SettingsError(f"Bad settings: COW_ALLOW_IMAGE_URLS: {error}.") from error

    def fetch(self, url: str) -> bytes:
        """The bytes at a URL; nothing says yet that they are an image.

        Raises `ImageUrlNotAllowed`, or `ImageUrlUnreachable` where the host does not deliver. Takes at most 10 s.
        """
        with self._allowed() as egress:
            return egress.fetch(url, self._most_bytes)

    def check(self, url: str) -> None:
        """Raises as `fetch` for the URL of a video or sound, which the multimodal LLM's server fetches by itself."""
        with self._allowed() as egress:
            egress.check(url, look_up=True)

    @contextmanager
    def _allowed(self) -> Generator[Egress]:
        remedy = "Or send the data itself, as a data URL or as a file part."
        try:
            if self._egress is None:
                raise NotAllowed("This server fetches nothing by URL: no host is in COW_ALLOW_IMAGE_URLS.")
            yield self._egress
        except NotAllowed as error:
            raise ImageUrlNotAllowed(f"{error} {remedy}") from error
        except Unreachable as error:
            raise ImageUrlUnreachable(f"{error} {remedy}") from error
