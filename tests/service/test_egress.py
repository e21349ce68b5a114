"""Outgoing HTTP: what strangers name cannot reach inside, hold the server up, or fill its memory."""

from __future__ import annotations

import datetime
import ipaddress
import itertools
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpcore
import httpx
import idna
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from waiting import TIME_LIMIT

from cow_service.net import (
    TRANSLATED,
    Egress,
    EgressError,
    HostList,
    ImageUrls,
    NotAllowed,
    Unreachable,
    host_name,
    is_public,
    look_up,
)
from cow_service.settings import Settings, SettingsError

MOST = 100_000  # bytes
BODY = b"not really an image" * 50


class Site(ThreadingHTTPServer):
    """A server on loopback that says what it is told, by path, and remembers what it was asked."""

    daemon_threads = True

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.port = self.server_address[1]
        self.pages: dict[str, Callable[[Handler], None]] = {"/image": saying(OK + BODY)}
        self.asked: list[tuple[str, str, dict[str, str], bytes]] = []
        self.tls = tls

    def finish_request(self, request: socket.socket, client_address: object) -> None:
        try:
            if self.tls is not None:
                with self.tls.wrap_socket(request, server_side=True) as secured:
                    super().finish_request(secured, client_address)
            else:
                super().finish_request(request, client_address)
        except OSError:
            return  # who asked has gone, as it should


class Handler(BaseHTTPRequestHandler):
    server: Site

    def do_GET(self) -> None:
        length = int(self.headers.get("content-length", 0))
        body = self.rfile.read(length) if length < 1_000_000 else b""
        self.server.asked.append((self.command, self.path, dict(self.headers.items()), body))
        self.server.pages[self.path](self)

    do_POST = do_GET

    def log_message(self, *_: object) -> None:
        pass


OK = b"HTTP/1.1 200 OK\r\n\r\n"


def saying(start: bytes, piece: bytes = b"", pause: float = 0.0) -> Callable[[Handler], None]:
    """An answer, word for word; with a `piece` it goes on until nobody hears it any more."""

    def answer(page: Handler) -> None:
        page.wfile.write(start)
        while piece:
            page.wfile.write(piece)
            time.sleep(pause)

    return answer


