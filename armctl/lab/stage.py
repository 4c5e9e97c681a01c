"""How long work tells how far it is: in stages, each of so many steps."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

# Told how many steps are done, and a note.
Progress = Callable[[float, str], None]
# Begins a stage by its name and its number of steps; what it yields is told how many are done.
Stage = Callable[[str, float], AbstractContextManager[Progress]]


@contextmanager
def silent(_label: str, _total: float) -> Iterator[Progress]:
    """A stage nobody is told of."""
    yield lambda _done, _note: None
