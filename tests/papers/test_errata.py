"""Every erratum of the papers is proven: print fails and the correction holds."""

import pytest

from armctl.kinematics import robots
from armctl.kinematics.errata import PRINT_OFF, TRUE_OFF, Erratum
from armctl.papers.errata import errata
from armctl.papers.run import PAPERS
from armctl.papers.transcription import transcription

ALL = errata(tuple(PAPERS))


@pytest.mark.parametrize("erratum", ALL, ids=lambda e: f"{e.paper} {e.where}: {e.printed}")
def test_print_is_wrong_and_the_correction_holds(erratum: Erratum) -> None:
    printed, true = erratum.residuals()
    assert printed > PRINT_OFF
    assert abs(true) < TRUE_OFF
    assert erratum.proven
    assert erratum.how in erratum.proof


def test_a_correction_that_does_not_hold_is_not_proven() -> None:
    assert not Erratum("000", "", "", "", "nothing", lambda: (1.0, 0.5)).proven
    assert not Erratum("000", "", "", "", "nothing", lambda: (0.0, 0.0)).proven


def test_every_proof_of_a_robot_has_one_statement() -> None:
    proofs = [proof for name in robots.names() for proof in robots.get(name).proofs]
    assert sorted(proofs) == sorted(one.proof for paper in PAPERS for one in transcription(paper).errata if one.proof)


def test_there_are_more_than_twenty_different_ones_in_the_papers_order() -> None:
    assert len({(one.paper, one.where, one.printed) for one in ALL}) == len(ALL) > 20
    assert [one.paper for one in ALL] == sorted(one.paper for one in ALL)


def test_only_the_papers_asked_for_are_listed() -> None:
    assert {one.paper for one in errata(("002", "004"))} == {"002", "004"}
    assert errata(("001",)) == []
