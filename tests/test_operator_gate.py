"""Who is let in to the operator's page and what is served; other machines by TLS alone, under given names."""

from __future__ import annotations

import asyncio
import re
import select
import socket
import ssl
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import aiohttp
import pytest
import trustme

from estimation.errors import InputError
from hardware.cli.main import main
from hardware.live.settings import LiveSettings, page_settings, parse_host_names, read_settings, settings_text
from hardware.operator.process import OperatorPage
from hardware.operator.server import page_files
from hardware.operator.settings import AccessControl, OperatorSettings, check_settings
from hardware.operator.shared_state import OperatorLink
from hardware.operator.view import Wish
from tests.operator_page import Served, served
from tests.pictureless_run import prepare_files

TOKEN = "a-token-of-sixteen-letters"
SETTINGS = OperatorSettings(token=TOKEN)
OWN = {"Host": "127.0.0.1:81", "Origin": "http://127.0.0.1:81", "Sec-Fetch-Site": "same-origin"}


@pytest.fixture(scope="module")
def page() -> Iterator[Served]:
    with served() as made:
        yield made


def get(url: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], str]:
    async def ask() -> tuple[int, dict[str, str], str]:
        async with aiohttp.ClientSession() as session, session.request(method, url, headers=headers) as answer:
            return answer.status, dict(answer.headers), await answer.text()

    return asyncio.run(ask())


@pytest.mark.parametrize(
    ("reason", "changed", "token"),
    [
        ("token", {}, TOKEN[:-1] + "t"), ("token", {}, ""), ("token", {}, "schlüssel\udce4"),
        ("host", {"Host": "evil.example:81"}, TOKEN), ("host", {"Host": "127.0.0.1:82"}, TOKEN),
        ("host", {"Host": "127.0.0.1"}, TOKEN), ("origin", {"Origin": "http://evil.example"}, TOKEN),
        ("origin", {"Origin": "http://127.0.0.1:9000"}, TOKEN), ("origin", {"Origin": "null"}, TOKEN),
        ("site", {"Sec-Fetch-Site": "cross-site"}, TOKEN), ("site", {"Sec-Fetch-Site": "same-site"}, TOKEN),
    ],
)  # fmt: skip
def test_each_thing_that_is_wrong_is_refused_alone(reason: str, changed: dict[str, str], token: str) -> None:
    gate = AccessControl(SETTINGS, 81)
    assert gate.refusal(TOKEN, OWN, True) == "" and gate.refusal(token, OWN | changed, True) == reason
    assert gate.refused == {reason: 1}


def test_what_could_change_something_needs_an_origin_and_what_only_looks_does_not() -> None:
    gate = AccessControl(SETTINGS, 81)
    bare = {"Host": "localhost:81"}
    assert gate.refusal(TOKEN, bare, False) == "" and gate.refusal(TOKEN, bare, True) == "origin"


def test_the_page_and_all_its_files_come_with_the_token_and_forbid_all_that_is_outside(page: Served) -> None:
    names = page_files()
    assert {"index.html", "page.css", "page.js", "icon.svg"} <= names.keys()
    for name in ("", *names):
        status, headers, text = get(page.address + name)
        assert status == 200 and text
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
        assert "unsafe" not in policy and "*" not in policy and "frame-ancestors 'none'" in policy
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
        assert headers["Cache-Control"] == "no-store" and headers["Server"] == "stillbed"


def test_no_file_of_the_page_names_anything_outside() -> None:
    for name, data in page_files().items():
        outside = re.sub(r"http://www\.w3\.org/2000/svg", "", data.decode())
        assert not re.search(r"(?:https?|wss?):?//|@import|url\(", outside), name


@pytest.mark.parametrize("name", ["", "page.js", "socket", "stop", "nothing"])
def test_without_the_token_nothing_is_there(page: Served, name: str) -> None:
    base = f"http://{page.host}/"
    for address in (base, f"{base}{page.settings.token[:-1]}/{name}", f"{base}%00/{name}"):
        assert get(address)[0] == 403


@pytest.mark.parametrize("name", ["nothing", "..%2f..%2fetc%2fpasswd", "../gate.py", "%2e%2e/gate.py", "page.js/x"])
def test_nothing_but_the_pages_files_is_served(page: Served, name: str) -> None:
    assert get(page.address + name)[0] in (403, 404)


