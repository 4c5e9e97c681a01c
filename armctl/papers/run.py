"""Which papers there are, and recomputing some of them."""

from collections.abc import Callable, Sequence

from armctl.lab.stage import Stage
from armctl.papers import paper_000, paper_001, paper_002, paper_003, paper_004
from armctl.papers.page import PaperReport
from armctl.papers.verdict import Effort

PAPERS: dict[str, Callable[[Effort, int, Stage], PaperReport]] = {
    "000": paper_000.reproduce,
    "001": paper_001.reproduce,
    "002": paper_002.reproduce,
    "003": paper_003.reproduce,
    "004": paper_004.reproduce,
}


def reproduce(papers: Sequence[str], effort: Effort, seed: int, stage: Stage) -> list[PaperReport]:
    """Recompute papers, one after the other."""
    return [PAPERS[paper](effort, seed, stage) for paper in papers]
