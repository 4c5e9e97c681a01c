"""Which papers there are, by the number that armctl gives each, and what recomputes each."""

from armctl.papers import paper_000, paper_001, paper_002, paper_003, paper_004

_MODULES = (paper_000, paper_001, paper_002, paper_003, paper_004)
PAPERS = {f"{number:03}": module.reproduce for number, module in enumerate(_MODULES)}
