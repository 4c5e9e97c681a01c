"""Rules that the judge knows and the package does not keep yet: told beside the violations, not among them.

Whoever makes one of them true takes its line out; the list is to be empty. The rules stand in `invariants.py` and
`standing.py`.
"""

RED: frozenset[str] = frozenset({
    "faults",  # a fault is reported under its own name while another one is latched
    "rest",  # rest needs a cause that lasts, and is announced 3 s ahead
    "stall",  # no servo goes on pushing at standstill
    "yields",  # a foreign goal does not stay
    "limp",  # `release` answers only when every servo is limp
    "cause",  # torque comes on while the cause of a rest stands
    "soft",  # a damaged write leaves a servo at full torque while torque comes on
    "diagnosis",  # damaged packets end in no code of another cause (wire_damage.py)
    "held",  # a goal that was lost twice is no other program
})  # fmt: skip
