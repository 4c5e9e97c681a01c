"""Who may command the arm. Whoever reaches the socket may look, and stop it."""

import contextlib
import grp
import os
import pwd
from collections.abc import Sequence


def may_command(uid: int, commanders: Sequence[str]) -> bool:
    """Whether a user is among the commanders: names of users, and of groups with an `@` before them.

    Without any name everybody is; root and the daemon's own user always are.
    """
    if not commanders or uid in (0, os.getuid()):
        return True
    try:
        user = pwd.getpwuid(uid)
    except KeyError:
        return False
    names = {user.pw_name}
    for gid in os.getgrouplist(user.pw_name, user.pw_gid):
        with contextlib.suppress(KeyError):  # a group without a name
            names.add(f"@{grp.getgrgid(gid).gr_name}")
    return not names.isdisjoint(commanders)