RAW = {
    "no words": b"\x00\xff" * 200,
    "long": b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n",
    "length": b"POST /x/stop HTTP/1.1\r\nHost: x\r\nContent-Length: -3\r\n\r\n",
    "large": b"POST /x/stop HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n",
    "address": b"GET http://[::1/ HTTP/1.1\r\nHost: x\r\n\r\n",
    "star": b"OPTIONS * HTTP/1.1\r\nHost: x\r\n\r\n",
    "connect": b"CONNECT a:80 HTTP/1.1\r\nHost: x\r\n\r\n",
    "two slashes": b"GET //x/ HTTP/1.1\r\nHost: x\r\n\r\n",
}


@pytest.mark.parametrize("what", RAW)
def test_what_is_no_request_is_refused_and_harms_nobody(page: Served, what: str) -> None:
    with socket.create_connection(("127.0.0.1", page.listener.getsockname()[1]), timeout=10) as raw:
        raw.sendall(RAW[what])
        assert raw.recv(12)[-3:] in (b"400", b"403")
    assert get(page.address)[0] == 200


def test_connections_that_say_nothing_do_not_keep_others_out(page: Served) -> None:
    place = ("127.0.0.1", page.listener.getsockname()[1])
    idle = [socket.create_connection(place, timeout=10) for _ in range(200)]
    closed, end, poll = 0, time.monotonic() + 20, select.poll()  # select knows files below 1024 alone
    for each in idle:
        poll.register(each, select.POLLIN)
    while closed < 200 - 40 and time.monotonic() < end:
        closed = len(poll.poll(0))
        time.sleep(0.05)
    assert 200 - 40 <= closed < 200
    assert get(page.address)[0] == 200
    for each in idle:
        each.close()


def test_a_stop_without_a_socket_is_taken_from_the_own_page_alone(page: Served) -> None:
    before = page.link.requests.last_stop
    assert get(page.address + "stop", "POST")[0] == 403
    assert get(page.address + "stop", "POST", Origin="http://evil.example")[0] == 403
    assert get(page.address + "stop", "GET", Origin=f"http://{page.host}")[0] == 404
    assert page.link.requests.last_stop == before
    assert get(page.address + "stop", "POST", Origin=f"http://{page.host}")[0] == 200
    assert [request.wish for request in page.taken()] == [Wish.STOP]


def test_a_page_of_another_origin_gets_no_socket(page: Served) -> None:
    async def connect(**headers: str) -> None:
        async with aiohttp.ClientSession() as session, session.ws_connect(page.address + "socket", headers=headers):
            pass

    for origin in ("http://evil.example", "http://127.0.0.1:9000"):
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            asyncio.run(connect(Origin=origin))
    with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
        asyncio.run(connect())
    with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
        asyncio.run(connect(Origin=f"http://{page.host}", Host="evil.example"))
    asyncio.run(connect(Origin=f"http://{page.host}"))


@pytest.mark.parametrize(
    ("what", "settings"),
    [
        ("host", OperatorSettings(host="0.0.0.0")),
        ("host", OperatorSettings(host="192.168.1.7")),
        ("host", OperatorSettings(host="somewhere")),
        ("certificate", OperatorSettings(host="0.0.0.0", elsewhere=True)),
        ("certificate", OperatorSettings(host="::", elsewhere=True)),
        ("certificate", OperatorSettings(elsewhere=True, certificate=Path("/nowhere.pem"), key=Path("/nowhere.key"))),
        ("token", OperatorSettings(token="short")),
        ("token", OperatorSettings(token="sixteen letters/and more")),
        ("port", OperatorSettings(port=70_000)),
    ],
)
def test_settings_that_would_let_others_in_are_refused(what: str, settings: OperatorSettings) -> None:
    with pytest.raises(InputError, match=what):
        check_settings(settings)


def test_tokens_differ_and_do_not_show_in_logs() -> None:
    tokens = {OperatorSettings().token for _ in range(100)}
    assert len(tokens) == 100 and all(len(token) >= 22 for token in tokens)
    assert TOKEN not in repr(SETTINGS)


NAME = "printer.local"


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture(scope="module")
def elsewhere(authority: trustme.CA, tmp_path_factory: pytest.TempPathFactory) -> LiveSettings:
    """Settings that serve every address of this machine, with a certificate of its name."""
    folder, made = tmp_path_factory.mktemp("tls"), authority.issue_cert(NAME)
    made.cert_chain_pems[0].write_to_path(folder / "page.pem")
    made.private_key_pem.write_to_path(folder / "page.key")
    files = {"page_certificate": folder / "page.pem", "page_key": folder / "page.key"}
    return LiveSettings(page_address="0.0.0.0", page_names=(NAME,), **files)


