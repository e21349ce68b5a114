"""Hosts: how a name is written, which addresses are public, and which may be asked. Nothing is looked up here."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Network, ip_address

import httpx

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
    """The host of a URL, lower case and IDNA, as name servers and certificates know it. None where it is no host.

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
    that one, or `*` for every host. Raises `ValueError` for an entry that is none of these.
    """

    def __init__(self, entries: Iterable[str]) -> None:
        self._entries = tuple(_entry(each) for each in entries)

    def has(self, host: str, port: int) -> bool:
        """Whether a host, as `host_name` gives it, may be asked at this port."""
        return any(entry.fits(host, port) for entry in self._entries)


@dataclass(frozen=True)
class _Entry:
    """One entry of the list."""

    name: str  # empty for every host
    below: bool  # the names below it, and not itself
    ports: frozenset[int]

    def fits(self, host: str, port: int) -> bool:
        named = not self.name or (host.endswith(f".{self.name}") if self.below else host == self.name)
        return named and port in self.ports


def _entry(text: str) -> _Entry:
    wrong = ValueError(f"{text!r} is none of: a host name, name:port, *.name, *")
    try:
        url = httpx.URL(f"any://{text}")  # a scheme without a port of its own, so that every port written is seen
    except httpx.InvalidURL as error:
        raise wrong from error
    raw = url.raw_host.decode("ascii")
    name = "" if raw == "*" else host_name(raw.removeprefix("*."))
    if name is None or set(text) & set("/?#@") or not 0 < (80 if url.port is None else url.port) < 65536:
        raise wrong
    return _Entry(name, raw.startswith("*."), WEB_PORTS if url.port is None else frozenset((url.port,)))
