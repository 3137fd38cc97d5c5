"""Where a server listens, and which pages of the web may talk to it.

A browser lets every page send requests to every address, also to servers of the same machine. It lets no page lie about
itself: ``Host`` is the name that was opened, ``Origin`` the site of the page that asks.
"""

import errno
import ipaddress
import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

_EVERYWHERE = ("", "0.0.0.0", "::")
_LOOPBACK = frozenset(("localhost", "127.0.0.1", "::1"))
_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_-]+(?:\.[a-z0-9_-]+)*)(?::([0-9]{1,5}))?", re.ASCII)
"""A name and perhaps a port: no user, no path, no dot at the end."""
_PORTS = {"http": 80, "https": 443}


def bare(host: str) -> str:
    """Return a host without the brackets of IPv6.

    >>> bare("[::1]")
    '::1'
    """
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def address(host: str, port: int) -> str:
    """Return host and port as addresses of the web have them, IPv6 in brackets.

    >>> address("::1", 8080)
    '[::1]:8080'
    """
    return f"[{bare(host)}]:{port}" if ":" in bare(host) else f"{host}:{port}"


def opened_at(host: str, port: int) -> str:
    """Return what people can open: the name of this machine for a server that listens on all of its addresses."""
    return address(socket.gethostname() if bare(host) in _EVERYWHERE else host, port)


def check_address(host: str, port: int) -> None:
    """Raise OSError, which says why, where nobody can listen. Port 0 is any free one."""
    remedy = "host= is a name or an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all"
    try:
        found = socket.getaddrinfo(bare(host) or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (socket.gaierror, UnicodeError) as error:
        raise OSError(f"the host {host!r} is unknown: {remedy}") from error
    failures = [_failure(*one) for one in found]
    if all(failures):
        said = {
            errno.EADDRINUSE: "another server may, choose another port=",
            errno.EACCES: "ports below 1024 need the rights of root, choose another port=",
        }.get(failures[0] or 0, f"this machine has no such address, {remedy}")
        raise OSError(f"nobody can listen on {address(host, port) if port else host}: {said}")


def _failure(family: int, kind: int, protocol: int, name: str, place: Any) -> int | None:
    """The number of the error of listening there, if any."""
    try:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except OSError as error:
        return error.errno or errno.EINVAL
    return None


@dataclass(frozen=True)
class Callers:
    """The names by which a server may be called; all other requests are those of foreign pages."""

    names: frozenset[str]
    proxied: frozenset[str] = frozenset()
    """Those that a user named, perhaps of a proxy: their pages may have come over TLS."""

    @classmethod
    def of(cls, host: str, known_as: Iterable[str] = ()) -> "Callers":
        """Return those of a server that listens at ``host``; ``known_as``: further names or addresses of it.

        Raises ValueError for a name that is none.
        """
        proxied = frozenset(_name(one) for one in known_as)
        own = {socket.gethostname(), socket.getfqdn()} if bare(host) in _EVERYWHERE else set()
        return cls(_LOOPBACK | proxied | {_plain(one) for one in (host, *own)}, proxied)

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], local: str) -> str | None:
        """Return why a request is not answered; None: it is.

        A program that is no browser sends no ``Origin`` and may: it could send any. A page cannot leave it out.
        The port of ``Host`` is free, since tunnels have others; that of ``Origin`` has to be the same.

        Args:
            hosts: the values of the request's ``Host`` headers.
            origins: those of ``Origin``.
            local: this machine's address at which the request came in.
        """
        local = _plain(local.partition("%")[0])
        host = _parsed(hosts[0], 80) if len(hosts) == 1 else None
        if host is None or host[0] not in self.names | {local}:
            return f"the Host {', '.join(hosts)[:100]!r} is no name of this server: known_as=NAME lets one in"
        if not origins:
            return None
        scheme, _, authority = origins[0].lower().partition("://")
        origin = _parsed(authority, _PORTS.get(scheme, 0)) if len(origins) == 1 and scheme in _PORTS else None
        if scheme == "https":
            hidden = _parsed(hosts[0], 443)  # TLS ended at a proxy
            return None if origin is not None and origin == hidden and host[0] in self.proxied else _foreign(origins)
        # By its name and by its address, a loopback is the same server.
        same = origin is not None and (origin[0] == host[0] or {origin[0], host[0]} <= {"localhost", local} & _LOOPBACK)
        return None if origin is not None and same and origin[1] == host[1] else _foreign(origins)


def _foreign(origins: Sequence[str]) -> str:
    return f"pages of {', '.join(origins)[:100]!r} are foreign to this server: open its own address"


def _parsed(authority: str, default: int) -> tuple[str, int] | None:
    """Name and port; None where it is not of that form."""
    found = _AUTHORITY.fullmatch(authority.lower())
    return None if found is None else (_plain(found[1]), int(found[2] or default))


def _plain(name: str) -> str:
    """One spelling of each name and address."""
    try:
        return str(ipaddress.ip_address(bare(name)))
    except ValueError:
        return name.lower()


def _name(said: str) -> str:
    found = _plain(said)
    if _AUTHORITY.fullmatch(f"[{found}]" if ":" in found else found) is None:
        raise ValueError(f"known_as has names or addresses of this server, without http:// and port, got {said!r}")
    return found
