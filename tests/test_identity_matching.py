# SPDX-License-Identifier: Apache-2.0
"""Test finding names of people and machines in text and bytes."""

import os

import pytest

from mjrec.evidence.identity import Identity, identity_of_user
from mjrec.evidence.identity_matching import IdentityMatcher
from mjrec.evidence.statements import state

IDENTITY = Identity(
    users={"mbrunelli", "ada", "root", "alan"},
    people={"Margherita Brunelli", "Bob Green", "An Li"},
    addresses={"mb@uni.example"},
    hosts={"brunelli-ws7", "vm"},
    homes={"/root", "/data/homes/mbrunelli"},
    directories={"/srv/gait"},
    remotes={"git@github.com:brunlab/gait.git"},
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("at /root/x.py, line 3", "at <home>/x.py, line 3"),
        ("/home/bob/x and /Users/bob", "<home>/x and <home>"),
        ("/srv/gait/runs", "<path>/runs"),
        ("/srv/gaits", "/srv/gaits"),
        ("git@github.com:brunlab/gait.git", "<path>"),
        ("by MBRUNELLI2", "by <user>2"),
        ("MbrunelliEnv", "<user>Env"),
        ("Brunelli, Margherita; margherita.brunelli", "<user>; <user>"),
        ("(c) brunelli", "(c) <user>"),
        ("<mb@uni.example>", "<<user>>"),
        ("ssh root@vm", "ssh <user>@<host>"),
        ("/scratch/ada/x, ada@node7", "/scratch/<user>/x, <user>@node7"),
        ("alan.balance AlanEnv", "<user>.balance <user>Env"),
        ("on brunelli-ws7.uni", "on <host>.uni"),
        ("An Li, italian, Li_An", "<user>, italian, <user>"),
        ("Bob Green, green", "<user>, green"),
        # `rootx` is a joint of HalfCheetah and does not name the user root.
        *((text, text) for text in ("rootx", "root", "vm", "adapt", "ada", "balance")),
        *((text, text) for text in ("vmax", "Madagascar")),
    ],
)
def test_identities_become_placeholders(text, expected):
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.replaced(text) == expected
    assert bool(matcher.found_in(text)) == (text != expected)
    assert matcher.replaced(expected) == expected


def test_file_names_stay_portable():
    """Placeholders in file names are written without brackets."""
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.replaced_in_name("0.ada-run.vm_2") == "0.user-run.host_2"
    assert matcher.replaced_in_name("0.rooty.mbrunelli") == "0.rooty.user"


def test_short_words_in_binary_data_are_ignored():
    """Only a long name or a name within a line of text is a match."""
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.found_in_bytes(b"\x00\xffAlan:/vm:\xfe\x01") == []
    assert matcher.found_in_bytes(b"Alan", by_chance=True) == []
    assert matcher.found_in_bytes(b"Alan") == ["Alan"]
    assert matcher.found_in_bytes(b"\xffmade by Alan himself\xff") == ["Alan"]
    assert matcher.found_in_bytes(b"\xffmbrunelli\xff") == ["mbrunelli"]


def test_non_ascii_names_are_found_in_bytes():
    """Names are also found if they are written with JSON escapes."""
    matcher = IdentityMatcher(Identity(users={"joséphine"}, people={"Łukasz Wąs"}))
    assert matcher.found_in_bytes(b'{"by": "Jos\\u00e9phine"}') == ["Joséphine"]
    for encoding in ("utf-8", "utf-16-le"):
        content = b"\xff\xfe\xff" + "Łukasz Wąs".encode(encoding) + b"\xff"
        assert matcher.found_in_bytes(content) == ["Łukasz Wąs"]


def test_identity_comes_from_provenance():
    remote, root = "https://git.example/lab7/gait", "/home/ada/gait"
    provenance = {
        "command": ["python", f"{root}/train.py"],
        "working_directory": root,
        "code": {"root": root, "remote": remote},
        "variables": {"LD_LIBRARY_PATH": "/home/charles/lib"},
        "policy": {"file": "/scratch/p7/policy.pt"},
    }
    identity = identity_of_user([provenance])
    assert {"ada", "charles", "lab7"} <= identity.users
    assert "/home/ada" in identity.homes
    assert {root, "/scratch/p7"} <= identity.directories
    assert remote in identity.remotes


def test_identity_comes_from_system_and_authors(tmp_path, monkeypatch):
    monkeypatch.setenv("USER", "mbrunelli")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    mit = "Margherita Brunelli (MIT) <mb@uni.example>"
    authors = [mit, "C D <0000-0002-1825-0097>"]
    stated = state(title=None, authors=authors, license=None)
    identity = identity_of_user(authors=stated.authors)
    assert "mbrunelli" in identity.users
    assert str(tmp_path) in identity.homes & identity.directories
    assert os.uname().nodename in identity.hosts
    assert "Margherita Brunelli" in identity.people
    assert {"mb@uni.example", "0000-0002-1825-0097"} <= identity.addresses
    # An affiliation such as MIT can be a word in every license.
    assert IdentityMatcher(identity).replaced("under MIT") == "under MIT"


@pytest.mark.parametrize(
    "hostile",
    [
        {"command": "x", "code": [], "variables": 3, "policy": {"file": 7}},
        {"command": [None, "\0/h"], "working_directory": "/\0", "code": {"root": 1}},
        {"code": {"root": "/\0", "remote": "::::"}, "variables": {"HOME": ["x"]}},
    ],
)
def test_malformed_provenance_raises_nothing(hostile):
    assert identity_of_user([hostile]).hosts
