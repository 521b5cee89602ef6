"""Where the page is served and to whom: settings, limits, and the check of each request.

A request is let in if it knows the token, names this machine as Host, and comes from the page itself.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

from estimation.errors import InputError

LOOPBACK = "127.0.0.1"  # nobody but this machine
OWN_SITES = ("same-origin", "none")  # Sec-Fetch-Site of a request by the page itself, or by the address bar
_TOKEN_LETTERS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_")


@dataclass(frozen=True, slots=True)
class OperatorSettings:
    """Where and to whom the page is served."""

    host: str = LOOPBACK  # address that is listened on
    port: int = 0  # 0: any that is free
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16), repr=False)  # in every request
    elsewhere: bool = False  # serve other machines as well, with certificate and key
    certificate: Path | None = None  # PEM file
    key: Path | None = None  # PEM file
    names: tuple[str, ...] = ()  # by which browsers call this machine, as the certificate has them
    page: str = "index.html"  # which of the pages is served

    @property
    def scheme(self) -> str:
        """Of the page's address."""
        return "http" if self.certificate is None else "https"


@dataclass(frozen=True, slots=True)
class WindowLimits:
    """What windows may ask for. Far above what hands and screens do, far below what would be felt."""

    windows: int = 8  # at once: an operator's, a colleague's, and those that a browser has not closed yet
    message: int = 8192  # bytes: a region of 64 corners in each of six cameras; all else takes 60
    messages: float = 40.0  # per second: the page sends one for each view shown, and one for each press
    asks: float = 5.0  # requests per second but for stops, which are never too many
    malformed: int = 20  # messages that make no sense, after which a window is closed
    patience: float = 5.0  # s that a window may take to show what it was sent, before it counts as gone
    stale: float = 1.0  # s without a newer view, after which the page says so


def check_settings(settings: OperatorSettings) -> OperatorSettings:
    """The settings themselves; InputError where they would let others in without being asked to, or unencrypted."""
    where = "operator's page"
    try:
        loopback = ip_address(settings.host).is_loopback
    except ValueError:
        raise InputError(where, "host", settings.host, "an IP address, such as 127.0.0.1") from None
    if not 0 <= settings.port <= 65535:
        raise InputError(where, "port", settings.port, "0 to 65535, 0 for whichever is free")
    if len(settings.token) < 16 or not set(settings.token) <= _TOKEN_LETTERS:
        raise InputError(where, "token", "(not shown)", "16 or more letters, digits, - or _")
    if not loopback and not settings.elsewhere:
        raise InputError(where, "host", settings.host, "127.0.0.1 or ::1, unless other machines are allowed in")
    if not loopback and (settings.certificate is None or settings.key is None):
        raise InputError(where, "certificate", "none", "certificate and key in PEM files, to serve other machines")
    for name, file in (("certificate", settings.certificate), ("key", settings.key)):
        if file is not None and not file.is_file():
            raise InputError(file, name, "no such file", "a PEM file")
    return settings


class AccessControl:
    """Checks each request. refused: how many were turned away, by reason."""

    def __init__(self, settings: OperatorSettings, port: int) -> None:
        self._token = settings.token.encode()
        self._hosts = allowed_hosts(settings, port)
        self._origins = {f"{settings.scheme}://{host}" for host in self._hosts}
        self.refused: dict[str, int] = {}

    def refusal(self, token: str, headers: Mapping[str, str], changes: bool) -> str:
        """Why a request is turned away, "" if it is let in.

        changes: whether it could ask something of the run: a web socket, or anything but GET. Another Host comes from a
        page whose name was made to point here (DNS rebinding); another Origin from a page in the same browser.
        """
        reason = ""
        if headers.get("Host", "") not in self._hosts:
            reason = "host"
        elif (origin := headers.get("Origin")) not in self._origins and (changes or origin is not None):
            reason = "origin"
        elif headers.get("Sec-Fetch-Site", "none") not in OWN_SITES:
            reason = "site"
        elif not hmac.compare_digest(token.encode("utf-8", "replace"), self._token):
            reason = "token"
        if reason:
            self.refused[reason] = self.refused.get(reason, 0) + 1
        return reason


def allowed_hosts(settings: OperatorSettings, port: int) -> frozenset[str]:
    """The values of Host that are let in."""
    own = f"[{settings.host}]" if ":" in settings.host else settings.host
    names = {own, *settings.names} | (set() if settings.elsewhere else {"localhost"})
    return frozenset(f"{name}:{port}" for name in names)


def response_headers(settings: OperatorSettings, port: int) -> dict[str, str]:
    """Headers of every response: nothing from outside, no frames, nothing cached, nothing sent to others."""
    scheme = settings.scheme.replace("http", "ws")
    sockets = " ".join(f"{scheme}://{host}" for host in sorted(allowed_hosts(settings, port)))
    policy = (
        f"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self' {sockets}; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }
