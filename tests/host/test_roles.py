"""Who may command, by the names of users and groups."""

import grp
import os
import pwd

import pytest

from armctl.host.roles import may_command

NOBODY = next(user for user in pwd.getpwall() if user.pw_uid not in (0, os.getuid()))
NO_USER = 3_999_999_999


@pytest.mark.parametrize("uid", [0, os.getuid(), NOBODY.pw_uid, NO_USER])
def test_without_names_everybody_commands(uid: int) -> None:
    assert may_command(uid, ())


def test_root_and_the_daemons_own_user_always_command() -> None:
    assert may_command(0, ("somebody",))
    assert may_command(os.getuid(), ("somebody",))


def test_others_command_by_their_name_or_a_group_of_theirs() -> None:
    group = grp.getgrgid(NOBODY.pw_gid).gr_name
    assert may_command(NOBODY.pw_uid, ("somebody", NOBODY.pw_name))
    assert may_command(NOBODY.pw_uid, (f"@{group}",))
    assert not may_command(NOBODY.pw_uid, ("somebody", "@nogroupofanybody", f"@{NOBODY.pw_name}-x"))
    assert not may_command(NO_USER, (NOBODY.pw_name, f"@{group}"))
