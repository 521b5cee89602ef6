"""The page for other machines: by TLS alone, under the names that are told, refused in one line where it cannot be."""

from __future__ import annotations

import asyncio
import socket
import ssl
from dataclasses import replace
from pathlib import Path

import aiohttp
import pytest
import trustme

from estimation.errors import InputError
from hardware.cli.main import main
from hardware.live.page_address import page_settings
from hardware.live.settings import LiveSettings, names_given, read_settings, settings_text
from hardware.operator.link import OperatorLink
from hardware.operator.process import OperatorPage
from tests.light_live import prepare_files

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


def test_other_machines_are_served_encrypted_under_the_name_that_is_told_alone(
    elsewhere: LiveSettings, authority: trustme.CA
) -> None:
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
        assert asyncio.run(ask("https", NAME)) == 200
        assert asyncio.run(ask("https", "localhost")) == 403
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
def test_what_would_let_others_in_unencrypted_or_cannot_be_served_is_one_error(
    change: dict[str, object], words: str, elsewhere: LiveSettings
) -> None:
    with pytest.raises(InputError) as refused:
        page_settings(replace(elsewhere, **change), "here")  # type: ignore[arg-type]
    assert words in str(refused.value)


def test_a_key_of_another_certificate_and_a_port_that_is_taken_are_refused(
    elsewhere: LiveSettings, authority: trustme.CA, tmp_path: Path
) -> None:
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
    assert len(said) == 2 and "page.certificate = 'missing'" in said[0] and "--page-name" in said[1]
    assert not (tmp_path / "x.mcap").exists()


def test_the_file_says_the_same_as_the_flags(elsewhere: LiveSettings, tmp_path: Path) -> None:
    file = tmp_path / "session.toml"
    file.write_text(settings_text(replace(elsewhere, page_port=8443)))
    assert read_settings(file) == replace(elsewhere, page_port=8443)
    for names in ([""], ["a..b"], ["a/b"], "printer", [3]):
        with pytest.raises(InputError, match="names"):
            names_given("here", "page.names", names)
