"""Who may open the dashboard's page: people, by a token of their own, and whoever may read the local address.

Rules.
1. A token is 192 random bits, and is shown once. Only its SHA-256 is kept: so many bits cannot be guessed from a fast
   hash either.
2. The file of tokens is looked at with every request, so one that is revoked opens nothing from then on.
3. A person has a role: `command`, or `look`, which may look and stop the arm.
"""

import fcntl
import hashlib
import hmac
import json
import logging
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from armctl.config import NAME_PATTERN
from armctl.errors import ConfigError

Role = Literal["look", "command"]
TOKEN_BYTES = 24
# Who came by the local address.
LOCAL = "local"
# The group of the service, whose dashboard reads the file.
GROUP = "armctl"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Person:
    """Who has a token, what it opens, and since when."""

    name: str
    role: Role
    created: str = ""
    sha256: str = ""

    def listed(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if key != "sha256"}


_PEOPLE = TypeAdapter(list[Person])


class Tokens:
    """What opens the page now.

    Args:
        path: The file of people's tokens; it may be missing.
        local: The token in the address that was printed.
    """

    def __init__(self, path: Path | None, local: str) -> None:
        self._path, self._local = path, local.encode()
        self._seen: tuple[int, int] | None = None
        self._people: dict[str, Person] = {}

    def who(self, said: object) -> Person | None:
        """Who says this token; None: nobody."""
        if not isinstance(said, str):
            return None
        token = said.encode(errors="replace")
        if hmac.compare_digest(token, self._local):
            return Person(LOCAL, "command")
        self._look()
        return self._people.get(hashlib.sha256(token).hexdigest())

    def _look(self) -> None:
        about = self._path.stat() if self._path is not None and self._path.exists() else None
        seen = about and (about.st_mtime_ns, about.st_ino)
        if seen != self._seen:
            self._seen, self._people = seen, {}
            try:
                self._people = {one.sha256: one for one in people(self._path)} if self._path else {}
            except ConfigError as error:  # nobody's token opens the page until it is mended
                logger.error("%s", error)


def people(path: Path) -> list[Person]:
    """Who has a token, by name.

    Raises:
        ConfigError: the file cannot be read, or is none of tokens.
    """
    try:
        return sorted(_PEOPLE.validate_json(path.read_bytes()), key=lambda one: one.name)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror}", "run it with sudo") from None
    except ValidationError:
        raise ConfigError(str(path), "", "is no file of tokens", "remove it, and add the tokens again") from None


def add(path: Path, name: str, role: Role) -> tuple[Person, str]:
    """A new person, and the token, which is kept nowhere.

    Raises:
        ConfigError: the name is taken or none, or the file cannot be read or written.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError("armctl web token", "NAME", f"{name[:80]!r} is no name", "letters, digits, '.', '_', '-'")
    token = secrets.token_urlsafe(TOKEN_BYTES)
    hashed = hashlib.sha256(token.encode()).hexdigest()
    person = Person(name, role, datetime.now(UTC).isoformat(timespec="seconds"), hashed)
    with _changing(path) as known:
        if name in (LOCAL, *(one.name for one in known)):
            remedy = "revoke it first, or choose another name"
            raise ConfigError("armctl web token", "NAME", f"{name} has a token", remedy)
        known.append(person)
    return person, token


def revoke(path: Path, name: str) -> Person:
    """Take a person's token away.

    Raises:
        ConfigError: nobody of that name has one, or the file cannot be read or written.
    """
    with _changing(path) as known:
        if found := next((one for one in known if one.name == name), None):
            known.remove(found)
            return found
        names = ", ".join(one.name for one in known) or "nobody"
        raise ConfigError("armctl web token", "NAME", f"{name[:80]} has no token", f"who has one: {names}")


@contextmanager
def _changing(path: Path) -> Iterator[list[Person]]:
    """Who has a token, to be changed and then kept; whoever else changes it waits."""
    partial = path.with_name(f"{path.name}.part")
    with ExitStack() as held:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            held.callback(os.close, folder := os.open(path.parent, os.O_RDONLY))
            fcntl.flock(folder, fcntl.LOCK_EX)
            yield (found := people(path))
            private(partial, json.dumps([asdict(one) for one in found], indent=1) + "\n")
            if os.getuid() == 0:
                with suppress(LookupError):  # no service here
                    shutil.chown(partial, group=GROUP)
            partial.replace(path)
        except OSError as error:
            raise ConfigError(str(path), "", f"cannot be written: {error.strerror}", "run it with sudo") from None


def private(path: Path, text: str) -> None:
    """A new file that only its owner and group can read, whatever the umask says."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        os.fchmod(file.fileno(), 0o640)
        file.write(text)
