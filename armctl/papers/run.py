"""Which papers there are, and recomputing some of them."""

from collections.abc import Sequence

from armctl.lab.stage import Stage
from armctl.papers import paper_000, paper_001, paper_002, paper_003, paper_004
from armctl.papers.page import PaperReport
from armctl.papers.verdict import Effort

# By the number that armctl gives each.
PAPERS = {
    f"{number:03}": module.reproduce
    for number, module in enumerate((paper_000, paper_001, paper_002, paper_003, paper_004))
}


def reproduce(papers: Sequence[str], effort: Effort, seed: int, stage: Stage) -> list[PaperReport]:
    """Recompute papers, one after the other."""
    return [PAPERS[paper](effort, seed, stage) for paper in papers]
