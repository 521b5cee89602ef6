"""Where a run's page is served, from its settings: this machine alone unless an address is named, then by TLS alone."""

from __future__ import annotations

import socket
import ssl
from ipaddress import ip_address

from estimation.errors import InputError
from hardware.live.settings import LiveSettings
from hardware.operator.settings import OperatorSettings


def page_settings(settings: LiveSettings, where: object) -> OperatorSettings:
    """What the page's process is told; InputError (where) names the key that lets nobody in, or too many."""
    s = settings
    try:
        address = ip_address(s.page_address)
    except ValueError:
        raise InputError(where, "page.address", s.page_address, "an IP address of this machine, or 0.0.0.0") from None
    for name, value in (("certificate", s.page_certificate), ("key", s.page_key)):
        if value is None and (not address.is_loopback or s.page_certificate or s.page_key):
            allowed = f"a PEM file: {s.page_address} is served encrypted or not at all"
            raise InputError(where, f"page.{name}", "missing", allowed)
        if value is not None and not value.is_file():
            raise InputError(where, f"page.{name}", value, "a PEM file that exists")
    if address.is_unspecified and not s.page_names:
        allowed = "the names by which browsers call this machine, as its certificate has them"
        raise InputError(where, "page.names", "missing", allowed)
    made = OperatorSettings(
        host=s.page_address,
        port=s.page_port,
        elsewhere=not address.is_loopback,
        certificate=s.page_certificate,
        key=s.page_key,
        names=s.page_names,
    )
    _check_certificate(made, where)
    _check_free(made, where)
    return made


def _check_certificate(settings: OperatorSettings, where: object) -> None:
    if settings.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.certificate, settings.key, lambda: "")
    except (OSError, ssl.SSLError):
        allowed = f"a PEM certificate with the key in {settings.key}, which has no password"
        raise InputError(where, "page.certificate", settings.certificate, allowed) from None


def _check_free(settings: OperatorSettings, where: object) -> None:
    """That this machine has that address, and nobody listens there."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        socket.create_server((settings.host, settings.port), family=family).close()
    except OSError as error:
        value = f"{settings.host} port {settings.port}"
        raise InputError(
            where, "page.address", value, f"one that is this machine's and free ({error.strerror})"
        ) from None