def test_by_default_nobody_but_this_machine_is_let_in() -> None:
    made = page_settings(LiveSettings(), "here")
    assert (made.host, made.port, made.elsewhere, made.scheme) == ("127.0.0.1", 0, False, "http")


def test_other_machines_are_served_encrypted_by_name(elsewhere: LiveSettings, authority: trustme.CA) -> None:
    settings = page_settings(elsewhere, "here")
    page = OperatorPage(OperatorLink(), settings)
    page.tend(0.0)
    port = int(page.address.split(":")[2].split("/")[0])
    trusted = ssl.create_default_context()
    authority.configure_trust(trusted)

    async def ask(scheme: str, name: str) -> int:
        url, headers = f"{scheme}://127.0.0.1:{port}/{settings.token}/", {"Host": f"{name}:{port}"}
        async with (
            aiohttp.ClientSession() as session,
            session.get(url, headers=headers, ssl=trusted, server_hostname=NAME) as answer,
        ):
            return answer.status

    try:
        assert page.address == f"https://{NAME}:{port}/{settings.token}/"
        assert asyncio.run(ask("https", NAME)) == 200 and asyncio.run(ask("https", "localhost")) == 403
        with pytest.raises(aiohttp.ClientError):
            asyncio.run(ask("http", NAME))
    finally:
        page.close()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"page_certificate": None}, "page.certificate = 'missing', allowed a PEM file: 0.0.0.0 is served encrypted"),
        ({"page_key": None}, "page.key = 'missing'"),
        ({"page_key": None, "page_address": "127.0.0.1"}, "page.key = 'missing'"),
        ({"page_certificate": None, "page_key": None}, "page.certificate = 'missing'"),
        ({"page_certificate": Path("/nowhere.pem")}, "allowed a PEM file that exists"),
        ({"page_certificate": Path(__file__)}, "allowed a PEM certificate with the key in"),
        ({"page_names": ()}, "page.names = 'missing'"),
        ({"page_address": "printer"}, "page.address = 'printer', allowed an IP address"),
        ({"page_address": "198.51.100.7"}, "page.address = '198.51.100.7 port 0', allowed one that is this machine's"),
    ],
)
def test_what_cannot_be_served_is_one_error(change: dict[str, object], words: str, elsewhere: LiveSettings) -> None:
    with pytest.raises(InputError) as refused:
        page_settings(replace(elsewhere, **change), "here")
    assert words in str(refused.value)


def test_a_wrong_key_or_taken_port_is_refused(elsewhere: LiveSettings, authority: trustme.CA, tmp_path: Path) -> None:
    other = tmp_path / "other.key"
    authority.issue_cert(NAME).private_key_pem.write_to_path(other)
    with pytest.raises(InputError, match=r"page\.certificate"):
        page_settings(replace(elsewhere, page_key=other), "here")
    with socket.create_server(("0.0.0.0", 0)) as taken, pytest.raises(InputError, match=r"page\.address .* free"):
        page_settings(replace(elsewhere, page_port=taken.getsockname()[1]), "here")


def test_the_command_refuses_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prepare_files(tmp_path)
    given = [part for name in ("rig", "path") for part in (f"--{name}", str(next(tmp_path.glob(f"{name}.*"))))]
    run = ["live", *given, "--arm", "virtual", "--record", str(tmp_path / "x.mcap")]
    assert main([*run, "--page-address", "0.0.0.0"]) == 2
    assert main([*run, "--page-address", "0.0.0.0", "--page-name", "not a name"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and "--page-cert = 'missing'" in said[0] and "--page-name" in said[1]
    assert not (tmp_path / "x.mcap").exists()


def test_the_file_says_the_same_as_the_flags(elsewhere: LiveSettings, tmp_path: Path) -> None:
    file = tmp_path / "session.toml"
    file.write_text(settings_text(replace(elsewhere, page_port=8443)))
    assert read_settings(file) == replace(elsewhere, page_port=8443)
    for names in ([""], ["a..b"], ["a/b"], "printer", [3]):
        with pytest.raises(InputError, match="names"):
            parse_host_names("here", "page.names", names)