def running(site: Site) -> Iterator[Site]:
    thread = threading.Thread(target=site.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield site
    site.shutdown()
    thread.join()
    site.server_close()


@pytest.fixture(scope="module")
def server() -> Iterator[Site]:
    yield from running(Site())


@pytest.fixture
def site(server: Site) -> Site:
    server.asked.clear()
    return server


def names(**more: str) -> Callable[[str, int], list[str]]:
    known = {"images.test": "127.0.0.1"} | {name.replace("_", "."): ips for name, ips in more.items()}
    return lambda host, port: known[host].split()


def egress(site: Site, *, hosts: tuple[str, ...] = ("images.test",), **told: object) -> Egress:
    """Takes 127.0.0.1 for a public address, and no other."""
    told = {"resolve": names(), "permitted": lambda ip: ip == "127.0.0.1", "seconds": TIME_LIMIT} | told
    return Egress([f"{host}:{site.port}" for host in hosts], **told)


def url(site: Site, path: str = "/image", host: str = "images.test", scheme: str = "http") -> str:
    return f"{scheme}://{host}:{site.port}{path}"


# What comes back


def test_a_body_is_fetched(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # no server is there: a request to it would fail
    site.pages["/a%20b%2Fc?x=1&y=%00"] = saying(OK + BODY)
    assert egress(site).fetch(url(site, "/a b%2Fc?x=1&y=%00#part"), MOST) == BODY  # path and query as they were
    assert egress(site).fetch(url(site, host="IMAGES.test."), len(BODY)) == BODY
    method, path, headers, _ = site.asked[1]
    assert (method, path) == ("GET", "/image")
    headers = {name.lower(): value for name, value in headers.items()}
    assert headers["host"] == f"images.test:{site.port}"
    assert headers["accept-encoding"] == "identity"
    assert set(headers) == {"host", "accept-encoding", "user-agent", "connection"}
    for length, sent in ((MOST, MOST), (10, 4 * MOST)):  # of more than was announced the rest is left
        site.pages["/most"] = saying(OK[:-2] + b"content-length: %d\r\n\r\n" % length + b"x" * sent)
        assert egress(site).fetch(url(site, "/most"), MOST) == b"x" * length


def headed(*headers: str) -> bytes:
    return OK[:-2] + "".join(f"{header}\r\n" for header in headers).encode() + b"\r\n"


NO_HTTP = "does not speak HTTP"
WRONG = {  # what a server says, goes on saying, and is told to have done
    "success without a body": (b"HTTP/1.1 204 No Content\r\n\r\n", b"", "HTTP 204"),
    "a redirect to nowhere": (b"HTTP/1.1 302 Found\r\n\r\n", b"", "HTTP 302"),
    "a body without end": (OK, b"x" * 65536, "100000 bytes"),
    "chunks without end": (headed("transfer-encoding: chunked"), b"1\r\nx\r\n" * 4096, "100000 bytes"),
    "too many bytes announced": (headed("content-length: 100001"), b"", "100000 bytes"),
    "fewer bytes than announced": (headed("content-length: 50") + b"x" * 10, b"", NO_HTTP),
    "a length that is no number": (headed("content-length: ten"), b"", NO_HTTP),
    "compressed": (headed("content-encoding: gzip") + BODY, b"", "compressed"),
    "compressed at last": (headed("content-encoding: identity, gzip") + BODY, b"", "compressed"),
    "compressed on the way": (headed("transfer-encoding: gzip, chunked") + BODY, b"", NO_HTTP),
    "nothing": (b"", b"", NO_HTTP),
    "another protocol": (b"SSH-2.0-OpenSSH_9.6\r\n", b"", NO_HTTP),
    "headers without end": (OK[:-2], b"a: " + b"b" * 9000 + b"\r\n", NO_HTTP),
}
SLOW = {
    "a word": (b"", b"H"),
    "words before the answer": (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "a body": (headed("content-length: 500"), b"x"),
}


@pytest.mark.parametrize("said", [*WRONG, *SLOW])
def test_what_is_no_answer_with_an_image_or_does_not_come_to_its_end(site: Site, said: str) -> None:
    start, piece, told = WRONG.get(said) or (*SLOW[said], "too long")
    site.pages["/said"] = saying(start, piece, 0.05 if said in SLOW else 0)
    with pytest.raises(Unreachable, match=told):
        egress(site, seconds=0.3 if said in SLOW else TIME_LIMIT).fetch(url(site, "/said"), MOST)


def test_one_clock_for_name_and_redirects_together(site: Site) -> None:
    ended = threading.Event()

    def slowly(host: str, port: int) -> list[str]:
        time.sleep(0.15)
        return ["127.0.0.1"]

    def never(host: str, port: int) -> list[str]:
        ended.wait(TIME_LIMIT)
        return ["127.0.0.1"]

    redirect(site, "/again", "/again")
    with pytest.raises(Unreachable):
        egress(site, seconds=0.4, resolve=slowly).fetch(url(site, "/again"), MOST)
    assert len(site.asked) < 4, "the redirects did not end it"
    with pytest.raises(Unreachable):
        egress(site, seconds=0.1, resolve=never).fetch(url(site), MOST)
    ended.set()


def test_a_receiver_that_takes_no_bytes_is_left(site: Site) -> None:
    def sip(page: Handler) -> None:
        for _ in range(600):
            page.connection.recv(65536)
            time.sleep(0.004)
        page.wfile.write(OK)

    site.pages["/sips"] = sip
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        for port, path in ((deaf.getsockname()[1], "/"), (site.port, "/sips")):
            way = Egress([f"images.test:{port}"], seconds=0.3, resolve=names(), permitted=lambda ip: True)
            with pytest.raises(Unreachable):
                way.post(f"http://images.test:{port}{path}", bytes(40_000_000), {})


def test_nobody_there_or_at_another_address(site: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(Unreachable):
        Egress(None, resolve=names(), permitted=lambda ip: True).fetch(f"http://images.test:{port}/", MOST)
    with pytest.raises(Unreachable, match="no address"):
        egress(site, resolve=lambda *_: []).fetch(url(site), MOST)
    # At the first address no server listens.
    way = egress(site, resolve=lambda *_: ["::1", "127.0.0.1"], permitted=lambda ip: True)
    assert way.fetch(url(site), MOST) == BODY


# What is not asked at all


@pytest.fixture
def unconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a connection was made")

    monkeypatch.setattr(socket, "create_connection", refuse)


LOCAL = {"localhost": ["127.0.0.1", "::1"], "localhost.localdomain": ["127.0.0.1"], "ip6-loopback": ["::1"]}


def resolve_here(host: str, port: int) -> list[str]:
    """Names of this machine, and every notation of addresses that the system reads; asks no name server."""
    if host in LOCAL:
        return LOCAL[host]
    return [str(found[4][0]) for found in socket.getaddrinfo(host, port, flags=socket.AI_NUMERICHOST)]


BAD = {  # URLs that are not asked, by why they are not
    "another scheme": "image.png file:///etc/passwd ftp://example.org/image.png",
    "no host": "http:// https://:443/ http:127.0.0.1/ http://[::1/ http://[127.0.0.1]/ http://-a.example/ http://a..example/",
    "a user": "http://user:hunter2@example.org/ http://example.org@127.0.0.1/",
    "two ways to read it": r"http://example.org\@127.0.0.1/ http://127.0.0.1\@example.org/ http://127.0.0.1#@example.org/",
    "this machine": "http://localhost/ http://localhost./ http://127.0.0.1/ http://127.0.0.1../ http://0/ http://[::]/",
    "metadata of a cloud": "http://169.254.169.254/meta http://168.63.129.16/machine http://192.0.0.192/opc/v2/",
    "not public": "http://100.100.100.200/ http://203.0.113.1/ http://240.0.0.1/ http://192.88.99.1/",
    "odd digits": "http://0x7F.1/ http://0x/ http://１２７.0.0.1/ http://%31%32%37.0.0.1/ http://loc%61lhost/",
    "IPv4 inside IPv6": "http://[::ffff:127.0.0.1]/ http://[::127.0.0.1]/ http://[::ffff:0:127.0.0.1]/ "
    "http://[64:ff9b::169.254.169.254]/ http://[64:ff9b:1::7f00:1]/ http://[2002:7f00:1::1]/ http://[2001:0:7f00:1::1]/",
    "IPv6": "http://[::1]/ http://[2606:4700::1%25lo]/ http://[fe80::1]/ http://[fc00::1]/ http://[fec0::1]/ "
    "http://[ff02::1]/ http://[2001:db8::1]/ http://[3fff::1]/",
    "no port": "http://example.org:0/ http://example.org:65536/ http://example.org:-1/",
    "too long": f"http://{'a' * 64}.example/ http://{'a.' * 130}example/ http://example.org/{'a' * 5000}",
}
UNREADABLE = ["", "http://exa mple.org/", "http://a.org/\r\nx: y", "http://\x00a.org/", "http://xn--a-ecp.ru\u200f/"]


@pytest.mark.usefixtures("unconnected")
@pytest.mark.parametrize("bad", [*UNREADABLE, *(url for urls in BAD.values() for url in urls.split())])
def test_what_is_not_asked(bad: str) -> None:
    for hosts in (["*"], None):
        way = Egress(hosts, resolve=resolve_here)
        with pytest.raises(NotAllowed) as caught:
            way.fetch(bad, MOST)
        assert "hunter2" not in str(caught.value)
        assert len(str(caught.value)) < 400
        with pytest.raises(NotAllowed):
            way.post(bad, b"{}", {})


@pytest.mark.usefixtures("unconnected")
def test_every_address_of_a_name_must_be_permitted_and_none_is_told() -> None:
    for answer in (["8.8.8.8", "127.0.0.1"], ["::1", "8.8.8.8"], ["8.8.8.8", "fe80::1%lo"], ["", "8.8.8.8"]):
        with pytest.raises(NotAllowed, match=r"'intranet\.example'") as caught:
            Egress(["*"], resolve=lambda *_: answer).fetch("http://intranet.example/", MOST)  # noqa: B023
        assert not [ip for ip in answer if ip and ip in str(caught.value)]


def test_a_name_that_changes_is_asked_once_and_held_to(site: Site) -> None:
    answers = iter(["127.0.0.1", "127.0.0.9", "169.254.169.254"])
    asked: list[str] = []

    def rebinding(host: str, port: int) -> list[str]:
        asked.append(host)
        return [next(answers)]

    way = egress(site, resolve=rebinding)
    assert way.fetch(url(site), MOST) == BODY
    assert asked == ["images.test"]
    with pytest.raises(NotAllowed):
        way.fetch(redirect(site, "/once-more", "/image"), MOST)
    assert len(site.asked) == 1


PRIVATE = ("127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "100.64.0.0/10")
REFUSED = (*PRIVATE, "0.0.0.0/8", "224.0.0.0/4", "240.0.0.0/4", "192.0.2.0/24", "198.18.0.0/15", "192.0.0.0/24")
ADDRESSES = st.sampled_from(REFUSED).flatmap(lambda network: st.ip_addresses(v=4, network=network))
BASES = st.sampled_from(("{}", "0x{:x}", "0X{:X}", "0{:o}", "0x000{:x}", "00{:o}"))


@st.composite
def notations(draw: st.DrawFn) -> str:
    """An address that must not be reached, in any notation that inet_aton reads: 1 to 4 parts, each in any base."""
    number = int(draw(ADDRESSES))
    parts = draw(st.integers(1, 4))
    values = [number >> (24 - 8 * place) & 0xFF for place in range(parts - 1)]
    values.append(number & (1 << (8 * (5 - parts))) - 1)
    text = draw(st.sampled_from("...。．")).join(draw(BASES).format(value) for value in values)
    return text + draw(st.sampled_from(("", ".", "")))


@given(notations(), st.sampled_from(("", ":80", ":443")))
def test_no_notation_of_a_private_address_gets_through(text: str, port: str) -> None:
    for hosts in (["*"], None):
        with pytest.raises(NotAllowed):
            Egress(hosts, resolve=look_up).fetch(f"http://{text}{port}/", MOST)
    plain = text.replace("。", ".").replace("．", ".").removesuffix(".")
    # The second wall, if such a text were taken for a name: what the system makes of it is not public either.
    assert not any(is_public(ip) for ip in resolve_here(plain, 80))


@given(ADDRESSES)
def test_no_private_address_inside_another_is_public(inner: ipaddress.IPv4Address) -> None:
    number = int(inner)
    assert not is_public(str(inner))
    for outer in (number, 0xFFFF << 32 | number, 0x64FF9B << 96 | number, 0x2002 << 112 | number << 80 | 1):
        assert not is_public(str(ipaddress.IPv6Address(outer)))


@given(st.ip_addresses(v=4) | st.ip_addresses(v=6, network="2000::/3"))
def test_public_is_never_more_than_python_holds_global(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> None:
    if is_public(str(address)):
        kinds = ("private", "loopback", "link_local", "multicast", "unspecified", "reserved")
        assert not [kind for kind in kinds if getattr(address, f"is_{kind}")]


def test_public_addresses_are_public() -> None:
    for ip in ("8.8.8.8", "172.32.0.1", "100.128.0.1", "2606:4700:4700::1111", "64:ff9b::808:808", "::ffff:8.8.8.8"):
        assert is_public(ip), ip


# Who is on the list


@pytest.mark.parametrize(
    ("entry", "yes", "no"),
    [
        ("example.org", "example.org:80 example.org:443", "example.org:8080 a.example.org:80 xample.org:80"),
        ("EXAMPLE.org.", "example.org:443", "example.org.evil.test:443"),
        ("example.org:8443", "example.org:8443", "example.org:443"),
        ("*.example.org", "a.example.org:80 a.b.example.org:443", "example.org:80 aexample.org:80 a.example.org:81"),
        ("*", "example.org:80 8.8.8.8:443", "example.org:25"),
        ("*:8080", "example.org:8080", "example.org:80"),
        ("bücher.example", "xn--bcher-kva.example:443", "bucher.example:443"),
        ("8.8.8.8", "8.8.8.8:80", "8.8.8.80:80"),
        ("[2606:4700::0001]:81", "2606:4700::1:81", "2606:4700::1:80"),
    ],
)
def test_entries_of_the_list(entry: str, yes: str, no: str) -> None:
    hosts = HostList([entry])
    for wanted, texts in ((True, yes), (False, no)):
        for text in texts.split():
            host, _, port = text.rpartition(":")
            assert hosts.has(host, int(port)) == wanted, text


def test_entries_that_are_none() -> None:
    entries = "https://example.org example.org/images user@example.org *. a.*.org ** *example.org *.1 2130706433"
    entries += " example.org:0 example.org:99999 [::1 -.org"
    for entry in ("", "exa mple.org", *entries.split()):
        with pytest.raises(ValueError, match="is none of"):
            HostList([entry])
    with pytest.raises(SettingsError, match="COW_ALLOW_IMAGE_URLS"):
        ImageUrls(Settings(allow_image_urls=("",)))


@pytest.mark.usefixtures("unconnected")
def test_what_can_be_told_from_a_url_is_told_without_a_look_up() -> None:
    def never(host: str, port: int) -> list[str]:
        raise AssertionError(host)

    with pytest.raises(NotAllowed, match=r"'evil\.test' at port 443, which is not on this server's list"):
        Egress(["images.test"], resolve=never).fetch("https://evil.test/images.test", MOST)
    with pytest.raises(NotAllowed, match="at port 22"):
        Egress(["*"], resolve=never).fetch("http://images.test:22/", MOST)
    way, longest = Egress(None, resolve=never), "https://8.8.8.8:65535/".ljust(4096, "a")
    assert (way.seconds, way.connect_seconds) == (10, 5)
    for good in ("https://hooks.example.org:8443/job?x=1", longest):
        way.check(good)
    for bad in ("hooks.example.org", "http://10.0.0.1/", "http://a:b@c.org/", longest + "a"):
        with pytest.raises(NotAllowed):
            way.check(bad)


@given(st.text(max_size=20))
def test_a_host_name_is_plain_or_none(text: str) -> None:
    name = host_name(text)
    assert name is None or host_name(name) == name
    assert name is None or set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_.:")


# Redirects


def redirect(site: Site, path: str, where: str, status: int = 302) -> str:
    site.pages[path] = saying(f"HTTP/1.1 {status} Moved\r\nlocation: {where}\r\n\r\nmoved".encode())
    return url(site, path)


def test_redirects_are_followed_a_few_times(site: Site) -> None:
    for status in (301, 302, 303, 307, 308):
        site.asked.clear()
        redirect(site, "/2", "image", status)
        redirect(site, "/1", f"//images.test:{site.port}/2", status)
        assert egress(site).fetch(redirect(site, "/0", url(site, "/1"), status), MOST) == BODY
        assert [path for _, path, _, _ in site.asked] == ["/0", "/1", "/2", "/image"]
    with pytest.raises(Unreachable, match="more than 3 redirects"):
        egress(site).fetch(redirect(site, "/loop", "/loop"), MOST)
    assert len(site.asked) == 8
    site.pages["/bytes"] = saying(b"HTTP/1.1 302 Found\r\nlocation: /\xff\xfe\r\n\r\n")
    with pytest.raises(EgressError, match="percent-encoded"):
        egress(site).fetch(url(site, "/bytes"), MOST)


HOPS = "file:///etc/passwd http://user@images.test:{port}/image http://127.0.0.2:{port}/image http://[::1"
HOPS += " http://localhost:{port}/image http://images.test/image //evil.test:{port}/image"


@pytest.mark.parametrize("where", HOPS.split())
def test_every_hop_is_checked(site: Site, where: str) -> None:
    hosts = ("images.test", "localhost", "127.0.0.2")
    way = egress(site, hosts=hosts, resolve=names(localhost="127.0.0.3", evil_test="127.0.0.1"))
    with pytest.raises(NotAllowed, match=r"^A redirect"):
        way.fetch(redirect(site, "/away", where.format(port=site.port)), MOST)
    assert [path for _, path, _, _ in site.asked] == ["/away"]


# Posts


def test_a_post_says_the_status_follows_nothing_and_reads_nothing(site: Site) -> None:
    site.pages["/hook"] = saying(b"HTTP/1.1 202 Accepted\r\n\r\n", b"x" * 65536)
    headers = {"Content-Type": "application/json", "X-Signature": "abc", "Host": "evil.test", "Content-Length": "7"}
    assert egress(site).post(url(site, "/hook"), b'{"id": 1}', headers) == 202
    method, path, got, body = site.asked[0]
    assert (method, path, body) == ("POST", "/hook", b'{"id": 1}')
    got = {name.lower(): value for name, value in got.items()}
    named = {"host": f"images.test:{site.port}", "content-type": "application/json", "x-signature": "abc"}
    assert got.items() >= (named | {"content-length": "9"}).items()
    assert egress(site).post(redirect(site, "/moved", "http://127.0.0.1/", 307), b"", {}) == 307
    for wrong in ({"x": "a\r\ny: b"}, {"x\r\n": "a"}, {"x": "ü"}):
        with pytest.raises(NotAllowed):
            egress(site).post(url(site), b"", wrong)
    assert len(site.asked) == 2


# TLS


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of images.test alone, signed by itself."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "images.test")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("images.test")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    plain = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    path = tmp_path_factory.mktemp("tls") / "images.test.pem"
    path.write_bytes(key.private_bytes(*plain) + made.public_bytes(serialization.Encoding.PEM))
    return path


@pytest.fixture(scope="module")
def secure(certificate: Path) -> Iterator[Site]:
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate)
    yield from running(Site(tls))


def test_tls_is_of_the_name_although_the_address_is_asked(secure: Site, certificate: Path) -> None:
    trusting = ssl.create_default_context(cafile=str(certificate))
    way = egress(secure, hosts=("images.test", "other.test"), resolve=names(other_test="127.0.0.1"), tls=trusting)
    assert way.fetch(url(secure, scheme="https"), MOST) == BODY
    assert secure.asked[-1][2]["host"] == f"images.test:{secure.port}"
    with pytest.raises(Unreachable, match=r"certificate of 'other\.test'"):
        way.fetch(url(secure, host="other.test", scheme="https"), MOST)
    with pytest.raises(Unreachable, match="certificate"):
        egress(secure).fetch(url(secure, scheme="https"), MOST)
    assert len(secure.asked) == 1


def test_no_tls_where_it_is_wanted(site: Site) -> None:
    with pytest.raises(Unreachable, match="The TLS connection"):
        egress(site).fetch(url(site, scheme="https"), MOST)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        way = Egress(None, seconds=0.3, resolve=names(), permitted=lambda ip: True)
        with pytest.raises(Unreachable):
            way.fetch(f"https://images.test:{port}/", MOST)


# The table


def test_every_foreign_exception_is_translated_and_faults_of_our_own_are_not() -> None:
    arguments = {UnicodeEncodeError: ("ascii", "ü", 0, 1, "no"), UnicodeDecodeError: ("ascii", b"\xff", 0, 1, "no")}
    named = [kind for module in (httpcore, socket, ssl, idna) for name, kind in vars(module).items() if name[0] != "_"]
    builtin = [kind for kind in OSError.__subclasses__() if kind.__module__ == "builtins"]
    known = (*named, *builtin, *arguments, OSError, httpx.InvalidURL)
    foreign = {kind for kind in known if isinstance(kind, type) and issubclass(kind, Exception)}
    assert len(foreign) > 40

    def raising(error: Exception) -> None:
        """Fails at its name server."""

        def resolve(host: str, port: int) -> list[str]:
            raise error

        Egress(None, resolve=resolve).fetch("http://images.test/", MOST)

    for kind in foreign:
        with pytest.raises(EgressError, match=r"images\.test.*\.$"):
            raising(kind(*arguments.get(kind, ("secret 10.0.0.1",))))
    with pytest.raises(KeyError):
        raising(KeyError("x"))
    for above, below in itertools.combinations((kind for kinds, *_ in TRANSLATED for kind in kinds), 2):
        assert not issubclass(below, above), f"{below} is never reached"


# Images


def test_images_are_fetched_up_to_the_size_of_a_body(site: Site) -> None:
    with refused("image-url-not-allowed"):  # off by default
        ImageUrls(Settings()).fetch("https://images.test/1.png")
    urls = ImageUrls(Settings(max_body_mb=len(BODY) / 1e6), egress(site))
    assert urls.fetch(url(site)) == BODY
    urls = ImageUrls(Settings(max_body_mb=(len(BODY) - 1) / 1e6), egress(site))
    with refused("image-url-unreachable"):
        urls.fetch(url(site))
    with refused("image-url-not-allowed"):
        ImageUrls(Settings(allow_image_urls=("*.images.test",))).fetch("https://images.test/")
