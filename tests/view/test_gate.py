"""Who may open the page of the viewer."""

from __future__ import annotations

import pytest

from mivol.cli import main
from mivol.errors import MivolError
from mivol.view import page
from mivol.view.gate import cookie_name, find_fault

PORT, TOKEN = 8080, "a-token"
OWN = {"Host": "127.0.0.1:8080"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/?token=a-token", OWN),
        ("/?token=a-token", {"Host": "localhost:8080"}),
        ("/", OWN | {"Cookie": f"other=1; {cookie_name(PORT)}=a-token"}),
        ("/", OWN | {"Cookie": f"{cookie_name(PORT)}=a-token", "Origin": "http://127.0.0.1:8080"}),
    ],
)
def test_requests_with_the_token_pass(path: str, headers: dict[str, str]) -> None:
    assert find_fault(path, headers, TOKEN, PORT) == ""


@pytest.mark.parametrize(
    ("path", "headers", "word"),
    [
        ("/", OWN, "token"),
        ("/?token=", OWN, "token"),
        ("/?token=a-tokem", OWN, "token"),
        ("/", OWN | {"Cookie": f"{cookie_name(8081)}=a-token"}, "token"),
        ("/?token=a-token", {"Host": "evil.example:8080"}, "host"),
        ("/?token=a-token", {"Host": "127.0.0.1:8081"}, "host"),
        ("/?token=a-token", {}, "host"),
        ("/?token=a-token", OWN | {"Origin": "http://evil.example"}, "another page"),
        ("/?token=a-token", OWN | {"Origin": "null"}, "another page"),
    ],
)
def test_other_requests_are_turned_away(path: str, headers: dict[str, str], word: str) -> None:
    assert word in find_fault(path, headers, TOKEN, PORT)


def test_viser_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the path is looked at: the wheel alone names its extra."""
    monkeypatch.setattr(page.importlib.util, "find_spec", lambda name: None)
    assert main(["view", "nothing"]) == 1
    assert 'pip install "mivol[viewer]"' in capsys.readouterr().err


@pytest.mark.parametrize("port", [0, 70_000])
def test_ports_that_no_server_has_are_refused(port: int) -> None:
    with pytest.raises(MivolError, match="expected 1 to 65535"):
        page.start_server(port, TOKEN)
