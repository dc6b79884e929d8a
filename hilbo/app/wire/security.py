"""Access to the server: one-time links, keys for each role, and the hosts and origins that requests may come from.

A link ends in `#token`, which browsers do not send: the page that it opens trades the token, once, for the role's key,
which pages store and every request carries in Authorization. A browser never sends it by itself, as it would a cookie,
which goes to all ports of a host. Keys outlive the server, as digests in a file beside the log that only its owner may
read, so that pages find their session again after a restart; unused tokens do not. A used link opens nothing new: its
own browser finds its page by it, and a program that presents, once it is gone, is taken back by the link that let it in
(`Gate.let_in`).

Host and Origin of every request are compared with the addresses that the server was started for: a page of another site
that reaches this computer by its own name (DNS rebinding) or by a form is refused, whatever key it has.
"""

import contextlib
import hashlib
import hmac
import itertools
import json
import re
import secrets
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal, get_args

from hilbo.errors import InputError
from hilbo.study.disk.new_file import write_file
from hilbo.study.formats.parsing import UNREADABLE

__all__ = ["PAGES", "Gate", "Role", "lan_addresses"]

Role = Literal["stimulus", "preparer", "participant", "experimenter"]
"""Who is in a session, the one who is heard first last. The stimulus is a program that presents renderings, the
preparer a person who does; a session has one of them at most."""
PAGES: tuple[Role, ...] = ("preparer", "participant", "experimenter")
"""The roles that have a page in a browser; the other is a program."""
_BYTES = 24
_LENGTH = 32  # characters of a key: base64 of _BYTES
_DIGEST = re.compile("[0-9a-f]{64}")
_KEYS = 4  # keys per request, so that a request cannot test thousands
_SHOWN = re.compile(rf"earer {{1,8}}([\w-]{{{_LENGTH}}})(?![\w-])".encode())


class Gate:
    """Tokens, keys and addresses of one server. `hosts`: its addresses, "host:port"; `keys`: the file that stores
    digests of the keys between starts, None for a server that stores none."""

    def __init__(self, hosts: Iterable[str], keys: Path | None = None):
        self.hosts = frozenset(host.lower() for host in hosts)
        self.origins = frozenset(f"http://{host}" for host in self.hosts)
        self._tokens: dict[str, Role] = {}
        self.keep_in(keys)

    def keep_in(self, keys: Path | None) -> None:
        """Replace the keys by those stored in this file (None: by none), and store new ones there from now on: which
        session it is may be known only once the server has its port."""
        self._file = keys
        self._keys: dict[Role, str] = _kept(keys, "keys")
        self._links: dict[Role, str] = _kept(keys, "links")  # role -> the token for which its key was given

    def invite(self, role: Role) -> str:
        """A new token for a role, good for one use; earlier unused ones of the role are void."""
        self._tokens = {digest: other for digest, other in self._tokens.items() if other != role}
        token = secrets.token_urlsafe(_BYTES)
        self._tokens[_digest(token)] = role
        return token

    def asked_for(self, token: str) -> Role | None:
        """The role of an unused token; None if it is unknown, used or void."""
        return self._tokens.get(_digest(token))

    def let_in(self, token: str) -> Role | None:
        """The role whose present key was given for this token; None if there is none."""
        digest = _digest(token)
        return next((role for role, used in self._links.items() if hmac.compare_digest(used, digest)), None)

    def redeem(self, token: str, again: bool = False) -> tuple[Role, str] | None:
        """Use a token up: its role and a new key for it, None if it is unknown or used. `again`: a used token is
        accepted too, if the role's present key was given for it.

        The new key replaces the role's old one, so that a participant's second browser ends the first. Raises
        `InputError` if it cannot be stored; token and old key stay valid then.
        """
        role = self.asked_for(token) or (self.let_in(token) if again else None)
        if role is None:
            return None
        key = secrets.token_urlsafe(_BYTES)
        keys: dict[Role, str] = {**self._keys, role: _digest(key)}
        links: dict[Role, str] = {**self._links, role: _digest(token)}
        self._keep({"keys": keys, "links": links})
        self._keys, self._links = keys, links
        self._tokens.pop(_digest(token), None)
        return role, key

    def admits(self, role: Role, key: str | None) -> bool:
        """Whether this is the role's present key."""
        known = self._keys.get(role)
        return known is not None and key is not None and hmac.compare_digest(known, _digest(key))

    def role_in(self, data: bytes) -> Role | None:
        """The role whose key is in some bytes of a connection, before they are read as HTTP; of several the
        experimenter's first. None without a key; at most `_KEYS` are looked at."""
        keys = [match[1].decode() for match in itertools.islice(_SHOWN.finditer(data), _KEYS)]
        return next((role for role in reversed(get_args(Role)) for key in keys if self.admits(role, key)), None)

    def refuses(self, headers: Mapping[str, str]) -> str | None:
        """Why a request with these headers is refused (wrong Host, or another site's Origin), as a sentence; None if it
        is not."""
        if headers.get("host", "").lower() not in self.hosts:
            return "This address is not the one that the session was started for; use the link that it gave."
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in self.origins:
            return "The request comes from a page of another site."
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "The request comes from a page of another site."
        return None

    def _keep(self, digests: Mapping[str, Mapping[Role, str]]) -> None:
        """Write the digests of keys and of links to the file, if there is one. Raises `InputError` if it cannot be
        written."""
        if self._file is None:
            return
        try:
            write_file(self._file, json.dumps(digests), replace=True)
        except OSError as error:
            raise InputError(f"{self._file}: cannot be written ({error.strerror}); make room for it.") from error


def _digest(text: str) -> str:
    """SHA-256 of a text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def _kept(file: Path | None, what: str) -> dict[Role, str]:
    """Role -> digest of its key (`what` is "keys") or link ("links") in a file; empty without a file, or if it is
    missing or damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8")) if file else {}
    except (OSError, *UNREADABLE):
        return {}
    digests = content.get(what) if isinstance(content, dict) else None
    if not isinstance(digests, dict):
        return {}
    return {role: digests[role] for role in get_args(Role) if _DIGEST.fullmatch(str(digests.get(role)))}


def lan_addresses() -> list[str]:
    """IPv4 addresses of this computer in its networks, the one towards other networks first; without 127.*, and no
    packet is sent."""
    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # reserved for documentation
        addresses.append(probe.getsockname()[0])
    with contextlib.suppress(OSError):
        addresses += [info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    return [str(address) for address in dict.fromkeys(addresses) if not str(address).startswith("127.")]
