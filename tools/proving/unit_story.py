"""A story of the installed service, and all of them in their order (`units.py`)."""

from collections.abc import Callable

from proving.installed import FROM_M, TO_M, Installed

Told = tuple[bool, object]
Story = Callable[[Installed], Told]
Tell = Callable[[str], None]
# Stories in their order, and those of the short form.
STORIES: list[tuple[str, Story]] = []
SHORT: set[str] = set()
CONFIG = "/etc/armctl/armctl.yaml"
# Share of a core while an adapter is missing, and how long that is watched [s].
MISSING_SHARE, MISSING_S = 0.001, 20.0
POWER_CUTS, STARTS, UPGRADES = 20, 100, 20
# Of so many rounds of readings one may be missing; by how much the daemon may grow meanwhile: a log of an hour keeps
# where each of its 3,600 chunks is, 1 MB, until it ends.
ROUNDS_OF_ONE, GROWN_MB = 10_000, 2.0
# By then a log of an hour is rotated and compacted, after which the daemon keeps what that took.
ROTATED_S = 3_900.0
OPTIMISE = {"from_m": FROM_M, "to_m": TO_M, "via": [2], "duration_s": 5.0, "name": "proved"}


def story(name: str, *, short: bool = False) -> Callable[[Story], Story]:
    def kept(function: Story) -> Story:
        STORIES.append((name, function))
        if short:
            SHORT.add(name)
        return function

    return kept
