"""Where the page is served, to whom, and how much of it: checked before anything listens."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

from estimation.errors import InputError


def new_token() -> str:
    """128 random bits that an address has to hold, in letters and digits of addresses."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class OperatorSettings:
    """host: address that is listened on; port: 0 for whichever is free. token: what every request must know.

    elsewhere: serve other machines as well; then `certificate` and `key` (PEM files) are needed, and `names` are those
    by which browsers call this machine, as the certificate has them. page: which of the pages is served.
    """

    host: str = "127.0.0.1"
    port: int = 0
    token: str = field(default_factory=new_token, repr=False)
    elsewhere: bool = False
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    page: str = "index.html"

    @property
    def scheme(self) -> str:
        """Of the page's address."""
        return "http" if self.certificate is None else "https"


@dataclass(frozen=True, slots=True)
class Limits:
    """What windows may ask for. Far above what hands and screens do, far below what would be felt."""

    windows: int = 8  # at once: an operator's, a colleague's, and those that a browser has not closed yet
    message: int = 512  # bytes: the longest that the page sends takes 60
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
    if len(settings.token) < 16 or not set(settings.token) <= _ADDRESS_LETTERS:
        raise InputError(where, "token", "(not shown)", "16 or more letters, digits, - or _")
    if not loopback and not settings.elsewhere:
        raise InputError(where, "host", settings.host, "127.0.0.1 or ::1, unless other machines are allowed in")
    if not loopback and (settings.certificate is None or settings.key is None):
        raise InputError(where, "certificate", "none", "certificate and key in PEM files, to serve other machines")
    for name, file in (("certificate", settings.certificate), ("key", settings.key)):
        if file is not None and not file.is_file():
            raise InputError(file, name, "no such file", "a PEM file")
    return settings


_ADDRESS_LETTERS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_")
