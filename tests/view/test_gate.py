"""Who may open the page of the viewer."""

from __future__ import annotations

import pytest

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
