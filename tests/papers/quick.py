"""The quick reproduction of each paper, once for all tests of a file."""

import functools

from armctl.lab.stage import silent
from armctl.papers.comparison import QUICK, PaperReport
from armctl.papers.run import PAPERS


@functools.cache
def reproduced(paper: str) -> PaperReport:
    report: PaperReport = PAPERS[paper](QUICK, 0, silent)
    return report
