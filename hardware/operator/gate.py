"""Who is let in: whoever knows the token, calls this machine by its own name, and comes from its own page."""

from __future__ import annotations

import hmac
from collections.abc import Mapping

from hardware.operator.settings import OperatorSettings

OWN = ("same-origin", "none")  # what browsers say of a request by the page itself, or by the person at the address bar


class Gate:
    """One page's gate. refused: how many requests were turned away, by reason."""

    def __init__(self, settings: OperatorSettings, port: int) -> None:
        self._token = settings.token.encode()
        self._hosts = hosts(settings, port)
        self._origins = {f"{settings.scheme}://{host}" for host in self._hosts}
        self.refused: dict[str, int] = {}

    def refusal(self, token: str, headers: Mapping[str, str], changes: bool) -> str:
        """Why a request is turned away, "" if it is let in.

        changes: whether it could ask something of the run: a web socket, or anything but GET. Host names other than our
        own come from a page that had its name point here; other origins from a page in the same browser.
        """
        reason = ""
        if headers.get("Host", "") not in self._hosts:
            reason = "host"
        elif (origin := headers.get("Origin")) not in self._origins and (changes or origin is not None):
            reason = "origin"
        elif headers.get("Sec-Fetch-Site", "none") not in OWN:
            reason = "site"
        elif not hmac.compare_digest(token.encode("utf-8", "replace"), self._token):
            reason = "token"
        if reason:
            self.refused[reason] = self.refused.get(reason, 0) + 1
        return reason


def hosts(settings: OperatorSettings, port: int) -> frozenset[str]:
    """What a browser may write as Host."""
    own = f"[{settings.host}]" if ":" in settings.host else settings.host
    names = {own, *settings.names} | (set() if settings.elsewhere else {"localhost"})
    return frozenset(f"{name}:{port}" for name in names)


def answer_headers(settings: OperatorSettings, port: int) -> dict[str, str]:
    """What every answer says: nothing from outside, no frames, nothing kept, nothing told to others."""
    sockets = " ".join(f"{settings.scheme.replace('http', 'ws')}://{host}" for host in sorted(hosts(settings, port)))
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
