# SPDX-License-Identifier: Apache-2.0
"""What names a person or a machine, and where it is found."""

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
    ],
)
def test_what_names_somebody_is_replaced(text, expected):
    """Each kind of name has its placeholder, and is found where it is replaced."""
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.replaced(text) == expected
    assert bool(matcher.found_in(text)) == (text != expected)
    assert matcher.replaced(expected) == expected


@pytest.mark.parametrize(
    "text", ["rootx", "root", "vm", "adapt", "ada", "balance", "vmax", "Madagascar"]
)
def test_short_and_ordinary_names_stay_inside_other_words(text):
    """HalfCheetah's joint `rootx` is no account of anybody's."""
    assert IdentityMatcher(IDENTITY).replaced(text) == text


def test_names_of_files_stay_portable():
    """A short login counts as a part of a name, and no bracket gets into it."""
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.replaced_in_name("0.ada-run.vm_2") == "0.user-run.host_2"
    assert matcher.replaced_in_name("0.rooty.mbrunelli") == "0.rooty.user"


def test_few_letters_amid_numbers_are_chance():
    """Four letters in compressed bytes are nobody's name; a line of text is one."""
    matcher = IdentityMatcher(IDENTITY)
    assert matcher.found_in_bytes(b"\x00\xffAlan:/vm:\xfe\x01") == []
    assert matcher.found_in_bytes(b"Alan", by_chance=True) == []
    assert matcher.found_in_bytes(b"Alan") == ["Alan"]
    assert matcher.found_in_bytes(b"\xffmade by Alan himself\xff") == ["Alan"]
    assert matcher.found_in_bytes(b"\xffmbrunelli\xff") == ["mbrunelli"]


def test_names_of_other_alphabets_are_found_amid_bytes():
    """As JSON escapes them, and where neither encoding can be read as a whole."""
    matcher = IdentityMatcher(Identity(users={"joséphine"}, people={"Łukasz Wąs"}))
    assert matcher.found_in_bytes(b'{"by": "Jos\\u00e9phine"}') == ["Joséphine"]
    for encoding in ("utf-8", "utf-16-le"):
        content = b"\xff\xfe\xff" + "Łukasz Wąs".encode(encoding) + b"\xff"
        assert matcher.found_in_bytes(content) == ["Łukasz Wąs"]


def test_who_recorded_is_known_from_the_recording():
    """On another machine, paths, the repository and variables tell it."""
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


def test_who_packs_is_known_from_the_system(tmp_path, monkeypatch):
    """Variables, the machine's name, the working directory, and the authors given."""
    monkeypatch.setenv("USER", "mbrunelli")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    said = ["Margherita Brunelli (MIT) <mb@uni.example>", "C D <0000-0002-1825-0097>"]
    stated = state(title=None, authors=said, license=None)
    identity = identity_of_user(authors=stated.authors)
    assert "mbrunelli" in identity.users
    assert str(tmp_path) in identity.homes & identity.directories
    assert os.uname().nodename in identity.hosts
    assert "Margherita Brunelli" in identity.people
    assert {"mb@uni.example", "0000-0002-1825-0097"} <= identity.addresses
    # Of an affiliation that is a licence, too.
    assert IdentityMatcher(identity).replaced("under MIT") == "under MIT"


@pytest.mark.parametrize(
    "hostile",
    [
        {"command": "x", "code": [], "variables": 3, "policy": {"file": 7}},
        {
            "command": [None, "\0/home/a"],
            "working_directory": "/\0",
            "code": {"root": 1},
        },
        {"code": {"root": "/\0", "remote": "::::"}, "variables": {"HOME": ["x"]}},
    ],
)
def test_provenance_may_say_anything(hostile):
    """What a file says of its provenance raises nothing."""
    assert identity_of_user([hostile]).hosts
