"""Rules that the judge knows and the package does not keep yet: told beside the violations, not among them.

Whoever makes one of them true takes its line out; the list is to be empty. The rules stand in `invariants.py` and
`standing.py`.
"""

RED: frozenset[str] = frozenset()
