"""Every erratum is proven: what is computed differs from print and equals the correction."""

import pytest

from armctl.kinematics import robots
from armctl.kinematics.errata import PRINT_OFF, TRUE_OFF, Erratum

ERRATA = [erratum for name in robots.names() for erratum in robots.get(name).errata]


@pytest.mark.parametrize("erratum", ERRATA, ids=lambda e: f"{e.paper} {e.where}: {e.printed}")
def test_print_is_wrong_and_the_correction_holds(erratum: Erratum) -> None:
    printed, true = erratum.residuals()
    assert printed > PRINT_OFF
    assert abs(true) < TRUE_OFF
    assert erratum.proven
    assert erratum.how in erratum.proof


def test_there_are_more_than_twenty_and_no_two_are_the_same() -> None:
    assert len(ERRATA) > 20
    assert len({(e.paper, e.where, e.printed) for e in ERRATA}) == len(ERRATA)
    assert {e.paper for e in ERRATA} == {"000", "002", "003", "004"}


def test_a_correction_that_does_not_hold_is_not_proven() -> None:
    assert not Erratum("000", "", "", "", "nothing", lambda: (1.0, 0.5)).proven
    assert not Erratum("000", "", "", "", "nothing", lambda: (0.0, 0.0)).proven
