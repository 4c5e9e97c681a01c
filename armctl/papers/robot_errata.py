"""The errata of the robots' tables and equations: statements from a file, each with the proof that its robot keeps."""

from collections.abc import Iterator
from importlib import resources

from armctl.config import parse_yaml
from armctl.kinematics import robots
from armctl.kinematics.errata import Erratum, Residuals

FILE = "robot_errata.yaml"


def robot_errata() -> Iterator[Erratum]:
    """What the papers print wrong of a robot, in the order of the file."""
    proofs: dict[str, Residuals] = {}
    for name in robots.names():
        proofs |= robots.get(name).proofs
    text = resources.files("armctl.papers").joinpath("printed", FILE).read_text(encoding="utf-8")
    for paper, statements in parse_yaml(text, FILE).items():
        for name, one in statements.items():
            yield Erratum(paper, one["where"], one["printed"], one["corrected"], one["how"], proofs[name])
